"""Another package brings a network and a noise model by entry points, and a recipe trains with them."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import denoisers
from rawaug.cli import main
from rawaug.registry import Registry

PACKAGE = """
import torch

from denoisers.network import Denoiser, conv
from rawaug.noise import Compose, RowNoise, ShotReadNoise, noise_levels

TAPS = torch.ones(3).tolist()


class Shallow(Denoiser):
    def __init__(self, width=16, **shared):
        super().__init__({"width": width}, **shared)
        self.first, self.last = conv(self.inputs, width), conv(width, self.channels)
        self.initialise(self.seed, self.last)

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
isp: universal
data: {pairs: null, pictures: "tiny:", validation: null, test: "tiny:validation", test_count: 1}
denoiser: {name: Shallow, settings: {width: 4}}
noise: {name: Banded, settings: {row_var: 1.0e-4}}
train: {steps: 3, batch: 2, crop: 32, validate_every: 2, checkpoint_every: 2, loss: {name: rms}}
arms: {pictures: {augmented: 1.0}}
classical: []
baselines: []
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


@pytest.fixture
def installed(site: Path, registries: list[Registry], monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package can be imported in this process, and nothing of it is left afterwards."""
    monkeypatch.syspath_prepend(str(site))
    look_again(registries)
    yield
    look_again(registries)


def look_again(registries: list[Registry]) -> None:
    """Forget the package, and for which entry points the path was searched."""
    sys.modules.pop("abroad", None)
    for kind in registries:
        vars(kind).pop("_entry_points", None)


@pytest.mark.usefixtures("installed", "tiny")
def test_a_recipe_trains_with_what_another_package_brings(
    tmp_path: Path, registries: list[Registry], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").write_text(RECIPE)
    assert main(["run", str(tmp_path / "mine.yaml"), "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "abroad" / "results.json").read_text())
    assert 20.0 < results["results"]["pictures"][0]["plain"]["psnr"] < 60.0
    assert results["recipe"]["noise"] == {"name": "Banded", "settings": {"row_var": 1e-4}}
    monkeypatch.undo()  # the package is gone
    look_again(registries)
    with pytest.raises(ValueError, match="'Shallow'"):
        denoisers.load(tmp_path / "abroad" / "seed0" / "pictures" / "denoiser.safetensors")


@pytest.mark.usefixtures("installed")
def test_weights_of_its_network_are_saved_and_loaded(tmp_path: Path) -> None:
    model = denoisers.build("Shallow", width=4)
    denoisers.save(model, tmp_path / "x.safetensors", {})
    assert type(denoisers.load(tmp_path / "x.safetensors")[0]) is type(model)


def in_a_fresh_process(site: Path, *lines: str) -> None:
    paths = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", "\n".join(lines)], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.usefixtures("installed")
def test_a_package_is_imported_before_its_network_is_outlined(site: Path, tmp_path: Path) -> None:
    """Its module makes tensors and imports rawaug.noise, neither of which works on the meta device."""
    file = str(tmp_path / "x.safetensors")
    denoisers.save(denoisers.build("Shallow", width=4), file, {})
    in_a_fresh_process(site, f"from rawaug.commands.info import describe_file; describe_file({file!r})")


def test_what_is_imported_on_another_device_is_whole(site: Path) -> None:
    rooms = "rawaug.noise", "rawaug.camera.lights", "rawaug.data.development", "rawaug.training.srgb_noise"
    in_a_fresh_process(
        site,
        "import importlib, torch",
        "with torch.device('meta'):",
        f"    rooms = [importlib.import_module(name) for name in {rooms!r}]",
        "held = [x for room in rooms for value in vars(room).values() for x in (value, *(value if type(value) is tuple",
        "    else ())) if isinstance(x, torch.Tensor)]",
        "assert len(held) >= 4 and not any(x.is_meta for x in held)",
    )


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("width: 4", "widht: 4"), "denoiser Shallow has no setting 'widht'; it has width, channels.*nearest: width"),
        (("name: Banded", "name: Bandet"), r"noise 'Bandet' is unknown: .*\(nearest: Banded\)"),
        (("name: rms", "name: gone"), "loss 'gone': the entry point abroad:Missing cannot be loaded"),
    ],
)
def test_what_is_wrong_with_it_is_one_line(
    tmp_path: Path, refused: Callable[..., str], change: tuple[str, str], message: str
) -> None:
    (tmp_path / "mine.yaml").write_text(RECIPE.replace(*change))
    line = refused("run", tmp_path / "mine.yaml", "--out", tmp_path)
    assert re.search(message, line), line
