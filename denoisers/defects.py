"""Hot and dead pixels, which are replaced before a network sees the signal; its noise has deviation 1.

A pixel is a defect if it lies beyond all its neighbours of the same colour, while the pixels that touch it, which have
other colours, agree with their own neighbours: an edge changes several colours at once, and a lens spreads the smallest
light over the pixels around it (a spread of 0.4 pixels puts an eighth of the peak into each of the four beside it), but
a defect changes one pixel. It is replaced by the mean of its neighbours, leaving out the lowest and the highest.

Texture that is as fine as pixels has single ones that pass for defects, and many more that nearly do; defects stand out
clearly. Where more than twice as many nearly do as do, within 64 pixels, they are therefore left alone. The count is
that of the pixel's own surroundings, so that it does not depend on the tile in which a pixel is denoised.
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
"""A defect departs from its neighbours at least this many times as far as the pixels that touch it, one excepted."""
NEARLY_ALONE = 2.0
"""Where many pixels depart this many times as far, those that depart further are the finest texture, not defects."""
AROUND = 64
"""Texture is looked for within so many pixels of the mosaic, less than by which tiles overlap."""
SPREAD = 0.1
"""The four pixels beside a light depart with it by this share, on average, or more; those beside a defect do not."""


def mend_planes(signal: Tensor) -> Tensor:
    """Replace the hot and dead pixels of packed RAW ``(B, 4, h, w)``, whose noise has deviation 1.

    A pixel is compared with the eight neighbours of its colour, and with the eight pixels that touch it.
    """
    neighbours = _neighbours(signal, 1)

    low = high = total = neighbours[0]
    for neighbour in neighbours[1:]:
        low = torch.minimum(low, neighbour)
        high = torch.maximum(high, neighbour)
        total = total + neighbour
    mean = (total - low - high) / (len(neighbours) - 2)

    departure = F.pixel_shuffle(signal - mean, 2)
    touching = _neighbours(departure, 1)
    largest = second_largest = torch.zeros_like(departure)
    for neighbour in touching:
        distance = neighbour.abs()
        second_largest = torch.maximum(second_largest, torch.minimum(largest, distance))
        largest = torch.maximum(largest, distance)
    above, left, right, below = touching[1], touching[3], touching[4], touching[6]
    beside = (above + left + right + below) / 4
    is_spread = beside * departure.sign() >= SPREAD * departure.abs()

    is_candidate = ~is_spread & (F.pixel_shuffle(_is_beyond(signal, low, high).to(signal.dtype), 2) > 0)
    is_defect = is_candidate & (departure.abs() > ALONE * second_largest)
    is_nearly = is_candidate & (departure.abs() > NEARLY_ALONE * second_largest)
    is_texture = _count_around(is_nearly) > 2 * _count_around(is_defect) + 1

    replaced = F.pixel_unshuffle((is_defect & ~is_texture).to(signal.dtype), 2) > 0
    return torch.where(replaced, mean, signal)


def _count_around(mask: Tensor) -> Tensor:
    """Count the pixels that are marked within :data:`AROUND` of each one of a mask ``(B, 1, H, W)``."""
    height, width = mask.shape[-2:]
    padded = F.pad(mask.float(), (AROUND + 1, AROUND, AROUND + 1, AROUND))
    sums = padded.cumsum(-1).cumsum(-2)  # whole numbers below 2^24, which float32 holds exactly

    side = 2 * AROUND + 1
    below, above = sums[..., side:, :], sums[..., :height, :]
    bands = below - above
    return bands[..., side:] - bands[..., :width]


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


def find_outliers(signal: Tensor, planes: Tensor) -> Tensor:
    """Find the pixels that lie far beyond all pixels of their colour around them but one, which may be a defect, too.

    Args:
        signal: a mosaic ``(B, 1, H, W)``, whose noise has deviation 1.
        planes: which colour each pixel has, ``(B, 3, H, W)``, one-hot.

    Returns:
        1 where a pixel is above the others, -1 where it is below, and 0 elsewhere, of the mosaic's shape.
    """
    colour = planes.argmax(1, keepdim=True)
    low = second_low = torch.full_like(signal, torch.inf)
    high = second_high = -low
    for neighbour in _neighbours(torch.cat([signal, colour.to(signal)], dim=1), 2):
        value, colour_of_value = neighbour.split(1, dim=1)
        is_same = colour_of_value == colour

        above = value.where(is_same, -torch.inf)
        second_high = torch.maximum(second_high, torch.minimum(high, above))
        high = torch.maximum(high, above)

        below = value.where(is_same, torch.inf)
        second_low = torch.minimum(second_low, torch.maximum(low, below))
        low = torch.minimum(low, below)

    is_compared = second_low.isfinite() & second_high.isfinite()
    side = (signal > second_high).to(signal.dtype) - (signal < second_low).to(signal.dtype)
    return side * (_is_beyond(signal, second_low, second_high) & is_compared)


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
