"""A fit recovers a known camera; tone is a curve where that is better on frames left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.description import tone_table
from rawaug.isp.fast import BakedISP
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import Descent
from rawaug.isp.fit.pipeline import choose_tone
from rawaug.isp.fit.samples import FitFrames, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr

QUICK = FitConfig(steps=60, pixels=4096, batch=1024, prior_steps=100)
TINY = FitConfig(steps=3, curve_steps=30, pixels=512, batch=128, shading="off", prior_steps=50)


def error_db(isp: DictionaryISP, pair: Pair, white_balance: tuple[float, ...] | None = None) -> float:
    raw = isp.reverse(pair.srgb[None], white_balance=white_balance).raw
    return psnr(raw, pair.clean.mosaic[None]).item()


def test_it_recovers_matrix_and_gains(
    fitted: DictionaryISP, exact_pairs: list[Pair], camera_matrix: torch.Tensor
) -> None:
    torch.testing.assert_close(fitted.colour.atoms(), camera_matrix.expand(3, 3, 3), atol=0.02, rtol=0)
    ratios = fitted.gain.atoms()[:3, 1:] / torch.tensor([p.clean.white_balance for p in exact_pairs])[:, [0, 2]]
    torch.testing.assert_close(ratios, torch.ones(3, 2), atol=0.02, rtol=0)


def test_known_gains_give_an_unseen_shot(fitted: DictionaryISP, exact_pair: Callable[..., Pair]) -> None:
    unseen = exact_pair("unseen", (1.3, 1.0, 2.2), seed=9)
    assert error_db(fitted, unseen, unseen.clean.white_balance) > 55.0
    assert error_db(fitted, unseen) < 40.0  # blind, the gains cannot be guessed


def test_the_forward_pass_renders_the_picture(exact_pair: Callable[..., Pair]) -> None:
    pair = exact_pair("shot", (1.6, 1.0, 1.5), 0, curve=lambda x: (3 * x**2 - 2 * x**3) ** 1.8)
    isp = fit_isp([pair], replace(QUICK, batch=512, shading="off"), progress=False)
    rendered = isp.forward(pair.clean.mosaic[None], white_balance=pair.clean.white_balance).srgb
    assert psnr(rendered, pair.srgb[None] / 255.0).item() > 33.0  # gamma alone: 25


def test_noisy_frames_give_the_constants_of_clean_ones(exact_pair: Callable[..., Pair]) -> None:
    balances = [(1.5, 1.0, 2.0), (1.7, 1.0, 1.7), (2.0, 1.0, 1.5)]
    pairs = [exact_pair(f"shot{k}", balance, k, shot_var=5e-3) for k, balance in enumerate(balances)]
    config = replace(QUICK, steps=10, curve_steps=50, prior_steps=100, pixels=8192, shading="off")
    clean = fit_isp(pairs, config, progress=False)
    unread = []  # the clean RAW is not seen
    for pair in pairs:
        unknown = replace(pair.clean, mosaic=torch.full_like(pair.clean.mosaic, torch.nan))
        unread.append(replace(pair, clean=unknown))
    noisy = fit_isp(unread, replace(config, noisy=True), progress=False)
    srgb = pairs[0].srgb[None]
    torch.testing.assert_close(noisy.choose(srgb).gains, clean.choose(srgb).gains, rtol=0.03, atol=0)
    torch.testing.assert_close(noisy.choose(srgb).matrix, clean.choose(srgb).matrix, rtol=0, atol=0.03)


def test_an_unregistered_pair_is_fitted_over_blocks(
    exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor
) -> None:
    wide = exact_pair("jpeg", (1.6, 1.0, 1.5), 0, size=(192, 256))
    raw, srgb = wide.clean.mosaic[:, 8:-8, 8:-8], wide.srgb[:, 4:-12, 14:-2]  # 4 pixels down, 6 to the left
    jpeg = replace(wide, clean=replace(wide.clean, mosaic=raw), srgb=srgb, registered=False)
    isp = fit_isp([jpeg], replace(QUICK, batch=256, shading="off"), progress=False)
    torch.testing.assert_close(isp.colour.atoms()[0], camera_matrix, atol=0.05, rtol=0)
    assert error_db(isp, exact_pair("unseen", (1.6, 1.0, 1.5), 9)) > 40.0


def test_a_report_sees_the_isp_as_it_would_be_and_changes_nothing(
    exact_pairs: list[Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Descent, "report_steps", 2)
    scores = []

    def report(isp: DictionaryISP) -> str:
        scores.append(error_db(isp, exact_pairs[0], exact_pairs[0].clean.white_balance))
        return f"{scores[-1]:.1f} dB"

    last = fit_isp(exact_pairs[:1], TINY, progress=False, report=report)
    assert scores[-1] == pytest.approx(error_db(last, exact_pairs[0], exact_pairs[0].clean.white_balance), abs=0.02)
    seen = last.state_dict()
    unseen = fit_isp(exact_pairs[:1], TINY, progress=False).state_dict()
    assert len(scores) == 2 and min(scores) > 45.0  # after 2 and 3 steps
    assert all(torch.equal(seen[key], unseen[key]) for key in seen)


def test_no_frame_and_a_white_frame_are_refused(exact_pairs: list[Pair], camera_matrix: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="pair"):
        fit_isp([], TINY, progress=False)
    first = exact_pairs[0]
    saturated = torch.ones_like(first.clean.mosaic)
    clean = RawFrame(saturated, first.cfa, white_balance=(1, 1, 1), color_matrix=camera_matrix)
    white = Pair("white", clean, torch.full_like(first.srgb, 255))
    with pytest.raises(ValueError, match="unclipped"):
        fit_isp([white], TINY, progress=False)


def test_one_white_frame_of_ten_is_left_out_with_a_note(
    exact_pairs: list[Pair], capsys: pytest.CaptureFixture[str]
) -> None:
    first = exact_pairs[0]
    saturated = replace(first.clean, mosaic=torch.ones_like(first.clean.mosaic))
    white = replace(first, name="white", srgb=torch.full_like(first.srgb, 255), clean=saturated)
    others = [replace(first, name=f"copy {k}") for k in range(9)]
    isp = fit_isp([*others, white], TINY, progress=False)
    assert len(isp.info["frames"]) == 9 and "white" not in isp.info["frames"]
    assert "1 of 10 frames" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"white: .*unclipped"):
        fit_isp([*others[:8], white], TINY, progress=False)


def test_settings_that_cannot_be_are_refused(exact_pairs: list[Pair]) -> None:
    settings: dict[str, Any]
    for settings in ({"atoms": 0}, {"pixels": 0}, {"steps": -1}, {"reach": 0.9}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            FitConfig(**settings)
    with pytest.raises(ValueError, match="gain_atoms"):
        fit_isp(exact_pairs[:1], replace(TINY, isp={"gain_atoms": 20}), progress=False)


CURVE = FitConfig(steps=5, curve_steps=40, pixels=1024, batch=256, shading="off", tone="curve", encoders="off")


def bent(x: torch.Tensor) -> torch.Tensor:
    """No standard's curve: it lifts the shadows and rolls the highlights off."""
    return 0.5 * x**2.2 + 0.5 * (x * x * (3.0 - 2.0 * x)) ** 2


def test_a_curve_that_no_standard_has_is_found_and_serves_every_pass(exact_pair: Callable[..., Pair]) -> None:
    balances = [(1.5, 1.0, 2.0), (2.0, 1.0, 1.5)]
    pairs = [exact_pair(f"shot{k}", balance, k, curve=bent) for k, balance in enumerate(balances)]
    isp = fit_isp(pairs, CURVE, progress=False)
    assert isp.config.stages == ("curve", "colour", "gains") and isp.tone is not None
    assert (isp.tone.curves.diff(dim=1) >= 0).all() and isp.tone.curves[0, 0] == 0 and isp.tone.curves[0, -1] == 1
    unseen = exact_pair("unseen", (1.3, 1.0, 2.2), 9, curve=bent)
    back = isp.reverse(unseen.srgb[None], white_balance=unseen.clean.white_balance)
    assert psnr(back.raw, unseen.clean.mosaic[None]).item() > 52.0
    baked = BakedISP(isp)(unseen.srgb[None], back.params)
    torch.testing.assert_close(
        baked, torch.nn.functional.pixel_unshuffle(back.raw, 2)[:, [1, 0, 3, 2]], atol=2e-4, rtol=0
    )
    ahead = isp.forward(unseen.clean.mosaic[None], white_balance=unseen.clean.white_balance).srgb
    assert psnr(ahead, unseen.srgb[None] / 255.0).item() > 38.0


@pytest.mark.parametrize("start", ["another camera", "universal"])
def test_a_fit_starts_from_the_tone_of_another_isp(start: str, exact_pair: Callable[..., Pair], tmp_path: Path) -> None:
    balances = [(1.5, 1.0, 2.0), (2.0, 1.0, 1.5)]
    pairs = [exact_pair(f"shot{k}", balance, k, curve=bent) for k, balance in enumerate(balances)]
    other = fit_isp(pairs, CURVE, progress=False)
    if start == "another camera":
        start = str(tmp_path / "other.safetensors")
        other.save(start)
    short = replace(CURVE, tone="learned", steps=2)
    alone = fit_isp(pairs, short, progress=False)
    started = fit_isp(pairs, replace(short, start=start), progress=False)

    def distance(isp: DictionaryISP) -> float:
        curve, wanted = (tone_table(one)[:, 1] / tone_table(one)[200, 1] for one in (isp, other))
        return float((curve - wanted)[:220].square().mean().sqrt())

    if start == "universal":
        assert distance(started) < 1.1 * distance(alone)
    else:
        assert distance(started) < 0.7 * distance(alone)


def refitted(gains: dict[str, float]) -> Callable[..., DictionaryISP]:
    """ISPs whose gains are off by a factor that depends on the tone alone."""

    def refit(frames: FitFrames, part: str, config: FitConfig) -> DictionaryISP:
        assert len(frames.shots) == 1 and config.tone in part
        isp = DictionaryISP()
        with torch.no_grad():
            isp.gain.log_gains.fill_(gains[config.tone])
            isp.colour.neutral.fill_(gains[config.tone])
        return isp

    return refit


@pytest.fixture(scope="module")
def two_frames(exact_pairs: list[Pair]) -> FitFrames:
    return sample_pixels(exact_pairs[:2], 256, 0)


@pytest.mark.parametrize("better", ["learned", "curve"])
def test_auto_takes_what_is_better_on_frames_left_out(two_frames: FitFrames, better: str) -> None:
    off = {"learned": 1.0, "curve": 1.0} | {better: 0.0}
    decided, gain = choose_tone(two_frames, replace(CURVE, tone="auto"), refitted(off))
    assert decided.tone == better and gain is not None and (gain > 0) == (better == "curve")
