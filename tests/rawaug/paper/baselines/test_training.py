"""The one loop that fits them all."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.metrics import psnr
from rawaug.paper.baselines import UPI, CycleISP, InvertibleGrey, InvISP, TunedUPI, UNetISP, fit_baseline
from rawaug.paper.baselines.base import CropTrainedISP, _CropDrawer

SMALL: list[tuple[type[CropTrainedISP], dict[str, Any]]] = [
    (UNetISP, {"width": 4}),
    (CycleISP, {"features": 8, "groups": 1, "blocks": 1}),
    (InvISP, {"blocks": 2, "growth": 4}),
    (InvISP, {"blocks": 2, "growth": 4, "jpeg_quality": 90}),
    (InvertibleGrey, {"features": 8, "blocks": 1}),
]
QUICK: dict[str, Any] = {"crop": 32, "batch": 2, "progress": False}


@pytest.mark.parametrize("both", [True, False])
@pytest.mark.parametrize(("method", "settings"), SMALL)
def test_a_few_steps_lower_the_loss(
    method: type[CropTrainedISP], settings: dict[str, Any], both: bool, exact_pairs: list[Pair]
) -> None:
    model = method("BGGR", **settings)
    crops = _CropDrawer(exact_pairs, model.cfa, 32, 4, seed=99)(0, torch.device("cpu"))
    model.prepare(exact_pairs)
    before = model.loss(crops, both).item()
    fit_baseline(model, exact_pairs, steps=15, learning_rate=3e-3, both=both, **QUICK)
    assert model.loss(crops, both).item() < 0.9 * before
    assert model.info["steps"] == 15 and model.info["seconds"] > 0.0 and model.info["loss"] > 0.0
    assert not model.training


def test_the_same_seed_and_steps_give_the_same_weights(exact_pairs: list[Pair]) -> None:
    raws = []
    for seed in (0, 0, 1):
        model = fit_baseline(UNetISP(width=4), exact_pairs, steps=3, seed=seed, **QUICK)
        raws.append(model.reverse(exact_pairs[0].srgb[None]))
    assert torch.equal(raws[0], raws[1]) and not torch.equal(raws[0], raws[2])


def test_seconds_end_it_and_steps_are_counted(exact_pairs: list[Pair]) -> None:
    short = fit_baseline(UNetISP(width=4), exact_pairs, seconds=1e-6, **QUICK)
    assert short.info["steps"] == 1
    longer = fit_baseline(UNetISP(width=4), exact_pairs, seconds=0.4, steps=10**6, **QUICK)
    assert 1 < longer.info["steps"] < 10**6 and longer.info["seconds"] < 10.0


def test_upi_comes_back_as_it_is_and_tuned_upi_is_solved(exact_pairs: list[Pair]) -> None:
    assert fit_baseline(UPI(), exact_pairs).info["steps"] == 0
    alike = [replace(pair, raw=exact_pairs[0].raw, srgb=exact_pairs[0].srgb) for pair in exact_pairs]
    tuned = fit_baseline(TunedUPI("GRBG"), alike, seconds=1.0)
    assert tuned.info["steps"] == 1
    pair = exact_pairs[0]
    published = psnr(UPI("GRBG").reverse(pair.srgb[None]), pair.raw[None])
    assert psnr(tuned.reverse(pair.srgb[None]), pair.raw[None]) > published + 3.0


@pytest.mark.parametrize("cfa", list(CFA))
def test_crops_of_any_pattern_arrive_in_that_of_the_model(cfa: CFA, exact_pairs: list[Pair]) -> None:
    first = exact_pairs[0]
    mirrors = [replace(first, raw=bayer.mosaic(first.srgb / 255.0, own), cfa=own) for own in CFA]
    for step in range(4):
        crops = _CropDrawer(mirrors, cfa, 94, 4, seed=0)(step, torch.device("cpu"))
        assert torch.equal(bayer.mosaic(crops.srgb, cfa), crops.raw)
        assert crops.raw.shape == (4, 1, 94, 94) and crops.white_balance.shape == (4, 3)


def test_what_cannot_be_fitted_is_refused(exact_pairs: list[Pair]) -> None:
    apart = replace(exact_pairs[0], name="apart", registered=False)
    cases: list[tuple[list[Pair], dict[str, Any], str]] = [
        ([], {"steps": 1}, "no RAW-sRGB pair"),
        (exact_pairs, {}, "give seconds or steps"),
        (exact_pairs, {"steps": 0}, "give seconds or steps"),
        (exact_pairs, {"steps": 1, "crop": 33}, "crop must be even"),
        (exact_pairs, {"steps": 1, "crop": 96}, "shot0: 96 x 128 is smaller than 98"),
        ([apart], {"steps": 1}, "apart: RAW and sRGB are not registered"),
    ]
    for pairs, settings, message in cases:
        with pytest.raises(ValueError, match=message):
            fit_baseline(UNetISP(width=4), pairs, progress=False, **settings)
