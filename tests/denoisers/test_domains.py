"""Domains: a transform and its inverse, unit noise for Anscombe, one camera for k-sigma; bounded inputs."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from denoisers.domains import DOMAINS, KSigma, fit_levels

LEVELS = [(1e-2, 1e-3), (1e-3, 1e-5), (KSigma.least_shot, 1e-6)]


def of(*values: float) -> tuple[Tensor, ...]:
    return tuple(torch.tensor(value).reshape(1, 1, 1, 1) for value in values)


def noisy_picture(level: float, shot: float, read: float) -> Tensor:
    """Many readings of one brightness, ``(1, 4, 300, 300)``."""
    draws = torch.randn(1, 4, 300, 300, generator=torch.Generator().manual_seed(0))
    return level + (shot * level + read) ** 0.5 * draws


@pytest.mark.parametrize("levels", [*LEVELS, (0.0, 0.0), (0.0, 1e-4), (1e-7, 1e-9)])
@pytest.mark.parametrize("name", DOMAINS)
def test_the_inverse_gives_back_what_went_in(name: str, levels: tuple[float, float]) -> None:
    y = torch.linspace(-0.2, 1.0, 4 * 64).reshape(1, 4, 8, 8)
    seen = DOMAINS[name].forward(y, *of(*levels))
    torch.testing.assert_close(DOMAINS[name].inverse(seen, *of(*levels)), y, rtol=1e-5, atol=1e-5)
    assert (seen.flatten().diff() > 0).all()  # below black too


@pytest.mark.parametrize("levels", LEVELS)
@pytest.mark.parametrize("level", [0.02, 0.2, 0.8])
def test_noise_has_deviation_1_in_anscombe_s(level: float, levels: tuple[float, float]) -> None:
    seen = DOMAINS["anscombe"].forward(noisy_picture(level, *levels), *of(*levels))
    assert seen.std().item() == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("levels", LEVELS)
@pytest.mark.parametrize("level", [0.0, 0.02, 0.8])
def test_noise_is_that_of_iso_1600_in_ksigma_s(level: float, levels: tuple[float, float]) -> None:
    """In digital numbers z the variance is K z + sigma^2, whatever camera and ISO the picture is from."""
    seen = DOMAINS["ksigma"].forward(noisy_picture(level, *levels), *of(*levels)) / KSigma.scale
    expected = KSigma.gain * seen.mean().item() + KSigma.floor
    assert seen.var().item() == pytest.approx(expected, rel=0.02)


def test_levels_are_read_off_the_map() -> None:
    noisy = torch.rand(3, 4, 16, 16, generator=torch.Generator().manual_seed(0)) - 0.1
    shot, read = torch.tensor([1e-2, 1e-3, 0.0]), torch.tensor([1e-4, 0.0, 1e-5])
    variance = shot.reshape(-1, 1, 1, 1) * noisy.clamp_min(0.0) + read.reshape(-1, 1, 1, 1)
    found = fit_levels(noisy, variance)
    torch.testing.assert_close(found[0].flatten(), shot, rtol=1e-4, atol=1e-8)
    torch.testing.assert_close(found[1].flatten(), read, rtol=1e-3, atol=1e-8)
    flat = torch.full((1, 4, 8, 8), 0.5)  # no slope can be known, the variance can
    shot, read = fit_levels(flat, torch.full_like(flat, 1e-3))
    assert (0.5 * shot + read).item() == pytest.approx(1e-3)


@pytest.mark.parametrize("name", DOMAINS)
def test_weak_shot_noise_is_bounded_and_the_noise_map_says_by_how_much(name: str) -> None:
    y, domain = torch.full((1, 4, 8, 8), 0.5), DOMAINS[name]
    least = domain.least_shot
    white = domain.forward(torch.ones_like(y), *of(least, 0.0)).max()
    for shot in (least, least / 100, 0.0):
        assert domain.forward(y, *of(shot, 0.0)).max() < white
        deviation = domain.relative_deviation(y, shot * y, *of(shot, 0.0))
        assert deviation.mean().item() == pytest.approx((shot / least) ** 0.5, rel=1e-4)
    above_the_law = domain.relative_deviation(y, 4.0 * (1e-2 * y + 1e-5), *of(1e-2, 1e-5))
    assert above_the_law.max().item() == 1.0, "the network was trained on 1 and less"
    # Read noise alone: photons are invented, a thousandth of its deviation, so that r / s^2 stays a number.
    seen = domain.forward(y, *of(0.0, 1.0))
    assert seen.isfinite().all() and seen.max() < 1e6
