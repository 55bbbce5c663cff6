"""What the filters on patches share: patches of a picture, the most alike of them, and a picture of patches."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def extract_patches(image: Tensor, side: int) -> Tensor:
    """All patches of an image ``(C, h, w)``, overlapping, ``(C, side^2, N)``, row by row of their corners."""
    patches: Tensor = F.unfold(image[:, None], side)
    return patches


def patch_grid(height: int, width: int, side: int, step: int) -> Tensor:
    """Indices of patches at every ``step``-th row and column, the last ones always included, ``(R,)``.

    They count the corners of :func:`extract_patches` row by row.
    """
    rows, columns = height - side + 1, width - side + 1
    tops = torch.tensor(sorted({*range(0, rows, step), rows - 1}))
    lefts = torch.tensor(sorted({*range(0, columns, step), columns - 1}))
    return (tops[:, None] * columns + lefts).flatten()


def assemble(sums: Tensor, weights: Tensor, image: Tensor, side: int) -> Tensor:
    """The weighted mean of overlapping patches; a pixel that no patch covers keeps its value.

    Args:
        sums: weighted sums of the estimates of each patch, ``(C, side^2, N)``.
        weights: sums of their weights, ``(C, 1, N)``.
        image: the picture before, ``(C, h, w)``.
        side: of a patch in pixels.
    """
    size = image.shape[-2:]
    total = F.fold(sums, size, side)[:, 0]
    weight = F.fold(weights.expand_as(sums).contiguous(), size, side)[:, 0]
    return torch.where(weight > 0, total / weight.clamp_min(1e-12), image)


def match_patches(guide: Tensor, corners: Tensor, side: int, reach: int, count: int) -> Tensor:
    """Find the patches that are most alike, around each of some patches.

    Args:
        guide: the picture by which patches are compared, ``(h, w)``.
        corners: indices of the patches to find others for, ``(R,)``, see :func:`patch_grid`.
        side: of a patch in pixels.
        reach: largest distance in rows and in columns.
        count: number of patches of each group.

    Returns:
        Indices of patches ``(R, count)``, the patch itself first. Where the picture has fewer, it is repeated.
    """
    rows, columns = guide.shape[0] - side + 1, guide.shape[1] - side + 1
    tops, lefts = corners // columns, corners % columns
    distances = []
    indices = []

    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            shifted = guide.roll((-down, -right), (0, 1))
            error = (guide - shifted).square()[None, None]
            distance = F.avg_pool2d(error, side, stride=1)[0, 0].flatten()[corners]

            top, left = tops + down, lefts + right
            inside = (top >= 0) & (top < rows) & (left >= 0) & (left < columns)
            distances.append(torch.where(inside, distance, torch.inf))
            indices.append(torch.where(inside, top * columns + left, corners))

    distance = torch.stack(distances, dim=1)
    index = torch.stack(indices, dim=1)
    itself = reach * (2 * reach + 1) + reach
    distance[:, itself] = -1.0
    nearest = distance.topk(min(count, distance.shape[1]), dim=1, largest=False).indices
    return index.gather(1, nearest)
