"""What all methods keep: one interface, published sizes, their own randomness; and how they are fitted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.metrics import psnr
from rawaug.paper.baselines import (
    BASELINES,
    UPI,
    BaselineISP,
    CycleISP,
    InvertibleGrey,
    InvISP,
    JpegInvISP,
    TunedUPI,
    UNetISP,
    fit_baseline,
)
from rawaug.paper.baselines.base import CropTrainedISP, Training, mean_curve, random_crops
from rawaug.paper.methods import reverse_parameters

SMALL: dict[str, dict[str, Any]] = {
    "upi": {},
    "upi-tuned": {},
    "curve-matrix": {},
    "unet": {"width": 4},
    "cycleisp": {"features": 8, "groups": 1, "blocks": 1},
    "invisp": {"blocks": 2, "growth": 4},
    "invisp-jpeg": {"blocks": 2, "growth": 4},
    "invgrey": {"features": 4, "blocks": 1},
}
NETWORKS = [name for name in SMALL if SMALL[name]]


def small(name: str, cfa: CFA | str = "RGGB") -> BaselineISP:
    return BASELINES[name](cfa, **SMALL[name])


@pytest.mark.parametrize(
    ("method", "millions"), [(UNetISP, 11.77), (CycleISP, 3.14), (InvISP, 1.41), (InvertibleGrey, 0.74)]
)
def test_published_number_of_parameters(method: type[BaselineISP], millions: float) -> None:
    with torch.device("meta"):
        assert reverse_parameters(method()) / 1e6 == pytest.approx(millions, abs=0.02)


@pytest.mark.parametrize("name", NETWORKS)
def test_weights_come_from_the_seed_alone(name: str) -> None:
    before = torch.get_rng_state()
    first, same, other = (BASELINES[name](seed=seed, **SMALL[name]) for seed in (1, 1, 2))
    assert torch.equal(before, torch.get_rng_state())
    states = [torch.cat([value.flatten() for value in model.state_dict().values()]) for model in (first, same, other)]
    assert torch.equal(states[0], states[1]) and not torch.equal(states[0], states[2])


@pytest.mark.parametrize("name", list(BASELINES))
def test_every_method_makes_raw_through_one_interface(name: str) -> None:
    model, srgb = small(name, "GBRG"), torch.rand(2, 3, 16, 20, generator=torch.Generator().manual_seed(0))
    assert model.name == name and model.cfa == CFA("GBRG") and model.info == {}
    with torch.no_grad():
        drawn = [model.draw(srgb, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
        raw, linear = model.reverse(srgb), model.unprocess(srgb).clamp(0.0, 1.0)
        assert raw.shape == drawn[0].shape == (2, 1, 16, 20)
        assert torch.equal(raw[:, 0, 0::2, 1::2], linear[:, 2, 0::2, 1::2]), "a site keeps its own channel"
        assert torch.equal(raw[:, 0, 0::2, 0::2], linear[:, 1, 0::2, 0::2])
        assert torch.equal(drawn[0], drawn[1]) and torch.equal(drawn[0], drawn[2]) == (name != "upi")


TINY: list[tuple[type[CropTrainedISP], dict[str, Any]]] = [
    (UNetISP, {"width": 4}),
    (CycleISP, {"features": 8, "groups": 1, "blocks": 1}),
    (CycleISP, {"features": 8, "groups": 1, "blocks": 1, "both": False}),
    (InvISP, {"blocks": 2, "growth": 4}),
    (JpegInvISP, {"blocks": 2, "growth": 4}),
    (InvertibleGrey, {"features": 8, "blocks": 1}),
]
QUICK = Training(crop=32, batch=2, progress=False)


@pytest.mark.parametrize(("method", "settings"), TINY)
def test_a_few_steps_lower_the_loss(
    method: type[CropTrainedISP], settings: dict[str, Any], exact_pairs: list[Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(method, "learning_rate", 3e-3)
    model = method("BGGR", **settings)
    crops = random_crops(exact_pairs, model.cfa, Training(crop=32, seed=99), 0)
    model.prepare(exact_pairs)
    before = model.loss(crops).item()
    fit_baseline(model, exact_pairs, replace(QUICK, steps=15))
    assert model.loss(crops).item() < 0.9 * before
    assert model.info["steps"] == 15 and model.info["seconds"] > 0.0 and model.info["loss"] > 0.0
    assert len(model.info["curve"]) == 10
    assert not model.training


def test_seconds_end_it_and_steps_are_counted(exact_pairs: list[Pair]) -> None:
    short = fit_baseline(UNetISP(width=4), exact_pairs, replace(QUICK, seconds=1e-6))
    assert short.info["steps"] == 1
    longer = fit_baseline(UNetISP(width=4), exact_pairs, replace(QUICK, seconds=0.4, steps=10**6))
    assert 1 < longer.info["steps"] < 10**6 and longer.info["seconds"] < 10.0


def test_upi_comes_back_as_it_is_and_tuned_upi_is_solved(exact_pairs: list[Pair]) -> None:
    assert fit_baseline(UPI(), exact_pairs, Training()).info["steps"] == 0
    alike = []
    for pair in exact_pairs:
        clean = replace(pair.clean, mosaic=exact_pairs[0].clean.mosaic)
        alike.append(replace(pair, clean=clean, srgb=exact_pairs[0].srgb))
    tuned = fit_baseline(TunedUPI("GRBG"), alike, Training(seconds=1.0))
    assert tuned.info["steps"] == 1
    pair = exact_pairs[0]
    published = psnr(UPI("GRBG").reverse(pair.srgb[None]), pair.clean.mosaic[None])
    assert psnr(tuned.reverse(pair.srgb[None]), pair.clean.mosaic[None]) > published + 3.0


@pytest.mark.parametrize("cfa", list(CFA))
def test_crops_of_any_pattern_arrive_in_that_of_the_model(cfa: CFA, exact_pairs: list[Pair]) -> None:
    first = exact_pairs[0]
    mirrors = []
    for own in CFA:
        clean = replace(first.clean, mosaic=bayer.mosaic(first.srgb / 255.0, own), cfa=own)
        mirrors.append(replace(first, clean=clean))
    for step in range(4):
        crops = random_crops(mirrors, cfa, Training(crop=94), step)
        assert torch.equal(bayer.mosaic(crops.srgb, cfa), crops.raw)
        assert crops.raw.shape == (4, 1, 94, 94) and crops.white_balance.shape == (4, 3)


def test_methods_that_cannot_render_say_so(exact_pairs: list[Pair]) -> None:
    raw = exact_pairs[0].clean.mosaic[None]
    for name in SMALL:
        model = small(name, "GRBG")
        if model.renders:
            picture = model(raw, exact_pairs[0].srgb[None] if name == "cycleisp" else None)
            assert picture.shape == (1, 3, 96, 128) and picture.min() >= 0.0 and picture.max() <= 1.0
        else:
            with pytest.raises(ValueError, match="converts"):
                model(raw)


def test_the_curve_of_a_training_has_the_means_of_its_parts() -> None:
    assert mean_curve([3.0, 2.0], points=10) == [3.0, 2.0]
    assert mean_curve([6.0, 4.0, 2.0, 2.0, 1.0, 1.0], points=3) == [5.0, 2.0, 1.0]


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
            fit_baseline(UNetISP(width=4), pairs, Training(progress=False, **settings))
