"""InvISP's figure against its formula."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.paper.balanced import balanced_psnr, even_edges


def test_a_flat_error_has_the_figure_of_the_formula(frame_of: Callable[..., Pair]) -> None:
    """RAW of 0.25 taken for 0.36: z is w^(1/2.2) times 0.5325 and 0.6285, by channel."""
    raw = torch.full((1, 64, 96), 0.25)
    pair = frame_of("flat", size=(64, 96))
    pair = replace(pair, clean=replace(pair.clean, mosaic=raw, white_balance=(2.0, 1.0, 1.6)))
    gains = [1.0, 0.5, 0.8]
    difference = 0.36 ** (1 / 2.2) - 0.25 ** (1 / 2.2)
    error = sum((gain ** (1 / 2.2) * difference) ** 2 for gain in gains) / 3
    value = balanced_psnr(lambda patch, place: torch.full(patch[:, :1].shape, 0.36), pair)
    assert value == pytest.approx(-10 * math.log10(error), abs=1e-3)


def test_every_pixel_counts_once_and_pieces_begin_at_even_sites(frame_of: Callable[..., Pair]) -> None:
    pair = frame_of("one", size=(64, 98))
    seen = []

    def make(patch: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        seen.append(patch.shape[-2] * patch.shape[-1])
        return torch.zeros(patch[:, :1].shape)

    balanced_psnr(make, pair)
    assert sum(seen) == 64 * 98 and len(seen) == 9
    assert even_edges(98) == [0, 32, 64, 98]
    with pytest.raises(ValueError, match="not registered"):
        balanced_psnr(make, replace(pair, registered=False))
