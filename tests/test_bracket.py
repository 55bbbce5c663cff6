"""The bracket: a known scene, moved by a known shift, with noise of known levels, is measured as what it is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import bracket
from benchmarks.bracket import Shot
from rawaug.bayer import CFA, noise_variance, pack
from rawaug.io import RawFrame
from rawaug.io.raw import Exposure
from rawaug.seeding import keyed_generator

SHIFT = (1.3, -0.7)
LEVELS = (2e-4, 1e-6)
SIDE = 480


def scene(down: float, right: float, light: float) -> Tensor:
    """A smooth grey scene ``(1, H, W)``, moved by as many pixels."""
    draw = torch.rand(3, 24, generator=keyed_generator(0, "scene"))
    y, x = torch.meshgrid(torch.arange(SIDE) + down, torch.arange(SIDE) + right, indexing="ij")
    (fy, fx), phase = (draw[:2] - 0.5) / 15, draw[2] * 2 * math.pi
    waves = torch.sin(2 * math.pi * (fy[:, None, None] * y + fx[:, None, None] * x) + phase[:, None, None])
    return light * (0.5 + 0.06 * waves.sum(0)).clamp(0.05, 0.95)[None]


def shot(seconds: float, clean: Tensor, name: str) -> Shot:
    noise = torch.randn(clean.shape, generator=keyed_generator(0, "shot", name))
    mosaic = clean + noise_variance(clean, *LEVELS).sqrt() * noise
    frame = RawFrame(mosaic.float(), CFA.GBRG, name=name, exposure=Exposure(seconds))
    return Shot(frame, LEVELS, "known")


@pytest.fixture(scope="module")
def shots() -> tuple[Shot, Shot]:
    down, right = (-2 * cells for cells in SHIFT)
    return shot(1 / 400, scene(0.0, 0.0, 0.2), "short"), shot(1 / 100, scene(down, right, 0.8), "long")


def test_a_block_is_found_at_a_fraction_of_a_cell_and_scored_less_the_references_noise(
    shots: tuple[Shot, Shot],
) -> None:
    noisy, reference = shots
    blocks, left_out = bracket.used(noisy, reference)
    assert len(blocks) == 1 and not left_out
    (block,) = blocks
    rows, columns = (slice(at, at + bracket.BLOCK) for at in (block.top, block.left))
    clean = pack(scene(0.0, 0.0, 0.2)[None, :, rows, columns], CFA.GBRG)
    variance = noise_variance(clean, *LEVELS).mean().item()
    assert block.gains == pytest.approx([0.25] * 4, rel=0.01) and block.unlike == pytest.approx(1.0, abs=0.05)
    apart = (block.target - clean).square().mean().item()
    assert apart == pytest.approx(block.own.square().mean().item(), rel=0.15), "all that is wrong with it is its noise"
    assert abs(block.alignment) < 0.02 * variance
    as_shot = pack(noisy.frame.mosaic[None, :, rows, columns], CFA.GBRG)
    ((error, _),) = bracket.errors_of(iter([as_shot]), noisy, blocks)
    assert error == pytest.approx(variance, rel=0.03)
    ((perfect, _),) = bracket.errors_of(iter([clean]), noisy, blocks)
    assert abs(perfect) < 0.02 * variance


def test_what_moved_or_is_clipped_is_left_out(shots: tuple[Shot, Shot]) -> None:
    noisy, reference = shots
    mosaic = reference.frame.mosaic
    for others, reasons in (
        ((mosaic * 4).clamp(max=1.0), {"clipped in the reference"}),
        (0.6 * mosaic + 0.3 * scene(40.0, 3.0, 0.8), {"unlike the reference"}),
        (mosaic.flip(2), {"not found in the reference", "outside the reference", "unlike the reference"}),
    ):
        frame = RawFrame(others, CFA.GBRG, name="other", exposure=Exposure(1 / 100))
        blocks, left_out = bracket.used(noisy, Shot(frame, LEVELS, "known"))
        assert blocks == [] and set(left_out) <= reasons


def test_shifts_are_found_both_ways() -> None:
    window = scene(0.0, 0.0, 0.5)[0, ::2, ::2].double().numpy()
    block = window[16 + 3 : 16 + 3 + 96, 16 - 2 : 16 - 2 + 96]
    np.testing.assert_allclose(bracket.shift_of_block(window[: 96 + 32, : 96 + 32], block), (3, -2), atol=0.02)


def test_a_folder_that_is_no_bracket_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="RAW"):
        bracket.bracket(tmp_path)


def test_a_denoiser_that_is_better_in_most_blocks_and_far_worse_in_one_gains_by_the_median() -> None:
    steady = [(1e-6, 1e-4)] * 15
    daring = [(0.8e-6, 1e-4)] * 14 + [(1e-4, 1e-2)]
    assert bracket.decibels([raw for raw, _ in daring]) < bracket.decibels([raw for raw, _ in steady])
    middle, low, high = bracket.gains({"steady": steady, "daring": daring}, "steady")["daring"]
    assert middle == pytest.approx(10 * math.log10(1 / 0.8), abs=0.01)
    assert 0 < low <= middle <= high
    (only,) = bracket.gains({"daring": [*daring, (-1e-9, 0.0)], "steady": [*steady, (1e-6, 0.0)]}, "daring").values()
    assert only[0] == pytest.approx(-middle, abs=0.01), "a block without an error of its own has no gain"
