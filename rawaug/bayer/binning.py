r"""Mosaics of any pattern at half their sides, as RGGB: clean references of real frames, and a pyramid's next level.

.. math:: y'_c(p) = \sum_q w(q - p) \, m_c(q) \, y(q) / \sum_q w(q - p) \, m_c(q)

where m are the planes of the colours and w is a trapezoid of six pixels about the place p of the new site (normalised
convolution: Knutsson and Westin, CVPR 1993). For X-Trans, the mean place of the pixels lies within 0.03 pixels of p.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.bayer.cfa import CFA
from rawaug.bayer.patterns import PATTERNS, Pattern, pattern


class Halving:
    """Brings mosaics of one pattern to half their sides as packed RGGB, and back; sides are multiples of 4.

    A new site is the mean of its colour's pixels around its place, with the weights of :func:`rawaug.bayer.bin_mosaic`,
    except that both greens are one colour.

    Args:
        planes: ``(B, 3, H, W)``, 1 at the sites of a colour and 0 elsewhere.
    """

    def __init__(self, planes: Tensor) -> None:
        taps = torch.tensor([0.25, 0.75, 1.0, 1.0, 0.75, 0.25])
        first_site, second_site = F.pad(taps, (0, 2)), F.pad(taps, (2, 0))
        both = torch.stack([first_site, second_site])
        kernels = [torch.outer(both[i], both[j]) for i, j in CFA.RGGB.sites]
        self.kernels = torch.stack(kernels)[:, None].to(planes)

        self.planes = planes[:, [0, 1, 1, 2]]
        self.weights = self._sums(self.planes, self.kernels).clamp_min(1e-6)

    def __call__(self, mosaic: Tensor) -> Tensor:
        """Halve a mosaic ``(B, 1, H, W)`` to packed ``(B, 4, H/4, W/4)``."""
        return self._sums(mosaic * self.planes, self.kernels) / self.weights

    def variance(self, pixels: Tensor) -> Tensor:
        """Compute the variance of the new sites from that of the pixels, ``(B, 1, H, W)`` or the same everywhere."""
        return self._sums(pixels * self.planes, self.kernels.square()) / self.weights.square()

    def back(self, packed: Tensor) -> Tensor:
        """Enlarge packed ``(B, 4, h, w)`` to full colour ``(B, 3, 4h, 4w)``, linear between the sites of a colour."""
        height, width = 4 * packed.shape[-2], 4 * packed.shape[-1]
        padded = F.pad(packed, (1, 1, 1, 1), mode="replicate")
        enlarged = F.interpolate(padded, scale_factor=4, mode="bilinear")

        # A plane's values belong to the middle of its own sites, which are two pixels apart within a new cell.
        planes = []
        for k, (i, j) in enumerate(CFA.RGGB.sites):
            top, left = 5 - 2 * i, 5 - 2 * j
            planes.append(enlarged[:, k : k + 1, top : top + height, left : left + width])
        red, green_of_red, green_of_blue, blue = planes
        return torch.cat([red, (green_of_red + green_of_blue) / 2, blue], dim=1)

    @staticmethod
    def _sums(planes: Tensor, kernels: Tensor) -> Tensor:
        """Filter each of four planes by its own kernel, and keep every fourth result."""
        return F.conv2d(planes, kernels, stride=4, padding=2, groups=4)


def to_bayer(mosaic: Tensor, cfa: str) -> Tensor:
    """Convert a mosaic ``(1, H, W)`` of any pattern to RGGB at half the sides, ``(1, h, w)``, h and w even.

    Lines at the end that fill no cell are left out. In Quad-Bayer, so is a first line that would halve the squares of a
    colour.
    """
    array = pattern(cfa)
    top, left = _whole_origin(array)
    height = (mosaic.shape[-2] - top) // 4 * 4
    width = (mosaic.shape[-1] - left) // 4 * 4
    if not min(height, width):
        raise ValueError(f"a mosaic of {tuple(mosaic.shape[-2:])} is too small for half of its sides; it needs 4 x 4")

    halving = Halving(array.shift(top, left).planes(height, width)[None])
    packed = halving(mosaic[None, :, top : top + height, left : left + width])
    return F.pixel_shuffle(packed, 2)[0]


def _whole_origin(array: Pattern) -> tuple[int, int]:
    """Find the first origin next to the corner where a pattern begins anew; take the corner itself if there is none."""
    for top, left in product((0, 1), repeat=2):
        if array.shift(top, left).name in PATTERNS:
            return top, left
    return 0, 0
