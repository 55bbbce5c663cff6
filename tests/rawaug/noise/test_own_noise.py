"""The noise that references have themselves: a known one is found, and its share of an error."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.bayer import CFA, binned_variance
from rawaug.data import Binned, Pair
from rawaug.noise import own_noise, own_noise_share

LEVELS = (1.2e-4, 4e-7)


def scene(height: int = 1024, width: int = 1280) -> Tensor:
    """Patches of all tones, each sixty-four sites wide, with a shallow gradient; ``(1, H, W)``."""
    generator = torch.Generator().manual_seed(0)
    patches = torch.rand(1, height // 64, width // 64, generator=generator) * 0.7 + 0.02
    return patches.repeat_interleave(64, 1).repeat_interleave(64, 2) + torch.linspace(0, 0.02, width)


def reference(truth: Tensor) -> Pair:
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(1))
    raw = truth + noise * (LEVELS[0] * truth + LEVELS[1]) ** 0.5
    return Pair("frame", torch.zeros(3, *truth.shape[1:], dtype=torch.uint8), raw, CFA.GRBG)


@pytest.mark.parametrize(("factor", "together"), [(1, False), (4, False), (4, True)])
def test_the_share_of_a_known_own_noise_is_found(factor: int, together: bool) -> None:
    truth = scene()
    pairs = Binned([reference(truth)], factor, together)
    clean = Pair("truth", pairs.pairs[0].srgb, truth, CFA.GRBG).binned(factor, together).raw
    denoised = clean + 3e-3 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    error = (denoised - pairs[0].raw).square().mean().item()
    levels = own_noise(pairs, 0)
    assert levels is not None
    known = (clean - pairs[0].raw).square().mean().item() / error
    assert 0.05 < known < 0.95 and own_noise_share(levels, pairs[0].raw, error) == pytest.approx(known, rel=0.1)


def test_what_cannot_be_measured_is_unknown_and_what_is_stated_is_taken() -> None:
    small = reference(scene(64, 64))
    assert own_noise([small], 0) is None
    stated = Pair("a", small.srgb, small.raw, small.cfa, own_noise=(3.2e-5, 1.6e-7))
    for together, left in ((False, binned_variance(4)), (True, 1 / 16)):
        assert own_noise(Binned([stated], 4, together), 0) == pytest.approx((3.2e-5 * left, 1.6e-7 * left))
