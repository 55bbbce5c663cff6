"""Pictures of any size, denoised piece by piece: ``f(y)[core] = f(y[core + overlap])[core]``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

import torch
from torch import Tensor

Run = Callable[[Tensor, Tensor | None], Tensor]
"""It is called as ``run(noisy, variance) -> denoised``: a network, or anything that is called like one."""
Each = Callable[[Sequence[Any]], Iterable[Any]]
"""It iterates over pieces of work and may show progress, as ``tqdm`` does."""

TILE = 1536
"""A tile has this side in packed pixels by default, overlap included."""

OVERLAP = 96
"""Tiles overlap by this many packed pixels by default."""


@torch.no_grad()
def denoise_tiles(
    model: Run,
    noisy: Tensor,
    variance: Tensor | None = None,
    tile: int = TILE,
    overlap: int | None = None,
    each: Each = iter,
) -> Tensor:
    """Denoise a picture of any size piece by piece, without gradients: ``f(y)[core] = f(y[core + overlap])[core]``.

    The equality is exact (to rounding) if the overlap is at least the network's receptive radius: from 17 pixels for a
    DnCNN of depth 17 to 169 for the U-Net. Influence falls off with distance: with a trained U-Net of four scales, the
    largest difference was 0.3 of the noise's deviation at an overlap of 32, and 2e-6 at 64. Tiles start at multiples of
    the network's stride, so that pooling grids fall on the same pixels as in the whole picture. Nothing is blended,
    since that would hide an overlap that is too small. Peak memory is the result and one piece.

    Args:
        model: ``model(noisy, variance) -> denoised``; its ``stride``, if it has one, aligns the tiles, and its
            ``upscale`` says how much larger the result's sides are.
        noisy: ``(B, 4, h, w)``.
        variance: the noise variance of each value, shape of ``noisy``.
        tile: side of a piece in packed pixels, overlap included.
        overlap: context on each inner side, dropped from the result; by default 96, or the next multiple of the stride.
        each: iterates over the tiles; may show progress, as ``tqdm`` does.

    Raises:
        ValueError: if tile and overlap do not fit each other or the model's stride.

    Example:
        >>> from denoisers import DnCNN
        >>> net = DnCNN(width=8, depth=4, variance_map=False)
        >>> denoise_tiles(net, torch.rand(1, 4, 300, 90), tile=64, overlap=8).shape
        torch.Size([1, 4, 300, 90])
    """
    stride = getattr(model, "stride", 1)
    scale = getattr(model, "upscale", 1)
    if overlap is None:
        overlap = _round_up(OVERLAP, stride)

    if not 0 <= 2 * overlap < tile:
        raise ValueError(f"overlap must be at least 0 and less than half the tile {tile}, got {overlap}")
    if tile % stride or overlap % stride:
        raise ValueError(f"tile {tile} and overlap {overlap} must be multiples of the model's stride {stride}")
    if tile < 2 * stride:
        raise ValueError(f"tile must be at least {2 * stride}, twice the model's stride, got {tile}")

    height, width = noisy.shape[-2:]
    rows, tile_height = _tile_starts(height, tile, overlap, stride)
    columns, tile_width = _tile_starts(width, tile, overlap, stride)

    denoised: Tensor | None = None
    # In reading order, the next tile overwrites what a tile has too little context for at its right and lower end.
    for row, column in each(list(product(rows, columns))):
        window = (..., slice(row, row + tile_height), slice(column, column + tile_width))
        noisy_tile = noisy[window]
        variance_tile = None
        if variance is not None:
            variance_tile = variance[window]

        piece = model(noisy_tile, variance_tile)
        if piece.shape[-2:] != (scale * noisy_tile.shape[-2], scale * noisy_tile.shape[-1]):
            raise ValueError(f"the model made {tuple(piece.shape)} of {tuple(noisy_tile.shape)}")
        if denoised is None:
            denoised = piece.new_empty(*piece.shape[:2], scale * height, scale * width)

        # The first tile of a row or column has no neighbour to take its context from.
        above = scale * overlap if row else 0
        before = scale * overlap if column else 0
        core = piece[..., above:, before:]
        first_row = scale * row + above
        first_column = scale * column + before
        last_row = first_row + core.shape[-2]
        last_column = first_column + core.shape[-1]
        denoised[..., first_row:last_row, first_column:last_column] = core

    assert denoised is not None
    return denoised


def _tile_starts(size: int, tile: int, overlap: int, stride: int) -> tuple[list[int], int]:
    """Place tiles along a side up to its end; return their starts and their length, which is at most ``tile``."""
    step = tile - 2 * overlap
    count = math.ceil((size - 2 * overlap) / step)
    if count > 1:
        step = _round_up(math.ceil((size - 2 * overlap) / count), stride)

    length = max(step + 2 * overlap, 2 * stride)
    last = max(0, _round_up(size - length, stride))
    return [*range(0, last, length - 2 * overlap), last], length


def _round_up(number: int, multiple: int) -> int:
    """Round a number up to a multiple."""
    return math.ceil(number / multiple) * multiple
