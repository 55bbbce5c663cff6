"""Metrics against scikit-image."""

from __future__ import annotations

import math

import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rawaug.metrics import patch_psnr, patch_starts, psnr, ssim, worst_and_best_quarter


@pytest.fixture
def images() -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(2, 1, 40, 52, generator=generator, dtype=torch.float64)
    return a, (a + 0.1 * torch.randn(a.shape, generator=generator, dtype=torch.float64)).clamp(0, 1)


def test_psnr_and_ssim_equal_scikit_image(images: tuple[torch.Tensor, torch.Tensor]) -> None:
    a, b = images
    for k in range(2):
        one, other = a[k, 0].numpy(), b[k, 0].numpy()
        expected = peak_signal_noise_ratio(one, other, data_range=1)
        assert psnr(a, b)[k].item() == pytest.approx(expected, abs=1e-9)
        settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "full": True}
        _, full = structural_similarity(one, other, data_range=1, **settings)
        assert ssim(a, b)[k].item() == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-9)


@pytest.mark.parametrize("length", [200, 256, 510, 512, 600, 1704])
def test_patches_cover_every_site(length: int) -> None:
    covered = torch.zeros(length, dtype=torch.bool)
    for start in patch_starts(length):
        assert start % 2 == 0
        assert start + 256 <= max(length, 256)
        covered[start : start + 256] = True
    assert covered.all()


def test_patch_psnr_averages_decibels_not_errors() -> None:
    a = torch.zeros(1, 1, 256, 512)
    b = a.clone()
    b[..., :256] += 0.1  # 20 dB
    b[..., 256:] += 0.001  # 60 dB
    assert patch_psnr(a, b).item() == pytest.approx(40.0, abs=1e-3)
    assert psnr(a, b).item() == pytest.approx(-10 * math.log10(0.5 * (1e-2 + 1e-6)), abs=1e-3)


def test_quarters() -> None:
    assert worst_and_best_quarter([4.0, 1.0, 3.0, 2.0, 5.0, 6.0, 7.0, 8.0]) == (1.5, 7.5)
    assert worst_and_best_quarter([4.0]) == (4.0, 4.0)
    assert worst_and_best_quarter([6.0, 5.0, 4.0, 3.0, 2.0, 1.0]) == (1.5, 5.5)  # a quarter of 6 is 2
    assert worst_and_best_quarter([7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0]) == (1.5, 6.5)
