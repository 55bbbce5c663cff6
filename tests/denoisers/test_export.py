"""Networks outside PyTorch: ONNX, run by ONNX Runtime, gives the same numbers."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import denoisers

SMALL: dict[str, dict[str, Any]] = {
    "UNet": {"width": 4, "scales": 3},
    "DHDN": {"width": 4},
    "DnCNN": {"width": 8, "depth": 4},
}


@pytest.fixture(params=SMALL)
def network(request: pytest.FixtureRequest) -> denoisers.Denoiser:
    """A network whose residual is not zero."""
    net = denoisers.build(request.param, **SMALL[request.param])
    net.initialise(seed=5)
    with torch.no_grad():
        for weight in net.parameters():
            weight.mul_(0.7)
    return net.eval()


def inputs(height: int, width: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    shape = (1, 4, height, width)
    return torch.rand(shape, generator=generator) - 0.1, 1e-2 * torch.rand(shape, generator=generator)


@pytest.mark.parametrize("size", [(32, 48), (30, 45)], ids=["multiples of the stride", "padded inside"])
def test_onnx_gives_the_same_numbers(network: denoisers.Denoiser, size: tuple[int, int], tmp_path: Path) -> None:
    pytest.importorskip("onnx", reason="pip install rawaug[export]")
    pytest.importorskip("onnxscript", reason="pip install rawaug[export]")
    runtime = pytest.importorskip("onnxruntime", reason="pip install rawaug[export]")
    noisy, variance = inputs(*size)
    path = tmp_path / "network.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own
        torch.onnx.export(network, (noisy, variance), path, dynamo=True, input_names=["noisy", "variance"])
    session = runtime.InferenceSession(path, providers=["CPUExecutionProvider"])
    (denoised,) = session.run(None, {"noisy": noisy.numpy(), "variance": variance.numpy()})
    with torch.no_grad():
        expected = network(noisy, variance).numpy()
    np.testing.assert_allclose(denoised, expected, rtol=1e-4, atol=1e-5)
    assert not np.allclose(expected, noisy.numpy(), atol=1e-3)
    for level in (0.5, 1.0):  # neither black nor NaN where it is bright and without noise
        flat = torch.full_like(noisy, level)
        (bright,) = session.run(None, {"noisy": flat.numpy(), "variance": np.zeros(flat.shape, np.float32)})
        with torch.no_grad():
            expected = network(flat, torch.zeros_like(flat)).numpy()
        np.testing.assert_allclose(bright, expected, rtol=1e-4, atol=1e-5)
        assert bright.max() > 0.1
