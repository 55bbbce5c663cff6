"""Hot and dead pixels, which are replaced before a network sees the signal; its noise has deviation 1.

A pixel is a defect if it lies beyond all its neighbours of the same colour, while the pixels of other colours next to
it agree with their own neighbours: an edge or a small light changes several colours at once, but a defect changes only
one. The defect is replaced by the mean of its neighbours, leaving out the lowest and the highest.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional as F

DEVIATIONS = 5.0
"""A defect is at least this far from its neighbours, in deviations of the noise."""
SHARE = 0.15
"""This share of the neighbours' value is added to that distance."""
ALONE = 4.0
"""A defect departs from its neighbours at least this many times as far as the pixels of other colours next to it."""


def mend_planes(signal: Tensor) -> Tensor:
    """Replace the hot and dead pixels of packed RAW ``(B, 4, h, w)``, whose noise has deviation 1.

    A pixel is compared with the eight neighbours of its colour, and with the other colours of its cell.
    """
    neighbours = _neighbours(signal, 1)

    low = high = total = neighbours[0]
    for neighbour in neighbours[1:]:
        low = torch.minimum(low, neighbour)
        high = torch.maximum(high, neighbour)
        total = total + neighbour
    mean = (total - low - high) / (len(neighbours) - 2)

    departure = (signal - mean).abs()
    second_largest = departure.topk(2, dim=1).values[:, 1:]
    is_alone = departure > ALONE * second_largest
    return torch.where(_is_beyond(signal, low, high) & is_alone, mean, signal)


def mend_mosaic(signal: Tensor, planes: Tensor) -> Tensor:
    """Replace the hot and dead pixels of a mosaic ``(B, 1, H, W)``, whose noise has deviation 1.

    A pixel is compared with the pixels of its colour that are at most two away, and with the pixels that touch it.

    Args:
        signal: the mosaic.
        planes: which colour each pixel has, ``(B, 3, H, W)``, one-hot.
    """
    colour = planes.argmax(1, keepdim=True)
    low = torch.full_like(signal, torch.inf)
    high = -low
    total = torch.zeros_like(signal)
    count = torch.zeros_like(signal)

    for neighbour in _neighbours(torch.cat([signal, colour.to(signal)], dim=1), 2):
        value, colour_of_value = neighbour.split(1, dim=1)
        is_same = colour_of_value == colour
        low = torch.where(is_same, value.minimum(low), low)
        high = torch.where(is_same, value.maximum(high), high)
        total = total + value * is_same
        count = count + is_same
    mean = (total - low - high) / (count - 2).clamp_min(1)

    departure = (signal - mean).abs()
    largest_beside = torch.cat(_neighbours(departure, 1), dim=1).amax(1, keepdim=True)
    is_alone = departure > ALONE * largest_beside
    return torch.where(_is_beyond(signal, low, high) & (count > 2) & is_alone, mean, signal)


def _is_beyond(signal: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Mark where a signal lies far beyond the lowest or the highest of its neighbours: a mask of its shape."""
    above = signal > high + SHARE * high.abs() + DEVIATIONS
    below = signal < low - SHARE * low.abs() - DEVIATIONS
    return above | below


def _neighbours(image: Tensor, reach: int) -> list[Tensor]:
    """List the pictures ``(B, C, H, W)`` of all neighbours within ``reach``, mirrored at the edges."""
    height, width = image.shape[-2:]
    padded = F.pad(image, (reach,) * 4, mode="reflect")

    neighbours = []
    for row, column in product(range(2 * reach + 1), repeat=2):
        if (row, column) != (reach, reach):
            neighbours.append(padded[..., row : row + height, column : column + width])
    return neighbours
