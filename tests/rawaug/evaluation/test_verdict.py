"""Verdicts from paired differences: what must be recommended, what is undecided, and what must be said."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from rawaug.evaluation.tables import PLAIN, make_table
from rawaug.evaluation.verdict import paired_interval, verdict

NOISY = 30.0


def scores(psnr: Any, ssim: float | None = None, noisy: float = NOISY) -> dict[str, Any]:
    """A summary with these PSNRs of frames."""
    images = []
    for number, value in enumerate(np.atleast_1d(psnr)):
        image: dict[str, Any] = {"name": f"frame{number}", "psnr_noisy": noisy}
        if math.isfinite(value):
            image["psnr"] = float(value)
        if ssim is not None:
            image["ssim"] = ssim
        images.append(image)

    finite = [image["psnr"] for image in images if "psnr" in image]
    summary: dict[str, Any] = {"images": images, "psnr_noisy": noisy, "psnr": sum(finite) / len(finite)}
    if ssim is not None:
        summary["ssim"] = ssim
    return summary


def arm(*seeds: Any, **settings: Any) -> list[dict[str, Any]]:
    return [{"plain": scores(psnr, **settings)} for psnr in seeds]


BASE = np.linspace(34.0, 46.0, 9)
"""The PSNRs of a rival on nine frames, which differ far more than methods do."""
WIGGLE = 0.1 * np.cos(np.arange(9.0))
"""What frames do to the difference of two methods."""


def test_a_gain_on_every_frame_is_recommended_whatever_the_frames_are_like() -> None:
    use, sentence = verdict({"mine": arm(BASE + 0.5 + WIGGLE)}, {"small": scores(BASE)})
    assert use == "mine" and "+0.5" in sentence and "9 frames and 1 seed" in sentence


def test_where_all_are_below_their_input_the_input_is_used() -> None:
    use, sentence = verdict({"mine": arm(BASE + 0.5, noisy=50.0)}, {"small": scores(BASE, noisy=50.0)})
    assert use == "the noisy input" and "less" in sentence


@pytest.mark.parametrize("fault", [math.nan, math.inf])
def test_a_frame_without_a_number_in_one_arm_is_left_out_for_all(fault: float) -> None:
    """The mean over its own eight frames would be far higher: the ninth is the hardest."""
    mine = BASE - 0.3 + WIGGLE
    mine[0] = fault
    use, sentence = verdict({"mine": arm(mine)}, {"small": scores(BASE)})
    assert use == "small" and "1 frame without" in sentence


def test_one_frame_that_wins_against_eight_that_lose_decides_nothing() -> None:
    difference = np.array([-0.9] * 8 + [9.0])
    assert difference.mean() > 0.05
    assert verdict({"mine": arm(BASE + difference)}, {"small": scores(BASE)}).use == ""


def test_two_seeds_that_differ_by_ten_decibels_decide_nothing() -> None:
    flat = np.full(9, 40.0)
    assert verdict({"mine": arm(flat + 5, flat - 5)}, {"small": scores(flat - 0.1)}).use == ""
    assert verdict({"mine": arm(flat + 0.5, flat + 0.6)}, {"small": scores(flat - 0.1)}).use == "mine"


def test_a_small_gain_within_a_wide_spread_of_frames_decides_nothing() -> None:
    spread = np.random.default_rng(1).normal(size=100)
    spread = 2.0 * (spread - spread.mean()) / spread.std()
    rival = np.full(100, 40.0)
    use, sentence = verdict({"mine": arm(rival + 0.06 + spread)}, {"small": scores(rival)})
    assert use == "" and "+0.06" in sentence


def test_two_frames_that_disagree_decide_nothing() -> None:
    use, _ = verdict({"mine": arm([46.0, 34.2])}, {"small": scores([40.0, 40.0])})
    assert use == ""


def test_a_loss_of_ssim_is_said() -> None:
    use, sentence = verdict({"mine": arm(BASE + 0.1, ssim=0.80)}, {"small": scores(BASE, ssim=0.97)})
    assert use == "mine" and "SSIM is 0.170 lower" in sentence
    assert "SSIM" not in verdict({"mine": arm(BASE + 0.1, ssim=0.969)}, {"small": scores(BASE, ssim=0.97)}).sentence


def test_the_best_of_several_arms_must_be_better_by_more_than_one_alone() -> None:
    """Arms that were picked on the test frames have a wider interval, by the number of arms."""
    generator = np.random.default_rng(3)
    mine = 0.05 + 0.2 * generator.normal(size=20)
    mine += 0.05 - np.quantile(mine, 0.5) + 0.11
    rival = np.full(20, 40.0)
    low, _ = paired_interval(mine)
    wider, _ = paired_interval(mine, 1 - 0.05 / 4)
    assert wider < low
    mine += 0.05 - (low + wider) / 2

    alone = {"a": arm(rival + mine)}
    four = alone | {name: arm(rival + mine - 0.01) for name in "bcd"}
    assert verdict(alone, {"small": scores(rival)}).use == "a"
    assert verdict(four, {"small": scores(rival)}).use == ""


def test_one_frame_and_one_seed_decide_nothing() -> None:
    use, sentence = verdict({"mine": arm([42.0])}, {"small": scores([40.0])})
    assert use == "" and "one frame" in sentence


def test_arms_that_frames_and_seeds_do_not_tell_apart_are_named() -> None:
    arms = {"mine": arm(BASE + 0.5, BASE + 0.6), "equal": arm(BASE + 0.62, BASE + 0.45), "weak": arm(BASE, BASE)}
    use, sentence = verdict(arms, {"small": scores(BASE - 1)})
    assert use == "mine" and "equal is as good" in sentence and "weak" not in sentence


def test_the_interval_holds_the_mean_as_often_as_it_says() -> None:
    """With as few as three frames, too, of which resamples alone spread too little."""
    generator = np.random.default_rng(0)
    for frames in (3, 12):
        held = 0
        for _ in range(200):
            low, high = paired_interval(generator.normal(1.0, 1.0, frames))
            held += low <= 1.0 <= high
        assert held / 200 == pytest.approx(0.95, abs=0.04)


def test_methods_that_the_frames_do_not_tell_apart_share_the_mark() -> None:
    arms = {"a": arm(BASE + 0.5 + WIGGLE), "b": arm(BASE + 0.49 - WIGGLE), "c": arm(BASE + WIGGLE)}
    *_, best = make_table(arms, None, PLAIN)
    assert {name for name, column in best if column == 0} == {"a", "b"}
    *_, best = make_table({"a": arm([41.0]), "b": arm([40.0])}, None, PLAIN)
    assert not best, "one frame decides nothing"
