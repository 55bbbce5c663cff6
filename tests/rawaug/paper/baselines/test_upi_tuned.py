"""Tuned UPI finds the camera that it can be, and the three ways of tuning differ as they should."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import get_args

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.isp.fit.samples import sample_pixels
from rawaug.paper.baselines.upi import LOG_MSE_EPS, Criterion, Moments, SmoothstepISP, TunedUPI, UPIParams

MATRIX = torch.tensor([[0.7, 0.3, 0.0], [0.1, 0.8, 0.1], [0.0, 0.3, 0.7]])
GAINS = torch.tensor([2.0, 1.2, 1.6])


class Known(SmoothstepISP):
    """UPI's stages with the given gains."""

    name = "known"
    trainable = False

    def __init__(self, gains: torch.Tensor) -> None:
        super().__init__("GBRG")
        self.gains = gains

    def default_params(self, batch: int) -> UPIParams:
        return UPIParams(MATRIX.expand(batch, 3, 3), self.gains.expand(batch, 3))


def shot(seed: int, digital: float = 1.0) -> Pair:
    generator = torch.Generator().manual_seed(seed)
    srgb = torch.randint(30, 200, (3, 64, 64), dtype=torch.uint8, generator=generator)
    raw = Known(digital * GAINS).reverse(srgb[None])[0]
    return Pair(f"shot{seed}", srgb, raw, CFA.GBRG, (1.7, 1.0, 1.3), torch.eye(3))


@pytest.mark.parametrize("criterion", ["log", "mse", "mean"])
def test_alike_frames_give_the_camera(criterion: Criterion) -> None:
    tuned = TunedUPI("GBRG", criterion).tune([shot(0), shot(1)])
    torch.testing.assert_close(tuned.matrix.data, MATRIX, atol=1e-3, rtol=0)
    torch.testing.assert_close(tuned.gains.data, GAINS, atol=1e-2, rtol=0)
    pair = shot(2)
    torch.testing.assert_close(tuned.reverse(pair.srgb[None]), pair.raw[None], atol=1e-3, rtol=0)


def test_of_three_frames_the_logarithm_follows_the_two_that_agree_and_mse_the_bright_one() -> None:
    pairs = [shot(0, 1.5), shot(1, 1.5), shot(2, 0.7)]
    gains = {c: TunedUPI("GBRG", c).tune(pairs).gains[1].item() / 1.2 for c in get_args(Criterion)}
    assert gains["log"] == pytest.approx(1.5, abs=0.05)
    assert gains["mse"] < gains["log"] - 0.2
    assert gains["mean"] == pytest.approx((1.5 + 1.5 + 0.7) / 3, abs=0.01)


def test_no_round_raises_the_sum_of_logarithms() -> None:
    moments = Moments.of(sample_pixels([shot(k, 0.8 + 0.2 * k) for k in range(4)], 4096, 0)[0])
    product, losses = moments.solve(torch.ones(4).double()), []
    for _ in range(20):
        error = moments.error(product) + LOG_MSE_EPS
        losses.append(error.log().sum().item())
        product = moments.solve(1.0 / error)
    assert losses[-1] < losses[0] - 0.1
    assert all(later <= earlier + 1e-9 for earlier, later in pairwise(losses))


def test_the_moments_give_the_error() -> None:
    samples, _ = sample_pixels([shot(0)], 4096, 0)
    moments = Moments.of(samples)
    product = torch.diag(1.0 / (1.3 * GAINS)) @ MATRIX
    predicted = Known(1.3 * GAINS).unprocess(samples.srgb)
    expected = ((predicted - samples.target) ** 2 * samples.known).sum() / samples.known.sum()
    assert moments.error(product.double()).item() == pytest.approx(expected.item(), rel=1e-3)


def test_a_bad_criterion_and_a_white_frame_are_refused() -> None:
    with pytest.raises(ValueError, match="use one of log, mse, mean"):
        TunedUPI(criterion="best")  # type: ignore[arg-type]
    white = replace(shot(0), srgb=torch.full((3, 64, 64), 255, dtype=torch.uint8))
    with pytest.raises(ValueError, match="too few pixels"):
        TunedUPI().tune([white])
