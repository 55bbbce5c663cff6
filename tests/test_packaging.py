"""The lock, the extras, the wheel, the check of dependencies, and what a release shows."""

from __future__ import annotations

import json
import os
import re
import runpy
import shutil
import socket
import subprocess
import sys
import threading
import zipfile
from configparser import ConfigParser
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
PLATFORMS = {"linux": ("Linux", "x86_64"), "darwin": ("Darwin", "arm64"), "win32": ("Windows", "AMD64")}
LOCKED = ("raw", "train", "data", "test", "docs", "export", "explore", "openvino")


def environment(python: str, platform: str) -> dict[str, str]:
    system, machine = PLATFORMS[platform]
    where = {"sys_platform": platform, "platform_system": system, "platform_machine": machine, "extra": ""}
    where |= {"python_version": python, "python_full_version": f"{python}.1"}
    return {**where, "implementation_name": "cpython", "os_name": "nt" if platform == "win32" else "posix"}


def applying(lines: list[str], where: dict[str, str]) -> list[Requirement]:
    found = [Requirement(line) for line in lines]
    return [one for one in found if one.marker is None or one.marker.evaluate(where)]


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("platform", PLATFORMS)
def test_every_requirement_has_one_pin_that_fits(python: str, platform: str) -> None:
    setup = ConfigParser()
    setup.read(ROOT / "setup.cfg")
    asked = setup["options"]["install_requires"].split("\n")
    extras = {extra: setup.get("options.extras_require", extra, raw=True) for extra in LOCKED}
    asked += [line for lines in extras.values() for line in lines.split("\n")]
    asked = [line for line in asked if line and "%(" not in line]
    where = environment(python, platform)
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"]
    pins: dict[str, str] = {}
    for pin in applying(lines, where):
        name, (exact,) = canonicalize_name(pin.name), pin.specifier
        assert name not in pins, f"{name} is pinned twice"
        assert exact.operator == "=="
        pins[name] = exact.version
    for requirement in applying(asked, where):
        version = pins.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} has no pin: run make lock"
        assert version in requirement.specifier, f"{requirement.name} {version}: run make lock"


def test_cuda_packages_are_left_to_torch() -> None:
    """The CPU build must not be kept from installing, nor the CUDA build from its own exact pins."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    assert not [line for line in lines if line.startswith(("nvidia-", "cuda-"))]


def test_workflows_run_targets_of_the_makefile_on_the_locked_versions() -> None:
    makefile, workflow = (ROOT / "Makefile").read_text(), (ROOT / ".github/workflows/test.yml").read_text()
    assert re.search(r"^PYTHONS := (.*)$", makefile, re.MULTILINE)[1].split() == list(PYTHONS)  # type: ignore[index]
    assert re.findall(r'"(3\.\d+)"', re.search(r"python: \[(.*)\]", workflow)[1]) == list(PYTHONS)  # type: ignore[index]
    for target in re.findall(r"run: make (\w+)", workflow + (ROOT / ".github/workflows/release.yml").read_text()):
        assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"make {target} is no target"


def script(name: str) -> Any:
    return SimpleNamespace(**runpy.run_path(str(ROOT / ".ci" / f"{name}.py")))


@pytest.fixture
def check() -> Any:
    return script("advisories")


def test_an_advisory_fails_the_check(check: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[Any] = []

    class Database(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.extend(json.loads(self.rfile.read(int(self.headers["Content-Length"])))["queries"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps({"results": [{}, {"vulns": [{"id": "GHSA-1"}]}]}).encode())

        def log_message(self, *_: Any) -> None:
            """Nothing on stderr."""

    pins = tmp_path / "constraints.txt"
    pins.write_text('# pins\nabsl-py==2.5.1\ncontourpy==1.3.3; python_version >= "3.11"\n')
    with HTTPServer(("127.0.0.1", 0), Database) as server:
        answering = threading.Thread(target=server.handle_request)
        answering.start()
        assert check.main([str(pins)], f"http://127.0.0.1:{server.server_port}") == 1
        answering.join()
    assert [(q["package"]["name"], q["version"]) for q in asked] == [("absl-py", "2.5.1"), ("contourpy", "1.3.3")]
    assert capsys.readouterr().out.startswith("contourpy 1.3.3: GHSA-1\n")


@pytest.mark.parametrize("must", [False, True])
def test_without_a_network_it_says_so_and_a_release_stops(
    check: Any, must: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket() as nobody:  # bound, and not listened on
        nobody.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{nobody.getsockname()[1]}"
        assert check.main([str(ROOT / "constraints.txt"), *["--must"] * must], url) == must
    out = capsys.readouterr().out
    assert "not checked" in out and out.count("\n") == 1
    release = (ROOT / ".github/workflows/release.yml").read_text()
    assert release.index("advisories.py --must") < release.index("make dist")


def test_a_package_index_gets_absolute_links_and_urls() -> None:
    release, url = script("release"), "https://host/owner/name"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    places = re.findall(r"\]\(([^)]+)\)", release.absolute(readme, url))
    assert len(places) > 5 and all(place.startswith(("https://", "#")) for place in places)
    for place in re.findall(r"\]\((?!http|#)([^)]+)\)", readme):
        assert (ROOT / place.partition("#")[0]).is_file(), f"README.md: {place} is not there"
    setup = ConfigParser()
    setup.read_string(release.with_urls((ROOT / "setup.cfg").read_text(encoding="utf-8"), url))
    assert f"Homepage = {url}" in setup["metadata"]["project_urls"] and setup["metadata"]["name"] == "rawaug"


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


def test_a_recipe_is_found_by_its_name_from_any_folder(site: Path, tmp_path: Path) -> None:
    script = "import rawaug, sys; from rawaug.cli import main; print(rawaug.__file__); sys.exit(main())"
    command = [sys.executable, "-c", script, "run", "base", "--help"]
    # compiled loops are kept beside their source, so that here they would be compiled anew
    environment = {**os.environ, "PYTHONPATH": str(site), "PYTHONWARNINGS": "ignore", "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith(str(site)), "the repository was taken instead of the wheel"
    assert '"DRUNet"' in done.stdout, "the recipe's own value"


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
    (metadata,) = site.glob("rawaug-*.dist-info")
    names = {file.name for file in metadata.rglob("*")}
    assert {"LICENSE", "THIRD_PARTY.md"} <= names, "the wheel states whose works it holds"


def test_the_source_archive_holds_what_the_checkout_holds() -> None:
    """Every file and folder at the top of the checkout is a package or stands in MANIFEST.in."""
    manifest = (ROOT / "MANIFEST.in").read_text(encoding="utf-8")
    named = set(re.sub(r"^(include|graft) ", "", manifest, flags=re.MULTILINE).split())
    packaged = {"rawaug", "denoisers", "README.md", "setup.cfg", "pyproject.toml", "MANIFEST.in", "PKG-INFO"}

    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").replace("/", "").split()
    for entry in ROOT.iterdir():
        if entry.name == ".git" or any(entry.match(pattern) for pattern in ignored):
            continue
        assert entry.name in named | packaged, f"{entry.name} is not in the source archive: name it in MANIFEST.in"


def test_third_party_names_every_table_that_others_measured() -> None:
    text = (ROOT / "THIRD_PARTY.md").read_text(encoding="utf-8")
    tables = [*ROOT.glob("rawaug/**/*.tsv"), ROOT / "benchmarks/tone_curves.json", ROOT / "rawaug/noise/presets.json"]
    for table in tables:
        assert table.name in text, f"THIRD_PARTY.md: does not say where {table.name} comes from"
    assert "[yyyy]" not in (ROOT / "LICENSE").read_text(encoding="utf-8")
