"""Tone as a curve: fitted, monotone, and taken where frames left out say that it is better."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fast import BakedISP
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import decibels
from rawaug.isp.fit.pipeline import with_better_tone
from rawaug.isp.fit.samples import FrameSummary, PixelSamples, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr

QUICK = FitConfig(steps=5, curve_steps=40, pixels=1024, batch=256, shading="off", tone="curve", encoders="off")


def bent(x: torch.Tensor) -> torch.Tensor:
    """No standard's curve: it lifts the shadows and rolls the highlights off."""
    return 0.5 * x**2.2 + 0.5 * (x * x * (3.0 - 2.0 * x)) ** 2


def test_a_curve_that_no_standard_has_is_found_and_serves_every_pass(exact_pair: Callable[..., Pair]) -> None:
    balances = [(1.5, 1.0, 2.0), (2.0, 1.0, 1.5)]
    pairs = [exact_pair(f"shot{k}", balance, k, curve=bent) for k, balance in enumerate(balances)]
    isp = fit_isp(pairs, QUICK, progress=False)
    assert isp.config.stages == ("curve", "colour", "gains") and isp.tone is not None
    assert (isp.tone.curves.diff(dim=1) >= 0).all() and isp.tone.curves[0, 0] == 0 and isp.tone.curves[0, -1] == 1
    unseen = exact_pair("unseen", (1.3, 1.0, 2.2), 9, curve=bent)
    back = isp.reverse(unseen.srgb[None], white_balance=unseen.white_balance)
    assert psnr(back.raw, unseen.raw[None]).item() > 52.0
    baked = BakedISP(isp)(unseen.srgb[None], back.params)
    torch.testing.assert_close(
        baked, torch.nn.functional.pixel_unshuffle(back.raw, 2)[:, [1, 0, 3, 2]], atol=2e-4, rtol=0
    )
    ahead = isp.forward(unseen.raw[None], white_balance=unseen.white_balance).srgb
    assert psnr(ahead, unseen.srgb[None] / 255.0).item() > 38.0


def refitted(gains: dict[str, float]) -> Callable[..., DictionaryISP]:
    """ISPs whose gains are off by a factor that depends on the tone alone."""

    def refit(frames: list[int], part: str, config: FitConfig) -> DictionaryISP:
        assert len(frames) == 1 and config.tone in part
        isp = DictionaryISP()
        with torch.no_grad():
            isp.gain.log_gains.fill_(gains[config.tone])
            isp.colour.neutral.fill_(gains[config.tone])
        return isp

    return refit


@pytest.fixture(scope="module")
def two_frames(exact_pairs: list[Pair]) -> tuple[PixelSamples, list[FrameSummary]]:
    return sample_pixels(exact_pairs[:2], 256, 0)


@pytest.mark.parametrize("better", ["learned", "curve"])
def test_auto_takes_what_is_better_on_frames_left_out(
    two_frames: tuple[PixelSamples, list[FrameSummary]], better: str
) -> None:
    off = {"learned": 1.0, "curve": 1.0} | {better: 0.0}
    decided, gain = with_better_tone(*two_frames, replace(QUICK, tone="auto"), refitted(off))
    assert decided.tone == better and gain is not None and (gain > 0) == (better == "curve")


def test_what_is_asked_for_is_not_tried_and_one_frame_cannot_decide(
    two_frames: tuple[PixelSamples, list[FrameSummary]],
) -> None:
    samples, shots = two_frames
    assert with_better_tone(samples, shots, QUICK, refitted({})) == (QUICK, None)
    alone = replace(QUICK, tone="auto")
    assert with_better_tone(samples, shots[:1], alone, refitted({})) == (replace(alone, tone="learned"), None)


def test_frames_are_judged_under_their_own_gains(two_frames: tuple[PixelSamples, list[FrameSummary]]) -> None:
    isp = DictionaryISP()
    with torch.no_grad():
        isp.gain.log_gains.fill_(1.0)
    assert decibels(isp, *two_frames, [0, 1], as_shot=True) > decibels(isp, *two_frames, [0, 1]) + 3.0
