"""The differentiable JPEG is nearly that of libjpeg, and lets gradients through."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch

from rawaug.metrics import psnr
from rawaug.paper.baselines.jpeg import LUMINANCE, cosines, fourier_round, jpeg, quantisation_table


def smooth_picture() -> torch.Tensor:
    """Coarse random colours ``(1, 3, 40, 56)``, no multiple of 16."""
    coarse = torch.rand(1, 3, 6, 8, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, (40, 56), mode="bicubic").clamp(0.0, 1.0)


@pytest.mark.parametrize("quality", [50, 75, 90])
def test_it_is_nearly_libjpeg(quality: int) -> None:
    image = pytest.importorskip("PIL.Image", reason="needs pillow")
    picture = smooth_picture()
    values = (picture[0].permute(1, 2, 0) * 255).round().to(torch.uint8).numpy()
    file = io.BytesIO()
    image.fromarray(values).save(file, "JPEG", quality=quality, subsampling="4:2:0")
    decoded = np.asarray(image.open(file), np.float32) / 255.0

    expected = torch.from_numpy(decoded).permute(2, 0, 1)[None]
    own = jpeg(torch.from_numpy(values).permute(2, 0, 1)[None] / 255.0, quality)
    assert own.shape == picture.shape
    assert psnr(own, expected).item() > 38.0
    assert psnr(own, expected).item() > psnr(own, picture).item()


def test_the_transform_is_orthonormal_and_the_tables_are_libjpegs() -> None:
    torch.testing.assert_close(cosines() @ cosines().T, torch.eye(8))
    assert (quantisation_table(LUMINANCE, 50) * 255).round()[0].tolist() == [16, 11, 10, 16, 24, 40, 51, 61]
    assert (quantisation_table(LUMINANCE, 90) * 255).round()[0].tolist() == [3, 2, 2, 3, 5, 8, 10, 12]


def test_the_rounding_is_near_and_has_gradients() -> None:
    x = torch.tensor([-1.2, 0.1, 2.25, 7.9], requires_grad=True)
    rounded = fourier_round(x)
    torch.testing.assert_close(rounded, x.detach().round(), atol=0.06, rtol=0)
    rounded.sum().backward()
    assert x.grad is not None and x.grad.isfinite().all() and x.grad.abs().min() > 0


def test_a_quality_that_there_is_not_is_refused() -> None:
    with pytest.raises(ValueError, match="quality"):
        jpeg(smooth_picture(), 0)
