"""From the frames to dictionaries: each frame's own colour, clusters, reach, cameras apart, and the constants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import pytest
import torch
from scipy.optimize import nnls

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.config import ISPConfig
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.atoms import best_constants, reach_atoms, set_dictionaries, set_priors
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.fit.start import TIE, TIE_RANGE, FrameColour, fit_fall_off, least_squares, tie
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import Stages
from rawaug.metrics import psnr

QUICK = FitConfig(steps=0, curve_steps=20, pixels=2048, batch=512, shading="off")  # the curve is the start's
OTHER = torch.tensor([[0.8, 0.15, 0.05], [0.25, 0.5, 0.25], [0.1, 0.1, 0.8]])


def oracle_gains(isp: DictionaryISP, gains: tuple[float, float, float]) -> torch.Tensor:
    """Of all in the convex hull of the atoms, the inverse gains nearest to those of ``gains``, as a ratio to them."""
    inverse, wanted = 1 / isp.gain.channel_gains().detach().double(), 1 / torch.tensor(gains).double()
    one = 1e3 * torch.ones(1, len(inverse)).double()
    weights, _ = nnls(torch.cat([inverse.T, one]).numpy(), torch.cat([wanted, one[0, :1]]).numpy())
    return torch.as_tensor(weights) @ inverse / wanted


@pytest.fixture(scope="module")
def one_light(exact_pair: Callable[..., Pair]) -> list[Pair]:
    return [exact_pair(f"shot{k}", (1.7 + 0.01 * k, 1.0, 1.6), k) for k in range(2)]


def test_reach_brings_an_unseen_light_into_the_hull(one_light: list[Pair]) -> None:
    isp = fit_isp(one_light, QUICK, progress=False)
    assert (isp.config.colour_atoms, isp.config.gain_atoms) == (2, 10)
    for light in ((2.2, 1.0, 1.25), (1.35, 1.0, 2.1), (2.0, 1.0, 1.9)):
        torch.testing.assert_close(oracle_gains(isp, light), torch.ones(3).double(), atol=0.01, rtol=0)


def test_reach_atoms_are_corners_of_a_box_tetrahedron_first() -> None:
    corners = reach_atoms(8, 1.6).exp()
    assert corners[:, 1:].unique().tolist() == pytest.approx([1 / 1.6, 1.6])
    assert corners[:, 0].unique().tolist() == pytest.approx([1.6**-0.25, 1.6**0.25])
    assert len(corners.unique(dim=0)) == 8 and reach_atoms(0, 1.6).shape == (0, 3)
    torch.testing.assert_close(corners[:4].log().sum(0), torch.zeros(3))  # every four are about the mean


def test_two_cameras_in_one_fit_are_reported_apart_by_their_light(
    exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor
) -> None:
    first = [exact_pair(f"a{k}", (1.5 + 0.05 * k, 1.0, 2.0 - 0.05 * k), k, camera="A") for k in range(3)]
    second = [exact_pair(f"b{k}", (2.4, 1.0, 1.3), 3 + k, matrix=OTHER, camera="B") for k in range(3)]
    isp = fit_isp([*first, *second], QUICK, progress=False)
    torch.testing.assert_close(isp.colour.atoms()[3:], OTHER.expand(3, 3, 3), atol=0.02, rtol=0)
    for light, own, matrix in (((1.55, 1.0, 1.95), slice(3), camera_matrix), ((2.4, 1.0, 1.3), slice(3, 6), OTHER)):
        even = torch.full((1, 6), 1 / 6)
        assert isp.colour.weights_for(torch.tensor([light]), even)[0, own].sum() > 0.95
        unseen = exact_pair("unseen", light, 9, matrix=matrix)
        known = isp.reverse(unseen.srgb[None], white_balance=light)
        isp_of_all = isp.colour.spread.clone()
        isp.colour.spread.fill_(torch.inf)
        alike = isp.reverse(unseen.srgb[None], isp.with_white_balance(isp.choose(unseen.srgb[None]), light))
        isp.colour.spread.copy_(isp_of_all)
        scores = [psnr(result.raw, unseen.clean.mosaic[None]).item() for result in (known, alike)]
        assert scores[0] > 48.0 and scores[0] > scores[1] + 10.0


def test_frames_that_are_all_alike_are_clustered_without_a_word(exact_pair: Callable[..., Pair]) -> None:
    frames = [exact_pair("same", (1.6, 1.0, 1.5), 0)] * 3
    isp = fit_isp(frames, replace(QUICK, atoms=2), progress=False)
    torch.testing.assert_close(isp.colour.atoms()[0], isp.colour.atoms()[1])


def test_constants_serve_the_many_and_not_the_odd_one_out() -> None:
    inverse = torch.tensor([[1.0, 1.0, 1.0], [0.5, 1.0, 0.5]])
    wanted = torch.tensor([0.8, 0.8, 0.8, 0.52])[:, None] * torch.tensor([1.0, 0.0, 1.0])
    wanted[:, 1] = 1.0
    a = torch.tensor([0.1, 0.2, 0.3, 5.0])[:, None].expand(4, 3)  # the last has by far the largest error to offer
    weights = best_constants(a, wanted * a, inverse)
    torch.testing.assert_close(weights @ inverse, torch.tensor([0.8, 1.0, 0.8]), atol=0.005, rtol=0)


def test_clipped_readings_say_nothing_of_the_gains(
    exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor
) -> None:
    gains = (2.0, 1.0, 1.5)
    pair = exact_pair("shot", gains, 0)
    clipped = (torch.arange(pair.clean.mosaic.shape[-1]) % 8 < 4).expand_as(pair.clean.mosaic)
    srgb, raw = torch.where(clipped, 255, pair.srgb), torch.where(clipped, 1.0, pair.clean.mosaic)
    isp = DictionaryISP(ISPConfig(colour_atoms=1, gain_atoms=2, attention=False))
    with torch.no_grad():
        isp.colour.matrices.copy_(camera_matrix[None])
        isp.gain.log_gains.copy_(torch.tensor([[1.0, 2.0, 1.5], [1.0, 1.0, 1.0]]).log())
    samples, _ = sample_pixels(
        [replace(pair, clean=replace(pair.clean, mosaic=raw), srgb=srgb.to(torch.uint8))], 4096, seed=0
    )
    set_priors(isp, samples, FitConfig())
    torch.testing.assert_close(isp.choose(pair.srgb[None]).gains, torch.tensor([gains]), atol=0.02, rtol=0)


def test_the_knee_spares_highlights_only_where_the_camera_did(exact_pairs: list[Pair]) -> None:
    knees: list[float] = []
    for spared in (False, True):
        pairs = []
        for pair in exact_pairs[:2]:
            mean = pair.srgb.float().mean(0) / 255
            bright = (mean > 0.6).expand_as(pair.srgb)
            raw = torch.where(bright[:1], 1.0, pair.clean.mosaic) if spared else pair.clean.mosaic
            srgb = torch.where(bright, 255, pair.srgb).to(torch.uint8)
            pairs.append(replace(pair, clean=replace(pair.clean, mosaic=raw), srgb=srgb))
        knees.append(fit_isp(pairs, QUICK, progress=False).config.knee or 1.0)
    assert knees[0] > knees[1]


def test_many_frames_pass_the_networks_a_few_at_a_time(
    exact_pair: Callable[..., Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = [exact_pair(f"shot{k}", (1.7, 1.0, 1.6), k % 2) for k in range(40)]
    drawn = sample_pixels(frames, 512, seed=0)
    colour = FrameColour.from_product(torch.eye(3).expand(len(frames), 3, 3))
    isp = DictionaryISP(ISPConfig(colour_atoms=4, gain_atoms=4))
    counts: list[int] = []
    reverse = Stages.reverse

    def counted(stages: Stages, x: torch.Tensor, *args: Any) -> torch.Tensor:
        counts.append(len(x))
        return reverse(stages, x, *args)

    monkeypatch.setattr(Stages, "reverse", counted)
    set_dictionaries(isp, colour, drawn, FitConfig(prior_steps=1))
    assert max(counts) < len(frames) // 2  # a network's activations are some ten times as large as its picture
    assert sum(counts) % len(frames) == 0  # and each frame passes every time


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
    return psnr(
        isp.reverse(pair.srgb[None], white_balance=pair.clean.white_balance).raw, pair.clean.mosaic[None]
    ).item()


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
    mean, precision = fit_fall_off(linear, samples, least_squares(linear, samples))
    torch.testing.assert_close(precision, 0.8 * torch.eye(2), atol=0.1, rtol=0)
    torch.testing.assert_close(mean, torch.zeros(2), atol=0.1, rtol=0)


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
    frames = sample_pixels(exact_pairs, 8, seed=0)
    product = camera_matrix / frames.as_shot[:, :, None]
    assert tie(FrameColour.from_product(product), frames) < 1e-9
    product[1, 0] *= 1.02
    small = tie(FrameColour.from_product(product), frames)
    apart = frames._replace(shots=[shot._replace(camera=shot.name) for shot in frames.shots])
    assert small > 1e-6 > 1e-9 > tie(FrameColour.from_product(product), apart)
    product[1] = torch.rand(3, 3, generator=torch.Generator().manual_seed(0))
    assert small < tie(FrameColour.from_product(product), frames) < TIE * 12 * TIE_RANGE**2


def test_one_frame_whose_metadata_lie_does_not_spoil_the_others(
    exact_pairs: list[Pair], exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor
) -> None:
    liar = exact_pair("liar", (1.9, 1.0, 1.4), 5)
    liar = replace(liar, clean=replace(liar.clean, white_balance=(1.0, 1.0, 1.0)))
    isp = fit_isp([*exact_pairs, liar], replace(SHORT, steps=40), progress=False)
    torch.testing.assert_close(isp.colour.atoms(), camera_matrix.expand(4, 3, 3), atol=0.02, rtol=0)
    assert error_db(isp, exact_pair("unseen", (1.7, 1.0, 1.6), 9)) > 60.0


def test_a_frame_without_unclipped_pixels_is_named() -> None:
    white = torch.full((3, 64, 64), 255, dtype=torch.uint8)
    blown = Pair("IMG_1", RawFrame(torch.ones(1, 64, 64), CFA.RGGB, white_balance=(2.0, 1.0, 1.5)), white)
    with pytest.raises(ValueError, match=r"IMG_1: .*unclipped"):
        fit_isp([blown], FitConfig(pixels=256), progress=False)
