"""A library of an extra that is missing: one line names the extra, and what needs none works without."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from configparser import ConfigParser
from pathlib import Path

import pytest
from PIL import Image

from rawaug.errors import MissingExtra, extra

ROOT = Path(__file__).parents[2]
SETUP = ConfigParser()
SETUP.read(ROOT / "setup.cfg")

WITHOUT_EXTRAS = """
import sys
for name in ("rawpy", "OpenImageIO", "tifffile", "PIL", "skimage", "lightning_fabric", "matplotlib",
             "pywt", "h5py"):
    sys.modules[name] = None
import torch
from torch.utils.data import DataLoader
import rawaug
pictures = [torch.randint(0, 256, (3, 48, 64), dtype=torch.uint8) for _ in range(2)]
augment = rawaug.RawAugment.from_pretrained("universal", noise="cycleisp_sidd")
assert rawaug.RawPairs(pictures, augment, crop=32, seed=0)[0].noisy.shape == (4, 16, 16)
(batch,) = rawaug.wrap(DataLoader(pictures, batch_size=2), augment)
assert augment.isp.forward(augment.isp.reverse(torch.stack(pictures)).raw).srgb.shape == (2, 3, 48, 64)
print(batch.clean.shape[0])
"""


@pytest.mark.long
def test_wrapping_a_loader_needs_no_extra() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT_EXTRAS], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == ["2"], done.stderr[-2000:]


@pytest.mark.parametrize(("library", "name"), [("OpenImageIO", "raw"), ("matplotlib", "train")])
def test_a_missing_library_is_one_line(
    library: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Callable[..., str]
) -> None:
    Image.new("RGB", (64, 48), (90, 120, 150)).save(tmp_path / "a.png")
    for module in [m for m in sys.modules if m.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, library, None)
    said = refused("preview", tmp_path / "a.png", "--out", tmp_path / "figure.png")
    assert said == f"rawaug: {library} is not installed; run: pip install '{ROOT}[{name}]'"


def test_other_errors_of_an_import_pass() -> None:
    with pytest.raises(ImportError, match="cannot import name") as caught, extra("raw"):
        from pathlib import no_such_name  # type: ignore[attr-defined]  # noqa: F401
    assert not isinstance(caught.value, MissingExtra)


def test_all_is_every_extra() -> None:
    extras = SETUP["options.extras_require"]
    wanted = {
        line
        for name in ("raw", "train", "data", "explore", "export", "ksvd")
        for line in extras[name].split("\n")
        if line
    }
    assert {line for line in extras["all"].split("\n") if line} == wanted
    assert not wanted & set(SETUP["options"]["install_requires"].split("\n"))
