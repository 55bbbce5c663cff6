"""The references' own noise: measured as it was made, less of it in binned ones, and said where it is much."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.frames import as_frames
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.figures import make_panels
from rawaug.evaluation.scores import Row, score, summary
from rawaug.evaluation.tables import PLAIN, make_table
from rawaug.evaluation.trials import (
    Trial,
    added_noise_note,
    make_trial,
    measure_own_noise,
    own_noise_note,
    training_noise_note,
)
from rawaug.io import RawFrame
from rawaug.noise import noise_model

SHOT, READ = 1e-4, 2e-6


def scene(size: int = 1024) -> torch.Tensor:
    """A mosaic of flat patches of many levels."""
    levels = torch.rand(1, 1, 16, 16, generator=torch.Generator().manual_seed(0)) * 0.5 + 0.02
    return F.interpolate(levels, (size, size))[0]


@pytest.fixture(scope="module")
def reference() -> Pair:
    clean = scene()
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    raw = clean + noise * bayer.noise_variance(clean, SHOT, READ).sqrt()
    return Pair("reference", RawFrame(raw, CFA.GRBG), torch.zeros(3, *clean.shape[1:], dtype=torch.uint8))


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_perfect_denoiser_is_left_with_the_references_own_noise(reference: Pair, factor: int) -> None:
    noise = noise_model((1e-2, 1e-4))
    trial = make_trial(measure_own_noise([reference]).binned(factor).middles(256)[0], noise)
    middle = as_frames([replace(reference, clean=RawFrame(scene(), CFA.GRBG))]).binned(factor).middles(256)[0]
    truth = bayer.pack(middle.clean.mosaic[None], CFA.GRBG)
    result = summary(score([RawDenoiser.of(lambda noisy: truth)], [trial]))
    assert result["own_noise"] == result["images"][0]["own_noise"] == pytest.approx(1.0, rel=0.1)
    assert own_noise_note({"perfect": result}).startswith("own noise of the references as a share of")
    added = bayer.noise_variance(middle.clean.mosaic, 1e-2, 1e-4).mean().item()
    assert trial.variance is not None and trial.variance.mean().item() == pytest.approx(added, rel=0.1)


def test_shares_are_of_the_squared_error() -> None:
    known = {"a": (40.0, 0.5), "b": (30.0, 0.1), "unmeasured": (10.0, None)}
    result = summary(Row("mine", name, "", "", "raw", psnr, own_noise=own) for name, (psnr, own) in known.items())
    assert [image.get("own_noise") for image in result["images"]] == [pytest.approx(0.5), pytest.approx(0.1), None]
    assert result["own_noise"] == pytest.approx(1.5e-4 / 1.1e-3)
    assert ": mine 14%; " in own_noise_note({"mine": result, "theirs": {"own_noise": 0.09}, "none": {}})
    assert own_noise_note({"theirs": {"own_noise": 0.09}}) == "" and "own_noise" not in summary([])


def test_a_score_that_keeps_noise_is_not_the_best_of_a_table() -> None:
    def runs(psnr: float, share: float) -> list[dict[str, Any]]:
        return [{"plain": {"images": [], "psnr": psnr, "own_noise": share, "psnr_noisy": 30.0}}]

    honest = {"first": runs(40.0, 0.4), "second": runs(39.0, 0.3)}
    *_, best = make_table(honest, None, PLAIN)
    assert ("first", 0) in best
    *_, best = make_table({**honest, "keeps": runs(41.0, 1.2)}, None, PLAIN)
    assert not best


def test_the_clean_picture_states_its_own_noise(reference: Pair) -> None:
    trial = make_trial(measure_own_noise([reference])[0].middle(64), noise_model((1e-2, 1e-4)))
    assert trial.own is not None
    caption = make_panels([], trial).captions["clean"]
    assert f"{-10 * math.log10(trial.own):.2f} dB" in caption and "own noise" in caption


def test_noise_as_weak_as_the_references_own_is_said() -> None:
    raw = torch.rand(1, 128, 128, generator=torch.Generator().manual_seed(0))
    texture = Pair("texture", RawFrame(raw, CFA.RGGB), torch.zeros(3, 128, 128, dtype=torch.uint8))
    assert measure_own_noise([texture])[0].clean.noise_profile is None, "no flat regions, no figure"

    def trial(own: float, added: float) -> Trial:
        return Trial(torch.zeros(1), torch.zeros(1), torch.full((1,), added), own=own)

    assert added_noise_note([]) == added_noise_note([trial(1e-5, 1e-3)]) == ""
    said = added_noise_note([trial(2e-5, 2e-5)])
    assert "100% of the variance" in said and "would score 47.0 dB" in said


def test_training_on_noisy_references_is_said_to_teach_their_noise(reference: Pair) -> None:
    as_strong, stronger = noise_model((SHOT, READ)), noise_model((100 * SHOT, 100 * READ))
    assert "real" in training_noise_note([reference], as_strong, ["real"])
    assert training_noise_note([reference], stronger, ["real"]) == ""
    assert training_noise_note([reference], as_strong, []) == training_noise_note([], as_strong, ["real"]) == ""
    assert training_noise_note([replace(reference, noisy=reference.clean)], as_strong, ["real"]) == ""
