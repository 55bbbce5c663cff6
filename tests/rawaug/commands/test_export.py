"""rawaug export: an ONNX file of any size that gives PyTorch's numbers."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import pytest
import torch

import denoisers
from rawaug.bayer import CFA
from rawaug.cli import main
from rawaug.commands.export import errors_only, export
from rawaug.commands.frame_denoisers import frame_denoiser
from rawaug.evaluation.contestants import session_of
from rawaug.io import RawFrame


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    model = denoisers.build("PMRID", width=4, variance_map=True)
    model.initialise(seed=1, gain=0.8)
    path = tmp_path / "small.safetensors"
    denoisers.save(model, path, {"cfa": "RGGB"})
    return path


def test_any_size_gives_pytorch_s_numbers(weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason="pip install rawaug[export]")
    out = tmp_path / "small.onnx"
    assert main(["export", str(weights), str(out)]) == 0
    assert "largest difference from PyTorch" in capsys.readouterr().out
    session, model = session_of(out), denoisers.from_pretrained(weights)
    frame = RawFrame(torch.rand(1, 130, 94, generator=torch.Generator().manual_seed(1)), CFA.GBRG)
    both = [frame_denoiser(file, self_ensemble=True)(frame, (1e-3, 1e-5)) for file in (weights, out)]
    assert (both[0] - frame.mosaic).abs().max() > 1e-3
    assert (both[0] - both[1]).abs().max() < 1e-4
    for height, width in ((64, 32), (31, 45), (5, 130)):
        noisy = torch.rand(1, 4, height, width, generator=torch.Generator().manual_seed(0)) - 0.05
        variance = 1e-3 * noisy.clamp_min(0.0) + 1e-5
        (denoised,) = session.run(None, {"noisy": noisy.numpy(), "variance": variance.numpy()})
        with torch.no_grad():
            expected = model(noisy, variance)
        assert (expected - noisy).abs().max() > 1e-3
        assert (torch.from_numpy(denoised) - expected).abs().max() < 1e-4


def test_full_colour_is_exported_as_well(tmp_path: Path) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        pytest.importorskip(name, reason="pip install rawaug[export]")
    model, files = (
        denoisers.JointDRUNet(width=4, scales=2),
        [tmp_path / f"joint.{kind}" for kind in ("safetensors", "onnx")],
    )
    model.initialise(seed=1, gain=0.5)
    denoisers.save(model, files[0], {"cfa": "RGGB"})
    export(*files)
    frame = RawFrame(torch.rand(1, 130, 94, generator=torch.Generator().manual_seed(1)), CFA.GBRG)
    both = [frame_denoiser(file, linear=True)(frame, (1e-3, 1e-5)) for file in files]
    assert both[0].shape == (3, 130, 94) and both[0].std() > 0.01
    assert (both[0] - both[1]).abs().max() < 1e-4


def test_of_the_exporter_errors_alone_are_logged(caplog: pytest.LogCaptureFixture) -> None:
    below = logging.getLogger("exporter.registration")
    with errors_only("exporter"):
        below.warning("torchvision is not installed")
        below.error("broken")
    below.warning("heard again")
    assert caplog.messages == ["broken", "heard again"]


def test_what_is_missing_is_said_in_one_line(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("onnx", "onnxscript", "onnxruntime"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        ValueError, match=r"export to ONNX needs onnx, onnxscript, onnxruntime: pip install 'rawaug\[export\]'"
    ):
        export(weights, tmp_path / "a.onnx")
    with pytest.raises(ValueError, match=r"ends in \.onnx"):
        export(weights, tmp_path / "a.pt")
