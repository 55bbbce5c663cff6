"""What a built wheel holds is enough: away from the repository, a recipe runs by its name."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEFT_OUT = shutil.ignore_patterns(".*", "build", "runs", "site", "*.egg-info", "__pycache__", "tests", "benchmarks")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the content of the wheel; what the package requires comes from the test environment."""
    place = tmp_path_factory.mktemp("wheel")
    shutil.copytree(ROOT, place / "source", ignore=LEFT_OUT)
    build = "import sys; from setuptools.build_meta import build_wheel; build_wheel(sys.argv[1])"
    command = [sys.executable, "-c", build, str(place)]
    subprocess.run(command, cwd=place / "source", check=True, capture_output=True)
    (built,) = place.glob("rawaug-*.whl")
    with zipfile.ZipFile(built) as wheel:
        wheel.extractall(place / "site")
    return place / "site"


def test_a_recipe_runs_by_its_name_from_any_folder(site: Path, tmp_path: Path) -> None:
    script = "import rawaug, sys; from rawaug.cli import main; print(rawaug.__file__); sys.exit(main())"
    command = [sys.executable, "-c", script, "run", "denoisers", "--count", "1", "--crop", "64", "--denoisers", "[]"]
    # compiled loops are kept beside their source, so that here they would be compiled anew
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONWARNINGS": "ignore", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith(str(site)), "the repository was taken instead of the wheel"
    assert (tmp_path / "runs" / "denoisers" / "report.html").is_file()


def test_recipes_weights_and_tables_are_in_it(site: Path) -> None:
    existing = {file.relative_to(site).as_posix() for file in site.rglob("*") if file.is_file()}
    source = site.parent / "source"
    wanted = {
        Path(above, file.relative_to(source)).as_posix()
        for folder, above in (("rawaug", ""), ("denoisers", ""), ("recipes", "rawaug"))
        for file in (source / folder).rglob("*")
        if file.is_file()
    }
    assert len(wanted) > 100 and wanted <= existing, sorted(wanted - existing)
