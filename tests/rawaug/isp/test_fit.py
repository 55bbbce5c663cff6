"""The fit recovers a camera that is known, and says so in decibels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr

QUICK = FitConfig(steps=60, pixels=4096, batch=1024)


def error_db(isp: DictionaryISP, pair: Pair, white_balance: tuple[float, ...] | None = None) -> float:
    raw = isp.reverse(pair.srgb[None], white_balance=white_balance).raw
    return psnr(raw, pair.raw[None]).item()


@pytest.fixture(scope="module")
def fitted(exact_pairs: list[Pair]) -> DictionaryISP:
    return fit_isp(exact_pairs, QUICK, progress=False)


def test_it_recovers_matrix_and_gains(
    fitted: DictionaryISP, exact_pairs: list[Pair], camera_matrix: torch.Tensor
) -> None:
    torch.testing.assert_close(fitted.colour.atoms(), camera_matrix.expand(3, 3, 3), atol=0.03, rtol=0)
    ratios = fitted.gain.atoms()[:, 1:] / torch.tensor([p.white_balance for p in exact_pairs])[:, [0, 2]]
    torch.testing.assert_close(ratios, torch.ones(3, 2), atol=0.03, rtol=0)


def test_known_gains_give_an_unseen_shot(fitted: DictionaryISP, exact_pair: Callable[..., Pair]) -> None:
    unseen = exact_pair("unseen", (1.3, 1.0, 2.2), seed=9)
    assert error_db(fitted, unseen, unseen.white_balance) > 50.0
    assert error_db(fitted, unseen) < 40.0  # blind, the gains cannot be guessed


def test_the_fit_takes_the_pattern_of_its_frames(fitted: DictionaryISP) -> None:
    assert str(fitted.cfa) == "GRBG"


def test_without_fall_off_the_shading_stage_is_left_out(fitted: DictionaryISP) -> None:
    assert "shading" not in fitted.config.stages


def test_fall_off_is_found_and_worth_its_decibels(exact_pair: Callable[..., Pair]) -> None:
    pairs = [exact_pair(f"s{k}", (1.6, 1.0, 1.5), k, fall_off=0.8) for k in range(2)]
    unseen = exact_pair("unseen", (1.6, 1.0, 1.5), seed=9, fall_off=0.8)
    with_mask = fit_isp(pairs, QUICK, progress=False)
    without = fit_isp(pairs, replace(QUICK, shading="off"), progress=False)
    torch.testing.assert_close(with_mask.shading.precision.diagonal(), torch.full((2,), 0.8), atol=0.1, rtol=0)
    assert error_db(with_mask, unseen, unseen.white_balance) > error_db(without, unseen, unseen.white_balance) + 6.0


def test_the_forward_pass_renders_the_picture(fitted: DictionaryISP, exact_pairs: list[Pair]) -> None:
    pair = exact_pairs[0]
    rendered = fitted.forward(pair.raw[None], white_balance=pair.white_balance).srgb
    assert psnr(rendered, pair.srgb[None] / 255.0).item() > 30.0


def test_the_same_seed_gives_the_same_isp(exact_pairs: list[Pair]) -> None:
    config = FitConfig(steps=3, pixels=512, batch=128)
    a, b = (fit_isp(exact_pairs[:1], config, progress=False).state_dict() for _ in range(2))
    assert all(torch.equal(a[key], b[key]) for key in a)


def test_more_frames_than_atoms_are_clustered(exact_pairs: list[Pair]) -> None:
    isp = fit_isp(exact_pairs, FitConfig(steps=3, pixels=512, batch=128, atoms=2), progress=False)
    assert isp.config.gain_atoms == isp.config.colour_atoms == 2


def test_no_frame_and_a_white_frame_are_refused(exact_pairs: list[Pair], camera_matrix: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="no RAW-sRGB pair"):
        fit_isp([], QUICK, progress=False)
    first = exact_pairs[0]
    white = Pair(
        "white", torch.full_like(first.srgb, 255), torch.ones_like(first.raw), first.cfa, (1, 1, 1), camera_matrix
    )
    with pytest.raises(ValueError, match="unclipped"):
        fit_isp([white], QUICK, progress=False)
