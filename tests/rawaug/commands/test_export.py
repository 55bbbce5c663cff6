"""rawaug export: an ONNX file of any size that gives PyTorch's numbers."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import denoisers
from denoisers.domains import fit_levels
from denoisers.onnx import open_session
from rawaug.bayer import CFA, noise_variance
from rawaug.cli import main
from rawaug.commands.export import export, write_onnx
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.errors import MissingExtra
from rawaug.io import RawFrame


@pytest.mark.parametrize(
    ("name", "config", "linear"),
    [
        ("PMRID", {"width": 4, "variance_map": True}, False),
        ("DRUNet", {"width": 4, "scales": 1, "variance_map": False, "domain": "anscombe", "pyramid": 1}, False),
        ("JointDRUNet", {"width": 4, "scales": 2}, True),
    ],
)
def test_any_size_gives_pytorch_s_numbers(
    name: str,
    config: dict[str, Any],
    linear: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for library in ("onnx", "onnxruntime"):
        pytest.importorskip(library, reason="pip install rawaug[export]")
    model, weights, out = denoisers.build(name, **config), tmp_path / "small.safetensors", tmp_path / "small.onnx"
    model.initialise(seed=1, gain=0.6)
    denoisers.save(model.eval(), weights, {"cfa": "RGGB"})
    monkeypatch.setenv("RAWAUG_PROGRESS_SECONDS", "0")
    assert main(["export", str(weights), str(out)]) == 0
    said = capsys.readouterr()
    assert "any batch, height and width; largest difference from PyTorch" in said.out
    assert "export small.onnx: 2/2 steps" in said.err
    frame = RawFrame(torch.rand(1, 130, 94, generator=torch.Generator().manual_seed(1)), CFA.GBRG)
    both = [
        RawDenoiser.of(file, views=8 if name == "PMRID" else 1).frame(frame, (1e-3, 1e-5)) for file in (weights, out)
    ]
    assert both[0].shape == (3 if linear else 1, 130, 94) and (both[0] - frame.mosaic).abs().max() > 1e-3
    assert (both[0] - both[1]).abs().max() < 1e-4
    session = open_session(out)
    for batch, height, width in ((1, 64, 32), (3, 31, 45), (2, 5, 130)):
        noisy = torch.rand(batch, 4, height, width, generator=torch.Generator().manual_seed(0)) - 0.05
        variance = noise_variance(noisy, 1e-3 * torch.arange(1.0, batch + 1).reshape(-1, 1, 1, 1), 1e-5)
        (denoised,) = session.run(None, {"noisy": noisy.numpy(), "variance": variance.numpy()})
        with torch.no_grad():
            assert (torch.from_numpy(denoised) - model(noisy, variance)).abs().max() < 1e-4


@pytest.mark.parametrize("half", [False, True])
def test_tiles_of_one_shape_give_pytorch_s_numbers(half: bool, tmp_path: Path) -> None:
    for library in ("onnx", "onnxruntime"):
        pytest.importorskip(library, reason="pip install rawaug[export]")
    model = denoisers.build("PMRID", width=4, variance_map=True)
    model.initialise(seed=1, gain=0.6)
    weights, out = tmp_path / "small.safetensors", tmp_path / "small.onnx"
    denoisers.save(model.eval(), weights, {"cfa": "RGGB"})

    said = export(weights, out, "1,4,64,96", half)
    assert "1 x 4 x 64 x 96" in said and ("float16" in said) == half
    session = open_session(out)
    assert [value.shape for value in session.get_inputs()] == [[1, 4, 64, 96]] * 2
    assert {value.type for value in session.get_inputs()} == {"tensor(float)"}
    metadata = session.get_modelmeta().custom_metadata_map
    assert metadata["shape"] == "1,4,64,96" and "black 0, white 1" in metadata["domain"]

    noisy = torch.rand(1, 4, 64, 96, generator=torch.Generator().manual_seed(0))
    variance = noise_variance(noisy, 1e-3, 1e-5)
    (denoised,) = session.run(None, {"noisy": noisy.numpy(), "variance": variance.numpy()})
    with torch.no_grad():
        difference = float((torch.from_numpy(denoised) - model(noisy, variance)).abs().max())
    assert difference < (5e-3 if half else 1e-4)
    assert (difference > 1e-5) == half, "float16 has 11 bits"

    for shape in ("1,3,64,96", "64,96", "a,b,c,d"):
        with pytest.raises(ValueError, match="--shape"):
            export(weights, out, shape)


class Levels(nn.Module):
    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return torch.cat(fit_levels(noisy, variance))


def test_the_levels_of_a_large_frame_are_exact(tmp_path: Path) -> None:
    """ONNX Runtime's sums of a million values in float32 are wrong by a thousandth."""
    for library in ("onnx", "onnxruntime"):
        pytest.importorskip(library, reason="pip install rawaug[export]")
    noisy = torch.rand(1, 4, 512, 512, generator=torch.Generator().manual_seed(0))
    inputs = {"noisy": noisy, "variance": noise_variance(noisy, 2e-5, 1e-6)}
    session = write_onnx(Levels(), inputs, "levels", tmp_path / "levels.onnx")
    (levels,) = session.run(None, {name: value.numpy() for name, value in inputs.items()})
    assert levels.flatten().tolist() == pytest.approx([2e-5, 1e-6], rel=1e-5)


def test_what_is_missing_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(MissingExtra, match="installed"):
        export("rawaug-small", tmp_path / "a.onnx")
    with pytest.raises(ValueError, match=r"ends in \.onnx"):
        export("rawaug-small", tmp_path / "a.pt")
    assert not list(tmp_path.iterdir())
