"""The methods on one footing: the true camera wins, what is known helps, a seed is a start of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig
from rawaug.isp.model import DictionaryISP
from rawaug.paper import methods
from rawaug.paper.baselines import UPI, CycleISP, InvISP, Training, TunedUPI
from rawaug.paper.methods import (
    Fitted,
    cycle_psnr,
    fit_family,
    forward_psnr,
    is_method,
    mosaic_only_psnr,
    score_rows,
)

FrameOf = Callable[..., Pair]
TRAINING = Training(7.0, crop=32, batch=3)
DAYLIGHT, LAMPS = (2.0, 1.0, 1.5), (1.2, 1.0, 2.6)


def test_a_shipped_isp_is_a_method_and_is_not_fitted(frame_of: FrameOf, tmp_path: Path) -> None:
    frame = frame_of("one", size=(64, 96))
    relabelled = replace(frame, clean=replace(frame.clean, cfa=CFA.RGGB))
    universal = DictionaryISP.from_pretrained("universal-small")
    universal.save(tmp_path / "own.safetensors")
    for name in ("universal-small", str(tmp_path / "own.safetensors")):
        assert is_method(name)
        fitted = fit_family(name, [relabelled], FitConfig(), TRAINING)
        assert isinstance(fitted.model, DictionaryISP) and fitted.seconds == 0.0
        assert torch.equal(fitted.model.colour.atoms(), universal.colour.atoms())
    assert not is_method("universal-tiny")
    rows = rows_of(fitted.model, relabelled, 1)
    assert rows["samples"] > rows["blind"], "readings weigh tone curves as well"
    with pytest.raises(ValueError, match="RGGB"):
        fit_family("universal-small", [frame], FitConfig(), TRAINING)


def rows_of(model: Any, pair: Pair, patches: int | None = None) -> dict[str, float]:
    rows: dict[str, float] = score_rows(Fitted(model, 0.0, 0), pair, patches)["rows"]
    return rows


def test_the_true_camera_scores_highest(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    pair = frame_of("daylight", size=(256, 512))  # two patches: the fall-off is that of the frame
    rows = rows_of(known_camera, pair)
    upi = rows_of(UPI(pair.cfa), pair)
    assert set(rows) == {"blind", "as-shot", "samples"} and set(upi) == {"blind", "as-shot"}
    assert min(rows["blind"], rows["as-shot"]) > 75.0  # the 12 bits alone
    with torch.no_grad():
        known_camera.colour.matrices.copy_(torch.eye(3)[None])
    assert upi["blind"] < rows_of(known_camera, pair)["blind"] < 40.0


@pytest.mark.parametrize("method", [UPI, TunedUPI, InvISP])
def test_the_shots_gains_take_the_place_of_the_methods_own(method: Any, frame_of: FrameOf) -> None:
    model = method(CFA.GRBG, blocks=2, growth=4) if method is InvISP else method(CFA.GRBG)
    if isinstance(model, TunedUPI):
        model.gains.copy_(torch.tensor([2.4, 1.2, 1.8]))
    daylight, lamps = (bayer.pack(made(model, frame_of("a", light), light), CFA.GRBG) for light in (DAYLIGHT, LAMPS))
    red, blue = ((daylight[0, k] / daylight[0, 1]).median() / (lamps[0, k] / lamps[0, 1]).median() for k in (0, 3))
    assert red.item() == pytest.approx(LAMPS[0] / DAYLIGHT[0], rel=0.02)
    assert blue.item() == pytest.approx(LAMPS[2] / DAYLIGHT[2], rel=0.02)
    frame = frame_of("a")
    unknown = replace(frame, clean=replace(frame.clean, white_balance=(1.0, 1.0, 1.0)))
    assert "as-shot" not in rows_of(model, unknown, 1), "no gains are known"


def made(model: Any, pair: Pair, light: tuple[float, float, float]) -> torch.Tensor:
    """The mosaic of a dim grey picture in the as-shot row of a frame of this light."""
    with torch.no_grad():
        mosaic: torch.Tensor = model.reverse(torch.full((1, 3, 8, 8), 0.5), methods.settings(model, pair)["as-shot"])
    return mosaic


def test_in_light_that_the_camera_does_not_expect_what_is_known_brings_it_back(
    known_camera: DictionaryISP, frame_of: FrameOf
) -> None:
    rows = rows_of(known_camera, frame_of("lamps", LAMPS, size=(64, 96)))
    assert rows["blind"] < 32.0
    assert rows["as-shot"] > 75.0 and rows["samples"] > 60.0  # what was given is exact, or 64 readings of 12 bits


def test_the_forward_pass_is_scored_under_its_own_choice_of_light(
    known_camera: DictionaryISP, frame_of: FrameOf
) -> None:
    known_camera.forward_encoders.gain.set_prior(torch.tensor([1.0, 0.0]))
    right, wrong = (forward_psnr(known_camera, frame_of("a", light)) for light in (DAYLIGHT, LAMPS))
    assert right is not None and wrong is not None and wrong < right - 3.0
    assert forward_psnr(UPI(), frame_of("a")) is None
    frame = frame_of("a")
    unknown = replace(frame, clean=replace(frame.clean, color_known=False))
    assert forward_psnr(known_camera, unknown) is None


FINE = torch.randint(30, 200, (3, 64, 96), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def test_a_cycle_loses_the_mosaic_and_nothing_else_in_a_camera_that_inverts_itself(known_camera: DictionaryISP) -> None:
    scores = cycle_psnr(Fitted(known_camera, 0.0, 0), [FINE, FINE])
    assert scores["cycle_without_mosaic"] > 80.0
    assert abs(scores["cycle_same_setting"] - mosaic_only_psnr([FINE], "GRBG")) < 3.0
    assert cycle_psnr(Fitted(UPI(), 0.0, 0), [FINE]) == {}


def test_the_cycle_goes_back_by_the_encoders_of_the_forward_pass(known_camera: DictionaryISP) -> None:
    known_camera.forward_encoders.gain.set_prior(torch.tensor([1.0, 0.0]))
    right = cycle_psnr(Fitted(known_camera, 0.0, 0), [FINE])
    assert right["cycle"] == pytest.approx(right["cycle_same_setting"], abs=0.01)

    known_camera.forward_encoders.gain.set_prior(torch.tensor([0.0, 1.0]))  # the other light
    wrong = cycle_psnr(Fitted(known_camera, 0.0, 0), [FINE])
    assert wrong["cycle_same_setting"] == pytest.approx(right["cycle_same_setting"], abs=0.01)
    assert wrong["cycle"] < right["cycle"] - 1.5


@torch.no_grad()
def test_networks_that_render_have_a_cycle_and_a_way_to_srgb(frame_of: FrameOf) -> None:
    pair = frame_of("one", size=(64, 96))
    for model in (InvISP("GRBG", blocks=2, growth=4), CycleISP("GRBG", features=8, groups=1, blocks=1)):
        assert cycle_psnr(Fitted(model, 0.0, 0), [FINE])["cycle"] > 3.0
        assert forward_psnr(model, pair) is not None
    half = CycleISP("GRBG", features=8, groups=1, blocks=1, both=False)
    assert cycle_psnr(Fitted(half, 0.0, 0), [FINE]) == {} and forward_psnr(half, pair) is None


def test_an_invertible_network_is_scored_on_its_own_rendering_too(frame_of: FrameOf) -> None:
    """Untrained, InvISP is a plain gamma camera: its own picture gives the RAW back but for the JPEG."""
    pair = frame_of("one", size=(64, 96))
    scores = score_rows(Fitted(InvISP("GRBG", blocks=2, growth=4), 0.0, 0), pair, None, balanced=True)
    assert set(scores["rows"]) == set(scores["balanced"]) == {"blind", "as-shot", "own"}
    assert scores["rows"]["own"] > scores["rows"]["as-shot"] + 3.0
    assert scores["balanced"]["own"] > scores["balanced"]["as-shot"] + 3.0
    assert "own" not in rows_of(UPI("GRBG"), pair)


def test_frames_that_a_shipped_isp_was_fitted_to_are_marked(known_camera: DictionaryISP, frame_of: FrameOf) -> None:
    known_camera.info["frames"] = ["seen"]
    for name in ("seen", "unseen"):
        scores = score_rows(Fitted(known_camera, 0.0, 0), frame_of(name, size=(64, 96)), 1)
        assert scores["known"] == (name == "seen")
