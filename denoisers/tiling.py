r"""Denoising in tiles: ``f(y)[core] = f(y[core + overlap on every side])[core]``.

Domain: packed RAW of any size. The equality is exact (to rounding) where the overlap is at least the network's
receptive radius and the tiles start at multiples of its stride, so that pooling grids fall on the same pixels as in the
whole picture: from 17 pixels for a DnCNN of depth 17, 139 for DHDN, 169 for the U-Net. Influence falls off with
distance: with a trained U-Net of four scales the largest difference was 0.3 of the noise's deviation at an overlap of
32, and 2e-6 at 64; the default is 96. Only the middle of each tile is kept; nothing is blended: that would hide an
overlap that is too small. Along each side all tiles have the same size, the smallest that does with as many of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor


def _pieces(size: int, tile: int, overlap: int, stride: int) -> tuple[list[int], int]:
    """Where the tiles begin along a side, and how long they are, at most ``tile``; the last one reaches the end."""
    count = max(1, -(-(size - 2 * overlap) // (tile - 2 * overlap)))
    step = -(-(size - 2 * overlap) // (count * stride)) * stride if count > 1 else tile - 2 * overlap
    side = max(step + 2 * overlap, 2 * stride)
    last = max(0, -(-(size - side) // stride) * stride)
    return [*range(0, last, side - 2 * overlap), last], side


@torch.no_grad()
def tiled(
    model: Callable[[Tensor, Tensor | None], Tensor],
    noisy: Tensor,
    variance: Tensor | None = None,
    tile: int = 1536,
    overlap: int = 96,
    each: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> Tensor:
    """Denoise a picture of any size piece by piece, without gradients.

    Peak memory is the result plus what the model needs for one ``(B, 4, tile, tile)`` piece, whatever the picture's
    size; at most ``(tile / (tile - 2 overlap))^2`` times the work of the whole picture at once.

    Args:
        model: ``model(noisy, variance) -> denoised``; its ``stride``, if it has one, aligns the tiles.
        noisy: ``(B, 4, h, w)``.
        variance: the noise variance of each value, shape of ``noisy``.
        tile: side of a piece in packed pixels, overlap included.
        overlap: context on each inner side, dropped from the result.
        each: goes through the tiles, and may show how far it is, as ``tqdm`` does.

    Raises:
        ValueError: if the overlap leaves nothing of a tile, tile or overlap are no multiples of the model's stride, or
            the tile is less than two strides.

    Example:
        >>> from denoisers import DnCNN
        >>> tiled(DnCNN(width=8, depth=4, variance_map=False), torch.rand(1, 4, 300, 90), tile=64, overlap=8).shape
        torch.Size([1, 4, 300, 90])
    """
    stride: int = getattr(model, "stride", 1)
    if not 0 <= 2 * overlap < tile:
        raise ValueError(f"overlap must be at least 0 and less than half the tile {tile}, got {overlap}")
    if tile % stride or overlap % stride:
        raise ValueError(f"tile {tile} and overlap {overlap} must be multiples of the model's stride {stride}")
    if tile < 2 * stride:
        raise ValueError(f"tile must be at least {2 * stride}, twice the model's stride, got {tile}")
    denoised = torch.empty_like(noisy)
    # In reading order: what a tile has too little context for, at its right and lower end, the next tile overwrites.
    (tops, height), (lefts, width) = (_pieces(side, tile, overlap, stride) for side in noisy.shape[-2:])
    for top, left in each([(top, left) for top in tops for left in lefts]):
        window = (..., slice(top, top + height), slice(left, left + width))
        piece = model(noisy[window], None if variance is None else variance[window])
        above, before = (overlap if start else 0 for start in (top, left))
        denoised[..., top + above : top + height, left + before : left + width] = piece[..., above:, before:]
    return denoised
