"""How losses weigh light and shade: each weighing by its formula, and what it makes of an error in either."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import L1Loss, MSELoss

from denoisers.domains import Anscombe
from rawaug.data.pairs import Sample
from rawaug.metrics import psnr
from rawaug.training.losses import LogMeanSquare, RootMeanSquare
from rawaug.training.weighing import weigh_loss

SHOT, READ = 2e-3, 1e-5
NOISY = torch.rand(2, 4, 8, 8, generator=torch.Generator().manual_seed(0)) * 0.8
SAMPLE = Sample(NOISY, NOISY, SHOT * NOISY + READ)


def level(value: float) -> Tensor:
    return torch.full((2, 4, 8, 8), value)


def root(y: float) -> float:
    """``2 sqrt(y / s + r / s^2 + 3/8)``"""
    return float(2.0 * (y / SHOT + READ / SHOT**2 + 0.375) ** 0.5)


def test_rms_counts_every_picture_by_its_own_error() -> None:
    denoised = torch.stack([level(0.5)[0], level(0.2)[0]])
    assert RootMeanSquare(epsilon=0.0)(denoised, level(0.1)).item() == pytest.approx((0.4 + 0.1) / 2)
    assert RootMeanSquare(epsilon=0.3)(level(0.5), level(0.1)).item() == pytest.approx(0.5)


def test_log_mse_is_the_mean_psnr_of_the_pictures_but_for_sign_and_unit() -> None:
    denoised = torch.stack([level(0.5)[0], level(0.2)[0]])
    scores = psnr(denoised, level(0.1))
    decibels = -20.0 / math.log(10.0) * LogMeanSquare(epsilon=0.0)(denoised, level(0.1)).item()
    assert decibels == pytest.approx(float(scores.mean()))
    assert math.isfinite(LogMeanSquare()(level(0.1), level(0.1)).item())


def test_normalised_is_the_loss_in_units_of_the_noise_of_each_pixel() -> None:
    expected = float((0.1 / SAMPLE.variance.sqrt()).mean())
    assert weigh_loss(L1Loss(), "normalised", SAMPLE)(level(0.5), level(0.4)).item() == pytest.approx(
        expected, rel=1e-4
    )


def test_with_noisy_targets_normalised_is_unbiased_and_stabilised_is_not() -> None:
    """The constant with the smallest l2 distance from noisy shots of a dark patch is its clean signal."""
    clean, generator = 2e-3, torch.Generator().manual_seed(1)
    deviation = (SHOT * clean + READ) ** 0.5
    shots = clean + deviation * torch.randn(2, 1, 4, 128, 128, generator=generator)  # input, target
    sample = Sample(shots[0], shots[1], (SHOT * shots[0] + READ).clamp_min(READ))
    levels = torch.linspace(0.0, 2 * clean, 81)

    def best(weigh: str) -> float:
        loss = weigh_loss(MSELoss(), weigh, sample)
        return float(levels[torch.stack([loss(y.expand_as(shots[1]), shots[1]) for y in levels]).argmin()])

    assert best("normalised") == pytest.approx(clean, rel=0.03)
    assert abs(best("stabilised") - clean) > 0.06 * clean


def test_stabilised_is_the_loss_of_the_roots() -> None:
    for clean, denoised in ((0.1, 0.12), (0.7, 0.65)):
        expected = abs(root(denoised) - root(clean))
        assert weigh_loss(L1Loss(), "stabilised", SAMPLE)(level(denoised), level(clean)).item() == pytest.approx(
            expected, rel=1e-3
        )
    assert Anscombe.least_shot < SHOT  # below it the root has fewer photons


def test_mixed_is_the_mean_of_both_in_units_of_the_noise() -> None:
    deviation = SAMPLE.variance.sqrt().mean((1, 2, 3))
    expected = 0.5 * (root(0.5) - root(0.4) + float((0.1 / deviation).mean()))
    assert weigh_loss(L1Loss(), "mixed", SAMPLE)(level(0.5), level(0.4)).item() == pytest.approx(expected, rel=1e-3)


def test_mixed_takes_each_picture_in_units_of_its_own_noise() -> None:
    variance = SAMPLE.variance * torch.tensor([1.0, 100.0]).reshape(2, 1, 1, 1)
    sample, a, b = Sample(NOISY, NOISY, variance), level(0.5), level(0.4)
    alone = [
        weigh_loss(L1Loss(), "mixed", Sample(*(x[k : k + 1] for x in sample)))(a[:1], b[:1]).item() for k in (0, 1)
    ]
    assert weigh_loss(L1Loss(), "mixed", sample)(a, b).item() == pytest.approx(sum(alone) / 2, rel=1e-4)


def test_shadows_count_more_the_more_is_stabilised() -> None:
    """An error in the shadow over the same one in the light."""

    def ratio(weigh: str) -> float:
        loss = weigh_loss(L1Loss(), weigh, SAMPLE)
        return loss(level(0.02), level(0.01)).item() / loss(level(0.81), level(0.80)).item()

    assert ratio("linear") == pytest.approx(1.0, rel=1e-4)
    assert 1.2 < ratio("mixed") < ratio("stabilised")


def test_relative_counts_a_picture_by_the_share_of_its_error_that_stays() -> None:
    clean = torch.full((2, 3, 8, 8), 0.5)
    noisy = clean + torch.tensor([0.02, 0.2])[:, None, None, None]
    half = 0.5 * (noisy + clean)
    sample = Sample(noisy, clean, torch.zeros_like(noisy))
    assert weigh_loss(L1Loss(), "relative", sample)(half, clean).item() == pytest.approx(0.5, rel=1e-3)
    same = Sample(clean, clean, torch.zeros_like(clean))
    assert weigh_loss(L1Loss(), "relative", same)(clean + 0.01, clean).item() == pytest.approx(0.01 * 255, rel=1e-3)
