"""Patches of a picture, for filters that work on them: how they are cut, matched, and put together again."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def extract_patches(image: Tensor, side: int) -> Tensor:
    """Cut all overlapping patches of an image ``(C, h, w)``, by rows of their corners: ``(C, side^2, N)``."""
    patches: Tensor = F.unfold(image[:, None], side)
    return patches


def patch_grid(height: int, width: int, side: int, step: int) -> Tensor:
    """List the indices ``(R,)`` of patches at every ``step``-th row and column; the last ones are always included.

    They count the corners of :func:`extract_patches` row by row.
    """
    last_row = height - side
    last_column = width - side
    rows = torch.tensor(sorted({*range(0, last_row, step), last_row}))
    columns = torch.tensor(sorted({*range(0, last_column, step), last_column}))
    return (rows[:, None] * (last_column + 1) + columns).flatten()


def assemble(sums: Tensor, weights: Tensor, image: Tensor, side: int) -> Tensor:
    """Average overlapping patches by their weights; a pixel that no patch covers keeps its value.

    Args:
        sums: weighted sums of the estimates of each patch, ``(C, side^2, N)``.
        weights: sums of their weights, ``(C, 1, N)``.
        image: the original picture, ``(C, h, w)``.
        side: of a patch in pixels.
    """
    size = image.shape[-2:]
    total = F.fold(sums, size, side)[:, 0]
    weight = F.fold(weights.expand_as(sums).contiguous(), size, side)[:, 0]
    return torch.where(weight > 0, total / weight.clamp_min(1e-12), image)


def match_patches(guide: Tensor, corners: Tensor, side: int, reach: int, count: int) -> Tensor:
    """Find, for each of some patches, the patches around it that are most like it.

    Args:
        guide: the picture by which patches are compared, ``(h, w)``.
        corners: indices of the patches to find others for, ``(R,)``, see :func:`patch_grid`.
        side: of a patch in pixels.
        reach: largest distance in rows and in columns.
        count: number of patches of each group.

    Returns:
        Indices of patches ``(R, count)``, the patch itself first; it is repeated if the picture has fewer.
    """
    rows = guide.shape[0] - side + 1
    columns = guide.shape[1] - side + 1
    distances = []
    indices = []

    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            shifted = guide.roll((-down, -right), (0, 1))
            error = (guide - shifted).square()[None, None]
            distance = F.avg_pool2d(error, side, stride=1)[0, 0].flatten()[corners]

            row = corners // columns + down
            column = corners % columns + right
            is_inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
            distances.append(torch.where(is_inside, distance, torch.inf))
            indices.append(torch.where(is_inside, row * columns + column, corners))

    distance = torch.stack(distances, dim=1)
    index = torch.stack(indices, dim=1)
    itself = reach * (2 * reach + 1) + reach
    distance[:, itself] = -1.0
    nearest = distance.topk(min(count, distance.shape[1]), dim=1, largest=False).indices
    return index.gather(1, nearest)
