"""Another package brings a network and a noise model by entry points, and a recipe trains with them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

PACKAGE = """
from denoisers.network import PACKED, Denoiser, conv
from rawaug.noise import Compose, RowNoise, ShotReadNoise, noise_levels


class Shallow(Denoiser):
    def __init__(self, width=16, channels=PACKED, variance_map=True, deviation=True, domain="linear", seed=0):
        super().__init__(channels, variance_map, deviation, 1, {"width": width}, domain)
        self.first, self.last = conv(self.inputs, width), conv(width, channels)
        self.initialise(seed, self.last)

    def residual(self, features):
        return self.last(self.first(features).relu())


class Banded(Compose):
    def __init__(self, levels="cycleisp_sidd", row_var=1e-6):
        super().__init__([ShotReadNoise(noise_levels(levels)), RowNoise(row_var)])
"""
ENTRY_POINTS = """
[rawaug.denoisers]
Shallow = abroad:Shallow
[rawaug.noise]
Banded = abroad:Banded
[rawaug.losses]
gone = abroad:Missing
"""
RECIPE = """
name: abroad
camera: universal
data: {pairs: null, validation: null, test: "demo:validation", test_count: 1}
denoiser: {name: Shallow, settings: {width: 4}}
noise: {name: Banded, settings: {row_var: 1.0e-4}}
train: {steps: 3, batch: 2, crop: 32, validate_every: 2, checkpoint_every: 2, loss: {name: charbonnier}}
arms: {pictures: {augmented: 1.0}}
device: cpu
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as pip leaves it: the package and its metadata."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "abroad.py").write_text(PACKAGE)
    metadata = folder / "abroad-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: abroad\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    return folder


def rawaug(site: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join([str(ROOT), str(site)])
    environment = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "rawaug.cli", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


def test_a_recipe_trains_with_what_another_package_brings(site: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(RECIPE)
    done = rawaug(site, tmp_path, "run", "mine.yaml")
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads((tmp_path / "runs" / "abroad" / "results.json").read_text())
    assert 20.0 < results["results"]["pictures"][0]["plain"]["psnr"] < 60.0
    assert results["recipe"]["noise"] == {"name": "Banded", "settings": {"row_var": 1e-4}}
    weights = str(tmp_path / "runs" / "abroad" / "seed0" / "pictures" / "denoiser.safetensors")
    described = rawaug(site, tmp_path, "info", weights)
    assert "denoiser Shallow" in described.stdout and '"width": 4' not in described.stderr
    without = rawaug(tmp_path, tmp_path, "info", weights)  # the package is not installed
    assert without.returncode == 2 and "denoiser 'Shallow' is unknown; use one of DHDN" in without.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("width: 4", "widht: 4"), "denoiser Shallow has no setting 'widht'; it has width, channels.*nearest: width"),
        (("name: Banded", "name: Bandet"), r"noise 'Bandet' is unknown: .*\(nearest: Banded\)"),
        (("name: charbonnier", "name: gone"), "loss 'gone': the entry point abroad:Missing cannot be loaded"),
    ],
)
def test_what_is_wrong_with_it_is_one_line(site: Path, tmp_path: Path, change: tuple[str, str], message: str) -> None:
    import re

    (tmp_path / "mine.yaml").write_text(RECIPE.replace(*change))
    done = rawaug(site, tmp_path, "run", "mine.yaml")
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and re.search(message, done.stderr), done.stderr
