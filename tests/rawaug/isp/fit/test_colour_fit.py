"""Every frame's own colour: the curve in two numbers, the mask, and what draws the frames of a camera together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.fit.start import TIE, TIE_RANGE, FrameColour, Tie, fall_off, least_squares
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr

CURVE = FitConfig(steps=0, pixels=2048, batch=512, prior_steps=100)
SHORT = replace(CURVE, curve_steps=50)
WB = (1.6, 1.0, 1.5)


def srgb_curve(x: torch.Tensor) -> torch.Tensor:
    """IEC 61966-2-1."""
    return torch.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def bt709_curve(x: torch.Tensor) -> torch.Tensor:
    """ITU-R BT.709-6, table 1."""
    return torch.where(x < 0.081, x / 4.5, ((x + 0.099) / 1.099) ** (1 / 0.45))


def s_curve(x: torch.Tensor) -> torch.Tensor:
    """A curve that two numbers cannot follow."""
    return (3 * x**2 - 2 * x**3) ** 1.8


def error_db(isp: DictionaryISP, pair: Pair) -> float:
    return psnr(isp.reverse(pair.srgb[None], white_balance=pair.white_balance).raw, pair.raw[None]).item()


@pytest.mark.parametrize(
    ("curve", "gammas", "toes"), [(srgb_curve, (2.21, 2.45), (0.01, 0.06)), (bt709_curve, (2.15, 2.25), (0.08, 0.10))]
)
def test_two_numbers_go_towards_the_curves_of_the_standards(
    exact_pair: Callable[..., Pair],
    curve: Callable[..., torch.Tensor],
    gammas: tuple[float, float],
    toes: tuple[float, float],
) -> None:
    """gamma 2.4 and toe 0.055 / 1.055 of sRGB, 1 / 0.45 and 0.099 / 1.099 of BT.709, along a flat valley."""
    pairs = [exact_pair(f"shot{k}", WB, k, curve=curve) for k in range(2)]
    isp = fit_isp(pairs, CURVE, progress=False)
    toe = cast(Any, isp.stages["tone"]).reverse(torch.zeros(1, 3, 1, 1), None).flatten()
    assert gammas[0] < cast(Any, isp.stages["gamma"]).reverse_gamma < gammas[1]
    assert (toe > toes[0]).all() and (toe < toes[1]).all()
    assert error_db(isp, exact_pair("unseen", WB, 9, curve=curve)) > 55.0


def test_least_squares_finds_the_matrix_of_each_frame(exact_pairs: list[Pair], camera_matrix: torch.Tensor) -> None:
    samples, shots = sample_pixels(exact_pairs, 2048, seed=0)
    product = least_squares(samples.srgb**2.2, samples)
    expected = camera_matrix / torch.tensor([shot.white_balance for shot in shots])[:, :, None]
    torch.testing.assert_close(product, expected, atol=1e-4, rtol=0)
    colour = FrameColour.from_product(product)
    torch.testing.assert_close(colour.product(), product)
    torch.testing.assert_close(colour.params().matrix.abs().sum(2), torch.ones(3, 3))
    matrix, neutral = colour.neutral(torch.tensor([shot.white_balance for shot in shots]))
    torch.testing.assert_close(matrix, camera_matrix.expand(3, 3, 3), atol=1e-4, rtol=0)  # its rows sum to 1
    torch.testing.assert_close(neutral, torch.zeros(3, 3), atol=1e-4, rtol=0)


def test_fall_off_is_measured(exact_pair: Callable[..., Pair]) -> None:
    samples, _ = sample_pixels([exact_pair("shot", WB, 0, fall_off=0.8)], 4096, seed=0)
    linear = samples.srgb**2.2
    mean, precision = fall_off(linear, samples, least_squares(linear, samples))
    torch.testing.assert_close(precision, 0.8 * torch.eye(2), atol=0.1, rtol=0)
    torch.testing.assert_close(mean, torch.zeros(2), atol=0.1, rtol=0)


def test_a_mask_is_kept_where_there_is_fall_off(exact_pair: Callable[..., Pair]) -> None:
    pairs = [exact_pair(f"shot{k}", WB, k, fall_off=0.8) for k in range(2)]
    unseen = exact_pair("unseen", WB, seed=9, fall_off=0.8)
    with_mask = fit_isp(pairs, SHORT, progress=False)
    without = fit_isp(pairs, replace(SHORT, shading="off"), progress=False)
    assert "shading" in with_mask.config.stages and "shading" not in without.config.stages
    torch.testing.assert_close(
        cast(Any, with_mask.stages["shading"]).mask.precision.diagonal(), torch.full((2,), 0.8), atol=0.1, rtol=0
    )
    assert error_db(with_mask, unseen) > error_db(without, unseen) + 6.0


def test_content_that_goes_with_the_place_feigns_no_fall_off(exact_pair: Callable[..., Pair]) -> None:
    y, x = torch.meshgrid(torch.linspace(-1, 1, 96), torch.linspace(-1, 1, 128), indexing="ij")
    light = 0.9 - 0.35 * (x**2 + y**2)
    pairs = []
    for k in range(2):
        colours = 0.7 + 0.3 * torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(k))
        pairs.append(exact_pair(f"shot{k}", WB, k, curve=s_curve, picture=light * colours))
    on = fit_isp(pairs, replace(SHORT, shading="on"), progress=False)
    assert cast(Any, on.stages["shading"]).mask.precision.diagonal().max() > 0.02
    auto = fit_isp(pairs, SHORT, progress=False)
    assert "shading" not in auto.config.stages
    off = fit_isp(pairs, replace(SHORT, shading="off"), progress=False)
    assert torch.equal(
        cast(Any, auto.stages["gamma"]).reverse_gamma, cast(Any, off.stages["gamma"]).reverse_gamma
    )  # nothing of the trial is left


def test_a_tie_is_within_a_camera_and_bounded(exact_pairs: list[Pair], camera_matrix: torch.Tensor) -> None:
    _, shots = sample_pixels(exact_pairs, 8, seed=0)
    product = camera_matrix / torch.tensor([shot.white_balance for shot in shots])[:, :, None]
    assert Tie(shots)(FrameColour.from_product(product)) < 1e-9
    product[1, 0] *= 1.02
    small = Tie(shots)(FrameColour.from_product(product))
    apart = [shot._replace(camera=shot.name) for shot in shots]
    assert small > 1e-6 > 1e-9 > Tie(apart)(FrameColour.from_product(product))
    product[1] = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    assert small < Tie(shots)(FrameColour.from_product(product)) < TIE * 12 * TIE_RANGE**2


def test_one_frame_whose_metadata_lie_does_not_spoil_the_others(
    exact_pairs: list[Pair], exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor
) -> None:
    liar = replace(exact_pair("liar", (1.9, 1.0, 1.4), 5), white_balance=(1.0, 1.0, 1.0))
    isp = fit_isp([*exact_pairs, liar], replace(SHORT, steps=40), progress=False)
    torch.testing.assert_close(isp.colour.atoms(), camera_matrix.expand(4, 3, 3), atol=0.02, rtol=0)
    assert error_db(isp, exact_pair("unseen", (1.7, 1.0, 1.6), 9)) > 60.0
