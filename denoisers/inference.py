"""Around a denoiser, called as it is: tiles, self-ensemble, and the average over recorrupted copies."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.network import PACKED
from rawaug import bayer

Run = Callable[[Tensor, Tensor | None], Tensor]
"""``run(noisy, variance) -> denoised``: a network, or anything that is called like one."""
Each = Callable[[Sequence[Any]], Iterable[Any]]
"""Iterates over pieces of work, and may show progress, as ``tqdm`` does."""

OVERLAP = 96
"""Packed pixels by which tiles overlap where nothing else is said."""


def _pieces(size: int, tile: int, overlap: int, stride: int) -> tuple[list[int], int]:
    """The starts of the tiles along a side, the last of which reaches the end, and their length, at most ``tile``."""
    count = max(1, -(-(size - 2 * overlap) // (tile - 2 * overlap)))
    step = -(-(size - 2 * overlap) // (count * stride)) * stride if count > 1 else tile - 2 * overlap
    side = max(step + 2 * overlap, 2 * stride)
    last = max(0, -(-(size - side) // stride) * stride)
    return [*range(0, last, side - 2 * overlap), last], side


@torch.no_grad()
def denoise_tiles(
    model: Run,
    noisy: Tensor,
    variance: Tensor | None = None,
    tile: int = 1536,
    overlap: int | None = None,
    each: Each = iter,
) -> Tensor:
    """Denoise a picture of any size piece by piece, without gradients: ``f(y)[core] = f(y[core + overlap])[core]``.

    The equality is exact (to rounding) where the overlap is at least the network's receptive radius: from 17 pixels for
    a DnCNN of depth 17 to 169 for the U-Net. Influence falls off with distance: with a trained U-Net of four scales the
    largest difference was 0.3 of the noise's deviation at an overlap of 32, and 2e-6 at 64. Tiles start at multiples of
    the network's stride, so that pooling grids fall on the same pixels as in the whole picture. Nothing is blended:
    that would hide an overlap that is too small. Peak memory is the result and one piece.

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
    stride, scale = (getattr(model, name, 1) for name in ("stride", "upscale"))
    overlap = -(-OVERLAP // stride) * stride if overlap is None else overlap
    if not 0 <= 2 * overlap < tile:
        raise ValueError(f"overlap must be at least 0 and less than half the tile {tile}, got {overlap}")
    if tile % stride or overlap % stride:
        raise ValueError(f"tile {tile} and overlap {overlap} must be multiples of the model's stride {stride}")
    if tile < 2 * stride:
        raise ValueError(f"tile must be at least {2 * stride}, twice the model's stride, got {tile}")
    denoised: Tensor | None = None
    # In reading order: what a tile has too little context for, at its right and lower end, the next tile overwrites.
    (tops, height), (lefts, width) = (_pieces(side, tile, overlap, stride) for side in noisy.shape[-2:])
    for top, left in each([(top, left) for top in tops for left in lefts]):
        window = (..., slice(top, top + height), slice(left, left + width))
        given = noisy[window]
        piece = model(given, None if variance is None else variance[window])
        if piece.shape[-2:] != tuple(scale * side for side in given.shape[-2:]):
            raise ValueError(f"the model made {tuple(piece.shape)} of {tuple(given.shape)}")
        if denoised is None:
            denoised = piece.new_empty(*piece.shape[:2], *(scale * side for side in noisy.shape[-2:]))
        above, before = (scale * overlap if start else 0 for start in (top, left))
        core, row, column = piece[..., above:, before:], scale * top + above, scale * left + before
        denoised[..., row : row + core.shape[-2], column : column + core.shape[-1]] = core
    assert denoised is not None
    return denoised


VIEWS = (4, bayer.N_VIEWS)


def to_view(packed: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """Turn packed RAW ``(B, 4, h, w)`` and keep its CFA: a side is one cell longer where the pattern has moved."""
    rows, columns = cfa.turn(view).shift_to(cfa)
    turned = bayer.turn(bayer.unpack(packed, cfa), view)
    return bayer.pack(F.pad(turned, (columns, columns, rows, rows), mode="reflect"), cfa)


def from_view(image: Tensor, cfa: bayer.CFA, view: int) -> Tensor:
    """Undo :func:`to_view` on packed RAW ``(B, 4, h, w)`` or on full colour ``(B, 3, 2h, 2w)``."""
    packed = image.shape[1] == PACKED
    turned = bayer.crop_to_cfa(bayer.unpack(image, cfa) if packed else image, cfa, cfa.turn(view))
    upright = bayer.turn_back(turned, view)
    return bayer.pack(upright, cfa) if packed else upright


class SelfEnsemble(nn.Module):
    """A denoiser averaged over views of the mosaic, ``mean of T^-1 f(T y)``: ``views`` times the work.

    T, a flip or quarter turn, turns the *mosaic*. Where this moves the pattern, one line is added on either side by
    reflection without repeating the edge, so that the network meets its own pattern again, and cropped from the result.
    Sources: Timofte et al., CVPR 2016; for mosaics Liu et al., CVPRW 2019.

    Args:
        model: ``model(noisy, variance) -> denoised``, packed RAW; a network, or any such callable.
        cfa: pattern of the mosaics that it will be given.
        views: 4, the flips, or 8, the flips with and without a quarter turn (the full set).
        each: iterates over the groups of views of one shape; may show progress, as ``tqdm`` does.

    Views of one shape share a batch. ``SelfEnsemble(partial(denoise_tiles, model), cfa)`` is for large pictures.

    Raises:
        ValueError: if ``views`` is neither 4 nor 8, or the CFA is unknown.

    Example:
        >>> noisy = torch.rand(1, 4, 16, 16)
        >>> identity = lambda noisy, variance: noisy
        >>> torch.equal(SelfEnsemble(identity, "RGGB")(noisy), noisy)
        True
    """

    def __init__(self, model: Run, cfa: bayer.CFA | str, views: int = 8, each: Each = iter) -> None:
        super().__init__()
        if views not in VIEWS:
            raise ValueError(f"views must be 4 (flips) or 8 (flips and quarter turns), got {views}")
        self.model = model
        self.cfa = bayer.CFA(cfa)
        self.views = views
        self.each = each
        self.stride: int = getattr(model, "stride", 1)

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)``, h, w >= 2; ``variance``, if any, is turned alike."""
        alike: dict[torch.Size, list[int]] = defaultdict(list)
        turned = {view: to_view(noisy, self.cfa, view) for view in range(self.views)}
        for view, picture in turned.items():
            alike[picture.shape].append(view)
        mean = noisy.new_zeros(())
        count = 0
        for views in self.each(list(alike.values())):
            batch = torch.cat([turned.pop(view) for view in views])
            noise = None if variance is None else torch.cat([to_view(variance, self.cfa, view) for view in views])
            for view, denoised in zip(views, self.model(batch, noise).chunk(len(views)), strict=True):
                count += 1
                # A running mean: equal views give their value back to the last bit.
                mean = mean + (from_view(denoised, self.cfa, view) - mean) / count
        return mean
