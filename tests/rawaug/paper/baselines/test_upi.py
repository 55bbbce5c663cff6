"""UPI against its formulas, as published and tuned."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.config import HIGHLIGHT_KNEE
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.functional import gamma_expand
from rawaug.paper.baselines import Training, fit_baseline
from rawaug.paper.baselines.upi import (
    GAMMA,
    LOG_MSE_EPS,
    UPI,
    SmoothstepISP,
    TunedUPI,
    UPIParams,
    camera_matrix,
    fit_product,
    inverse_smoothstep,
)


def flat(red: float, green: float, blue: float) -> torch.Tensor:
    return torch.tensor([red, green, blue])[None, :, None, None].expand(1, 3, 8, 8)


@given(st.floats(0.0, 1.0))
def test_the_inverse_undoes_the_tone_curve(value: float) -> None:
    x = inverse_smoothstep(torch.tensor(value, dtype=torch.float64))
    assert (x * x * (3.0 - 2.0 * x)).item() == pytest.approx(value, abs=1e-9)


def test_the_matrix_of_the_first_camera_by_hand() -> None:
    matrix = camera_matrix(torch.tensor([[1.0, 0.0, 0.0, 0.0]]))[0]
    torch.testing.assert_close(matrix[0], torch.tensor([0.82638, 0.29506, -0.12144]), atol=1e-4, rtol=0)


@given(st.lists(st.floats(0.01, 1.0), min_size=4, max_size=4))
def test_white_stays_white_in_every_mixture(weights: list[float]) -> None:
    torch.testing.assert_close(camera_matrix(torch.tensor([weights])).sum(2), torch.ones(1, 3))


def test_mid_grey_by_hand_with_the_mean_camera() -> None:
    raw = UPI("GRBG").reverse(flat(0.5, 0.5, 0.5))  # 0.5^2.2 = 0.21764; gains 1.25 x (2.15, 1, 1.7)
    cell = torch.tensor([[0.17411, 0.08098], [0.10242, 0.17411]])
    torch.testing.assert_close(raw[0, 0, :2, :2], cell, atol=1e-4, rtol=0)


def test_the_distributions_are_the_published_ones() -> None:
    matrix, gains = UPI().sample(20000, torch.Generator().manual_seed(0))
    red, blue = gains[:, 0] / gains[:, 1], gains[:, 2] / gains[:, 1]
    assert red.min() > 1.899 and red.max() < 2.401 and blue.min() > 1.499 and blue.max() < 1.901
    assert red.mean().item() == pytest.approx(2.15, abs=0.01) and blue.mean().item() == pytest.approx(1.7, abs=0.01)
    inverse = 1.0 / gains[:, 1]
    assert inverse.mean().item() == pytest.approx(0.8, abs=0.01) and inverse.std().item() == pytest.approx(
        0.1, abs=0.01
    )
    torch.testing.assert_close(matrix.mean(0), UPI().default_params(1).matrix[0], atol=0.01, rtol=0)


@pytest.mark.parametrize("cfa", list(CFA))
def test_parameters_replay_and_pictures_do_not_mix(cfa: CFA) -> None:
    upi, srgb = UPI(cfa), torch.rand(3, 3, 6, 10, generator=torch.Generator().manual_seed(1))
    params = upi.sample(3, torch.Generator().manual_seed(2))
    again = upi.sample(3, torch.Generator().manual_seed(2))
    raw = upi.reverse(srgb, params)
    assert torch.equal(raw, upi.reverse(srgb, again))
    alone = UPIParams(*(value[1:2] for value in params))
    torch.testing.assert_close(upi.reverse(srgb[1:2], alone), raw[1:2], atol=1e-6, rtol=0)
    assert not torch.equal(raw, upi.reverse(srgb))


MATRIX = torch.tensor([[0.7, 0.3, 0.0], [0.1, 0.8, 0.1], [0.0, 0.3, 0.7]])
GAINS = torch.tensor([2.0, 1.2, 1.6])


class Known(SmoothstepISP):
    """UPI's stages with the given gains."""

    name = "known"

    def __init__(self, gains: torch.Tensor) -> None:
        super().__init__("GBRG")
        self.gains = gains

    def default_params(self, batch: int) -> UPIParams:
        return UPIParams(MATRIX.expand(batch, 3, 3), self.gains.expand(batch, 3))


def shot(seed: int, digital: float = 1.0) -> Pair:
    generator = torch.Generator().manual_seed(seed)
    srgb = torch.randint(30, 200, (3, 64, 64), dtype=torch.uint8, generator=generator)
    raw = Known(digital * GAINS).reverse(srgb[None])[0]
    return Pair(f"shot{seed}", RawFrame(raw, CFA.GBRG, white_balance=(1.7, 1.0, 1.3)), srgb)


def test_alike_frames_give_the_camera() -> None:
    tuned = fit_baseline(TunedUPI("GBRG"), [shot(0), shot(1)], Training())
    torch.testing.assert_close(tuned.matrix.data, MATRIX, atol=1e-3, rtol=0)
    torch.testing.assert_close(tuned.gains.data, GAINS, atol=1e-2, rtol=0)
    pair = shot(2)
    torch.testing.assert_close(tuned.reverse(pair.srgb[None]), pair.clean.mosaic[None], atol=1e-3, rtol=0)


def test_of_three_frames_the_two_that_agree_are_followed_and_not_the_bright_one() -> None:
    tuned = fit_baseline(TunedUPI("GBRG"), [shot(0, 1.5), shot(1, 1.5), shot(2, 0.7)], Training())
    assert tuned.gains[1].item() / 1.2 == pytest.approx(1.5, abs=0.05)


def test_the_product_has_the_least_sum_of_the_logarithms_of_the_errors() -> None:
    samples, _ = sample_pixels([shot(0, 1.5), shot(1, 1.4), shot(2, 0.7)], 4096, 0)
    linear = gamma_expand(inverse_smoothstep(samples.srgb), GAMMA)
    below = samples.known * (linear.mean(1, keepdim=True) < HIGHLIGHT_KNEE)

    def objective(product: torch.Tensor) -> float:
        predicted = torch.einsum("ij,fjkp->fikp", product, linear.double())
        error = ((predicted - samples.target) ** 2 * below).sum((1, 2, 3)) / below.sum((1, 2, 3))
        return (error + LOG_MSE_EPS).log().sum().item()

    product = fit_product(linear, samples.target, samples.known)
    least = objective(product)
    for entry in range(9):
        step = torch.zeros(9).double()
        step[entry] = 0.01
        assert objective(product + step.reshape(3, 3)) > least < objective(product - step.reshape(3, 3))


def test_a_white_frame_is_refused() -> None:
    white = replace(shot(0), srgb=torch.full((3, 64, 64), 255, dtype=torch.uint8))
    with pytest.raises(ValueError, match="too few pixels"):
        fit_baseline(TunedUPI(), [white], Training())
