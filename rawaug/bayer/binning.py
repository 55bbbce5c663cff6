r"""Mosaics of any pattern at half their sides, as RGGB: clean references of real frames, and what a pyramid looks at.

.. math:: y'_c(p) = \sum_q w(q - p) \, m_c(q) \, y(q) / \sum_q w(q - p) \, m_c(q)

for the planes m of the colours and a trapezoid w of six pixels about the place p of the new site (normalised
convolution: Knutsson and Westin, CVPR 1993). Of X-Trans the pixels' mean place lies within 0.03 pixels of p.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.bayer.cfa import CFA
from rawaug.bayer.patterns import PATTERNS, pattern


class Halving:
    """Brings mosaics of one pattern, sides multiples of 4, to half their sides as packed RGGB, and back.

    A new site is the mean of its colour's pixels around its place, weighed as by :func:`rawaug.bayer.bin_mosaic`, only
    that both greens are one colour.

    Args:
        planes: ``(B, 3, H, W)``, 1 at the sites of a colour and 0 elsewhere.
    """

    def __init__(self, planes: Tensor) -> None:
        taps = torch.tensor([0.25, 0.75, 1.0, 1.0, 0.75, 0.25])
        both = torch.stack([F.pad(taps, (0, 2)), F.pad(taps, (2, 0))])  # of the first and second site of a cell
        kernels = torch.stack([torch.outer(both[i], both[j]) for i, j in CFA.RGGB.sites])[:, None]
        self.kernels = kernels.to(planes)
        self.planes = planes[:, [0, 1, 1, 2]]
        self.weights = self._sums(self.planes, self.kernels).clamp_min(1e-6)

    def __call__(self, mosaic: Tensor) -> Tensor:
        """Halve a mosaic ``(B, 1, H, W)``: packed ``(B, 4, H/4, W/4)``."""
        return self._sums(mosaic * self.planes, self.kernels) / self.weights

    def variance(self, map_of_it: Tensor) -> Tensor:
        """Compute the variance of the new sites from that of the pixels, ``(B, 1, H, W)`` or the same everywhere."""
        return self._sums(map_of_it * self.planes, self.kernels.square()) / self.weights.square()

    def back(self, packed: Tensor) -> Tensor:
        """Enlarge packed ``(B, 4, h, w)`` to full colour ``(B, 3, 4h, 4w)``, linear between the sites of a colour."""
        height, width = (4 * side for side in packed.shape[-2:])
        up = F.interpolate(F.pad(packed, (1, 1, 1, 1), mode="replicate"), scale_factor=4, mode="bilinear")
        starts = [(5 - 2 * i, 5 - 2 * j) for i, j in CFA.RGGB.sites]
        red, green, other, blue = (
            up[:, k : k + 1, top : top + height, left : left + width] for k, (top, left) in enumerate(starts)
        )
        return torch.cat([red, (green + other) / 2, blue], dim=1)

    @staticmethod
    def _sums(planes: Tensor, kernels: Tensor) -> Tensor:
        return F.conv2d(planes, kernels, stride=4, padding=2, groups=4)


def to_bayer(mosaic: Tensor, cfa: str) -> Tensor:
    """Convert a mosaic ``(1, H, W)`` of any pattern to RGGB at half the sides, ``(1, h, w)``, h and w even.

    Lines at the end that fill no cell are left out, and in Quad-Bayer a first line that would halve the squares of a
    colour.
    """
    known, places = pattern(cfa), ((0, 0), (0, 1), (1, 0), (1, 1))
    top, left = next((place for place in places if known.shift(*place).name in PATTERNS), (0, 0))
    height, width = ((side - first) // 4 * 4 for side, first in zip(mosaic.shape[-2:], (top, left), strict=True))
    if not min(height, width):
        raise ValueError(f"a mosaic of {tuple(mosaic.shape[-2:])} is too small for half of its sides; it needs 4 x 4")
    halving = Halving(known.shift(top, left).planes(height, width)[None])
    return F.pixel_shuffle(halving(mosaic[None, :, top : top + height, left : left + width]), 2)[0]
