r"""Global image denoising, GLIDE (Talebi and Milanfar, TIP 2014).

Every pixel is estimated from all others, :math:`\hat z = W y`, by one filter, whose leading eigenvectors are enough:
:math:`\hat z = V_m S_m^k V_m^T y`. The affinity of two pixels is :math:`\exp(-|p_i - p_j|^2 / h^2)` of their colours p
in a picture that was prefiltered by non-local means, so that patches need not be compared again. Affinities are
computed between all pixels and a hundredth of them, evenly spaced, and extended to the rest (Nyström). Sinkhorn's
scaling makes W symmetric, with rows that sum to 1, so that its eigenvalues lie in [0, 1] and constants do not change.
The power k and the number m of eigenvectors minimise the estimated error

.. math:: \sum_{i \le m} (1 - s_i^k)^2 b_i^2 + \sigma^2 s_i^{2k} + \sum_{i > m} b_i^2

where :math:`b_i^2 = (v_i^T y)^2 - \sigma^2` is what the noisy picture shows of the clean one. With all eigenvectors and
k = 0 the picture stays as it is, at an error of :math:`n \sigma^2`. So do pixels whose row cannot be scaled to 1.

Pictures are cut into tiles, since the samples of a whole frame would not fit in memory. The colours are filtered as
luminance and differences, all by affinities of the four planes together.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from denoisers.classical import FILTERS, Classical, NonLocalMeans, Planes, from_opponent, to_opponent

TILE, MARGIN = 128, 8
"""A tile has this side and reaches this far beyond what is kept of it, in packed pixels."""
SHARE, LEAST, MOST = 0.01, 64, 400
"""This share of the pixels is sampled, with a least and a largest number."""
WIDTH = 1.25
"""This is h, in deviations of the noise."""
SCALINGS = 30
"""Sinkhorn's scaling runs this many rounds."""
LEAST_SUM = 1e-6
"""The scaling can bring a row to 1 if its sum is at least this: the extension of affinities has entries below 0."""
POWERS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
"""These powers k are tried."""


def affinities(guide: Tensor) -> tuple[Tensor, Tensor]:
    """Compute affinities of all n pixels of a prefiltered picture ``(C, h, w)`` with p sampled ones.

    Returns:
        The affinities ``(n, p)``, and the indices ``(p,)`` of the sampled pixels.
    """
    features = guide.flatten(1).T.contiguous()
    pixels = len(features)

    count = min(max(round(SHARE * pixels), LEAST), MOST, pixels)
    sampled = torch.linspace(0, pixels - 1, count).round().long().unique()
    distances = torch.cdist(features, features[sampled]).square() / features.shape[1]
    # A factor for each pixel makes no difference to Sinkhorn's scaling. Without it, all affinities of a colour that is
    # unlike every sample would underflow, and the pixel would become 0.
    distances = distances - distances.amin(dim=1, keepdim=True)
    return torch.exp(-distances / WIDTH**2), sampled


def eigenvectors(affinity: Tensor, sampled: Tensor) -> tuple[Tensor, Tensor]:
    """Compute leading eigenvectors ``(n, m)`` of the filter W, orthonormal, and their eigenvalues ``(m,)``, falling.

    Pixels that the filter does not reach have rows of 0.

    Args:
        affinity: of n pixels with p sampled ones, ``(n, p)``.
        sampled: indices of these, ``(p,)``.
    """
    # K = C A^+ C^T = G G^T with the affinities A among the sampled pixels.
    affinity = affinity.double()
    squares, vectors = torch.linalg.eigh(affinity[sampled])
    is_leading = squares > 1e-6 * squares[-1]
    factor = affinity @ (vectors[:, is_leading] / squares[is_leading].sqrt())

    scale = torch.ones(len(factor), dtype=torch.float64)
    for _ in range(SCALINGS):
        row_sums = scale * (factor @ (factor.T @ scale))
        is_reached = row_sums > LEAST_SUM
        scale = torch.where(is_reached, scale / row_sums.clamp_min(LEAST_SUM).sqrt(), 0.0)
    balanced = scale[:, None] * factor

    values, rotation = torch.linalg.eigh(balanced.T @ balanced)
    order = values.argsort(descending=True)
    order = order[values[order] > 1e-9]
    leading = balanced @ rotation[:, order] / values[order].sqrt()
    return leading, values[order]


def filter_plane(plane: Tensor, vectors: Tensor, values: Tensor, noise: float) -> Tensor:
    """Filter a plane of pixels ``(n,)``; the power and the number of eigenvectors minimise the estimated error."""
    coefficients = vectors.T @ plane.double()
    energy = (coefficients.square() - noise**2).clamp_min(0.0)
    total = (plane.double().square().sum() - len(plane) * noise**2).clamp_min(0.0)
    missing = (total - energy.cumsum(0)).clamp_min(0.0)

    best_error = len(plane) * noise**2
    best = plane
    for power in POWERS:
        factors = values.clamp(0.0, 1.0) ** power
        error = ((1.0 - factors).square() * energy + noise**2 * factors.square()).cumsum(0) + missing
        number = int(error.argmin()) + 1
        if error[number - 1].item() < best_error:
            best_error = error[number - 1].item()
            best = (vectors[:, :number] @ (factors[:number] * coefficients[:number])).to(plane)
    return best


@FILTERS.register("GLIDE")
class GLIDE(Classical):
    """Global image denoising (Talebi and Milanfar, TIP 2014), prefiltered by non-local means."""

    smallest = 16
    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, C)``, C = 3 or 4, tile by tile."""
        guide = NonLocalMeans(self.strength).denoise(planes)
        height, width = planes.shape[:2]
        result = np.empty_like(planes)

        for row in range(0, height, TILE):
            for column in range(0, width, TILE):
                first_row = max(row - MARGIN, 0)
                first_column = max(column - MARGIN, 0)
                rows = slice(first_row, min(row + TILE + MARGIN, height))
                columns = slice(first_column, min(column + TILE + MARGIN, width))

                tile = self._tile(planes[rows, columns], guide[rows, columns])
                inner = tile[row - first_row :, column - first_column :][:TILE, :TILE]
                result[row : row + TILE, column : column + TILE] = inner
        return result

    def _tile(self, planes: Planes, guide: Planes) -> Planes:
        affinity, sampled = affinities(torch.from_numpy(guide).permute(2, 0, 1))
        vectors, values = eigenvectors(affinity, sampled)
        is_reached = vectors.square().sum(dim=1) > 0.0

        opponent = to_opponent(planes)
        cleaned = np.empty_like(opponent)
        for channel in range(opponent.shape[2]):
            plane = torch.from_numpy(np.ascontiguousarray(opponent[..., channel]))
            pixels = plane.flatten().clone()
            pixels[is_reached] = filter_plane(pixels[is_reached], vectors[is_reached], values, self.strength)
            cleaned[..., channel] = pixels.reshape(plane.shape).numpy()
        return from_opponent(cleaned)
