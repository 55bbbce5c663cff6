"""Two neighbours of every cell of pixels, one as input and one as target (Huang et al., CVPR 2021)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug.registry import ESTIMATORS
from rawaug.training.criteria import Criterion
from rawaug.training.estimators.self_supervised import NoisyCrop, SelfSupervised, variance_of


class NeighborSample(NamedTuple):
    """A noisy frame and, for each 2 x 2 cell of a plane, which two neighbours make the pair.

    Args:
        noisy, variance: packed ``(4, h, w)``, in a batch ``(B, 4, h, w)``.
        choice: ``(1, h/2, w/2)`` from 0 to 7, see :data:`NEIGHBOURS`.
    """

    noisy: Tensor
    variance: Tensor
    choice: Tensor


NEIGHBOURS = ((0, 1), (1, 0), (2, 3), (3, 2), (0, 2), (2, 0), (1, 3), (3, 1))
"""Ordered pairs of horizontal or vertical neighbours among the pixels 0 1 / 2 3 of a cell."""


@ESTIMATORS.register("neighbor2neighbor")
class Neighbor2Neighbor(SelfSupervised):
    """Two neighbours of every 2 x 2 cell of each packed plane, one as input and one as target.

    ``loss = c(f(g1 y), g2 y) + gamma c(f(g1 y) - g2 y, g1 f(y) - g2 f(y))``: the second term takes off what the
    neighbours' own difference, as the network sees it, adds to the first; gradients do not pass through f(y). An
    untrained network takes noise for that difference, so the term comes in as training goes on.

    Args:
        gamma: its weight at the end; it grows in proportion to the steps. Published: 2 for synthetic noise, 16 for the
            RAW of SIDD; the larger it is, the smoother the result.
    """

    def __init__(self, gamma: float = 2.0) -> None:
        if gamma < 0:
            raise ValueError(f"gamma must be at least 0, got {gamma}")
        self.gamma = gamma

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """The choice of every cell; the planes share it, so that their colours belong together."""
        return torch.randint(len(NEIGHBOURS), (1, shape[-2] // 2, shape[-1] // 2), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> NeighborSample:
        """See :meth:`SelfSupervised.apply`."""
        noisy = crop.shots[0]
        return NeighborSample(noisy, variance_of(noisy, crop.shot_var, crop.read_var), drawn)

    def loss(self, model: Any, sample: NeighborSample, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """See :meth:`Supervised.loss`."""
        (first, second), (variance, _) = (neighbours(x, sample.choice) for x in (sample.noisy, sample.variance))
        with torch.no_grad():
            denoised_first, denoised_second = neighbours(model(sample.noisy, sample.variance), sample.choice)
        denoised = model(first, variance)
        difference = criterion(denoised - second, denoised_first - denoised_second)
        return criterion(denoised, second) + progress * self.gamma * difference


def neighbours(image: Tensor, choice: Tensor) -> tuple[Tensor, Tensor]:
    """The two pictures ``(B, 4, h/2, w/2)`` that ``choice`` ``(B, 1, h/2, w/2)`` picks from ``(B, 4, h, w)``."""
    height, width = (side // 2 * 2 for side in image.shape[-2:])
    image = image[..., :height, :width]
    cells = torch.stack([image[..., i::2, j::2] for i in (0, 1) for j in (0, 1)])
    table = torch.tensor(NEIGHBOURS, device=choice.device)
    first, second = (table[choice, k][None].expand(1, *cells.shape[1:]) for k in (0, 1))
    return cells.gather(0, first)[0], cells.gather(0, second)[0]
