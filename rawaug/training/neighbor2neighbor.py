"""Neighbor2Neighbor: two neighbours of every 2 x 2 cell of one noisy RAW are input and target.

``loss = c(f(g1 y), g2 y) + gamma c(f(g1 y) - g2 y, g1 f(y) - g2 f(y))``, where g1 y and g2 y are pictures of half the
sides: one takes a pixel of each cell, and the other takes its neighbour.

Source: Huang et al., "Neighbor2Neighbor", CVPR 2021.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug.training.estimators import ESTIMATORS, NoisyCrop, SelfSupervised
from rawaug.training.losses import Criterion

NEIGHBOURS = ((0, 1), (1, 0), (2, 3), (3, 2), (0, 2), (2, 0), (1, 3), (3, 1))
"""These are the ordered pairs of horizontal or vertical neighbours among the pixels 0 1 / 2 3 of a cell."""


class NeighborSample(NamedTuple):
    """A noisy crop and which neighbours are taken from it.

    Attributes:
        noisy: packed RAW ``(4, h, w)``.
        variance: variance of its noise, ``(4, h, w)``.
        choice: for each 2 x 2 cell of a plane an index of :data:`NEIGHBOURS`, ``(1, h/2, w/2)``.
    """

    noisy: Tensor
    variance: Tensor
    choice: Tensor


@ESTIMATORS.register("neighbor2neighbor")
class Neighbor2Neighbor(SelfSupervised):
    """Two neighbours of every 2 x 2 cell of each packed plane are input and target.

    ``loss = c(f(g1 y), g2 y) + gamma c(f(g1 y) - g2 y, g1 f(y) - g2 f(y))``: the second term takes off what the
    neighbours' own difference, as the network sees it, adds to the first. Gradients do not pass through f(y). An
    untrained network takes noise for that difference, so the term is phased in during training.

    Args:
        gamma: weight of the second term at the end; it grows in proportion to the steps. Published: 2 for synthetic
            noise, 16 for the RAW of SIDD; the larger it is, the smoother the result.
    """

    weighings = ("linear",)  # two pixels with different noise are compared

    def __init__(self, gamma: float = 2.0) -> None:
        if gamma < 0:
            raise ValueError(f"gamma must be at least 0, got {gamma}")
        self.gamma = gamma

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """Draw the choice of every cell, ``(1, h/2, w/2)``; planes share it, so that their colours belong together."""
        return torch.randint(len(NEIGHBOURS), (1, shape[-2] // 2, shape[-1] // 2), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> NeighborSample:
        """Return the shot ``(4, h, w)`` with the choice of its neighbours."""
        shot = crop.shots[0]
        return NeighborSample(shot, crop.variance(shot), drawn)

    def loss(self, model: Any, sample: NeighborSample, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """Compute the scalar above; the arguments are those of :meth:`Supervised.loss`."""
        first, second = neighbours(sample.noisy, sample.choice)
        first_variance, _ = neighbours(sample.variance, sample.choice)

        with torch.no_grad():
            whole = model(sample.noisy, sample.variance)
        whole_first, whole_second = neighbours(whole, sample.choice)

        denoised = model(first, first_variance)
        difference = criterion(denoised - second, whole_first - whole_second)
        return criterion(denoised, second) + progress * self.gamma * difference


def neighbours(image: Tensor, choice: Tensor) -> tuple[Tensor, Tensor]:
    """Pick the two pictures ``(B, 4, h/2, w/2)`` of ``choice`` ``(B, 1, h/2, w/2)`` from ``(B, 4, h, w)``."""
    height = image.shape[-2] // 2 * 2
    width = image.shape[-1] // 2 * 2
    image = image[..., :height, :width]

    pixels = [image[..., 0::2, 0::2], image[..., 0::2, 1::2], image[..., 1::2, 0::2], image[..., 1::2, 1::2]]
    cells = torch.stack(pixels)
    table = torch.tensor(NEIGHBOURS, device=choice.device)
    first = table[choice, 0][None].expand(1, *cells.shape[1:])
    second = table[choice, 1][None].expand(1, *cells.shape[1:])
    return cells.gather(0, first)[0], cells.gather(0, second)[0]
