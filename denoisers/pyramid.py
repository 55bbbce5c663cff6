"""A denoiser at half the sides of a picture, where wide noise is narrow: binning, interpolation, and the correction.

The result of one scale, f, is corrected by what is denoised at half the sides:

``g_n(y) = f(y) + U k(g_{n-1}(B y) - B f(y))`` and ``g_0 = f``,

B bins by 2, and U interpolates. k smooths, and falls to 0 where :data:`BLIND` of the values are clipped, since their
mean does not show how much light there was.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from denoisers.layers import PACKED
from rawaug import bayer

MOST_HALVINGS = 4
"""The sides are halved at most this many times."""
BLIND = 0.25
"""The picture at half the sides is ignored where at least this share of the values is clipped."""


def halve(picture: Tensor) -> Tensor:
    """Average a picture ``(B, C, h, w)`` with even sides to half its sides, ``(B, C, h/2, w/2)``.

    Packed RAW, whose sites are those of RGGB, is binned around the places of the new sites.
    """
    if picture.shape[1] != PACKED:
        return F.avg_pool2d(picture, 2)
    return bayer.bin_packed(picture, 2)


def halved_variance(variance: Tensor) -> Tensor:
    """Compute the variance ``(B, C, h/2, w/2)`` that noise has after :func:`halve` from its variance before."""
    share = 0.25
    if variance.shape[1] == PACKED:
        share = bayer.bin_mosaic_variance(2)
    return share * halve(variance)


def double(picture: Tensor) -> Tensor:
    """Interpolate a picture ``(B, C, h, w)`` linearly to twice its sides, ``(B, C, 2h, 2w)``.

    The sites of packed RAW are where :func:`halve` puts them.
    """
    if picture.shape[1] != PACKED:
        return F.interpolate(picture, scale_factor=2, mode="bilinear")

    first_site = [3.0, 7.0, 5.0, 1.0]
    second_site = first_site[::-1]
    taps = torch.tensor([first_site, second_site], device=picture.device) / 8
    kernels = [torch.outer(taps[row], taps[column]) for row, column in bayer.CFA.RGGB.sites]
    weight = torch.stack(kernels)[:, None].to(picture.dtype)

    padded = F.pad(picture, (1, 1, 1, 1), mode="replicate")
    return F.conv_transpose2d(padded, weight, stride=2, padding=3, groups=PACKED)


def smooth_correction(difference: Tensor, clipped: Tensor) -> Tensor:
    """Smooth the correction by a picture at half the sides, ``(B, C, h, w)``, and fade it out where values are clipped.

    ``clipped`` is the share of clipped values, of the same shape. Near its own limit of resolution, the half picture
    knows less than the whole one.
    """
    smooth = F.avg_pool2d(difference, 3, 1, 1, count_include_pad=False)
    clipped_around = F.avg_pool2d(clipped, 3, 1, 1, count_include_pad=False)

    weight = (1.0 - clipped_around / BLIND).clamp_min(0.0)
    return weight * smooth
