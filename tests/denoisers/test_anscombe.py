"""The generalised Anscombe transform: unit variance, and an inverse without bias."""

from __future__ import annotations

import pytest
import torch

from denoisers.anscombe import TABLE_COUNTS, forward, inverse
from rawaug.noise import FixedLevels, PoissonGaussianNoise

LEVELS = torch.tensor([0.0, 1e-3, 5e-3, 0.02, 0.1, 0.3, 0.6, 0.9])


def stabilised(shot: float, read: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(mean, variance) of z at each level, over 2^19 pixels."""
    model = PoissonGaussianNoise(FixedLevels(shot, read))
    clean = LEVELS[:, None, None, None].expand(-1, 4, 256, 512).contiguous()
    z = forward(model.disturb(clean, model.sample(len(LEVELS), torch.Generator().manual_seed(5))), shot, read).double()
    return z.mean((1, 2, 3)), z.var((1, 2, 3))


@pytest.mark.parametrize(("shot", "read"), [(1e-3, 1e-5), (1e-2, 1e-4), (2e-2, 1e-6), (1e-4, 1e-5)])
def test_exact_inverse_is_unbiased_and_the_algebraic_one_is_not(shot: float, read: float) -> None:
    mean, _ = stabilised(shot, read)
    sd = (shot * LEVELS + read).sqrt().double()
    bias = (inverse(mean[:, None], shot, read)[:, 0] - LEVELS) / sd
    assert bias.abs().max() < 0.006  # of a pixel's standard deviation: four standard errors of the test
    algebraic = ((mean * shot / 2).square() / shot - 0.375 * shot - read / shot - LEVELS) / sd
    assert algebraic.abs().max() > 3 * bias.abs().max()


def test_variance_is_1_from_about_10_photons_on() -> None:
    for shot, read in ((1e-3, 1e-5), (1e-2, 1e-4)):
        _, variance = stabilised(shot, read)
        bright = 10 * shot < LEVELS
        assert variance[bright] == pytest.approx(torch.ones(int(bright.sum())), rel=0.02)


def test_table_and_closed_form_meet() -> None:
    for shot, read in ((1e-3, 0.0), (1e-2, 1e-5), (1e-3, 1e-4)):
        y = torch.linspace(0.98, 1.02, 41, dtype=torch.float64) * TABLE_COUNTS * shot
        step = inverse(forward(y[None], shot, read), shot, read)[0].diff()
        assert (step > 0).all() and step.max() < 1.1 * step.min()


def test_levels_are_taken_one_a_picture() -> None:
    y = torch.rand(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
    shot, read = torch.tensor([1e-3, 1e-2]), torch.tensor([1e-5, 1e-4])
    z = forward(y, shot, read)
    for i in range(2):
        alone = slice(i, i + 1)
        assert torch.allclose(z[alone], forward(y[alone], float(shot[i]), float(read[i])))
        back = inverse(z[alone], float(shot[i]), float(read[i]))
        assert torch.allclose(inverse(z, shot, read)[alone], back, atol=1e-6)
        assert (back >= y[alone] - 1e-4).all()  # unbiased lies above the algebraic inverse, by about shot_var / 4


def test_signal_below_black_gives_black_and_white_noise_is_refused() -> None:
    assert torch.equal(inverse(forward(torch.full((1, 3), -1.0), 1e-3, 1e-5), 1e-3, 1e-5), torch.zeros(1, 3))
    with pytest.raises(ValueError, match="shot_var > 0"):
        forward(torch.zeros(1, 4), 0.0, 1e-5)
    with pytest.raises(ValueError, match="read_var >= 0"):
        inverse(torch.zeros(1, 4), 1e-3, -1e-5)
