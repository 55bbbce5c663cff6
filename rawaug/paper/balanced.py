r"""InvISP's own figure: the PSNR of demosaiced, white-balanced and gamma-compressed RAW.

.. math:: z(y) = \left(\frac{w}{\max w} \, \mathrm{demosaic}(y)\right)^{1/2.2}, \qquad
    \mathrm{PSNR} = -10 \log_{10} \mathrm{mean} (z(\hat y) - z(y))^2

with the as-shot white balance w, bilinear interpolation and :math:`\hat y` within [0, 1]. It is averaged over a frame's
3 x 3 equal pieces, which begin at even sites here. Source: Xing et al., CVPR 2021, and the authors' published scripts.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from statistics import fmean

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data.pairs import Pair
from rawaug.isp.functional import frame_coordinates
from rawaug.metrics import psnr

GAMMA = 2.2
PARTS = 3
"""A frame has this many pieces along each side."""


@torch.no_grad()
def balanced_psnr(make: Callable[[Tensor, Tensor], Tensor], pair: Pair) -> float:
    """Compute InvISP's PSNR in dB, the mean over nine pieces; raise ValueError if the pair is not registered.

    ``make`` maps sRGB ``(1, 3, h, w)`` and its coordinates in the frame ``(1, 2, h, w)`` to RAW ``(1, 1, h, w)``.
    """
    if not pair.registered:
        raise ValueError(f"{pair.name}: is not registered pixel by pixel, so it has no balanced PSNR")

    height, width = pair.clean.mosaic.shape[-2:]
    values = []
    for top, bottom in pairwise(even_edges(height)):
        for begin, end in pairwise(even_edges(width)):
            piece = (None, slice(None), slice(top, bottom), slice(begin, end))
            coordinates = frame_coordinates(bottom - top, end - begin, (top, begin), (height, width))
            raw = make(pair.srgb[piece], coordinates).clamp(0.0, 1.0)
            values.append(psnr(balanced(raw, pair), balanced(pair.clean.mosaic[piece], pair)).item())
    return fmean(values)


def even_edges(side: int) -> list[int]:
    """Find where the equal pieces of a side begin and end, at even places except for the last."""
    edges = [part * side // PARTS // 2 * 2 for part in range(PARTS)]
    return [*edges, side]


def balanced(raw: Tensor, pair: Pair) -> Tensor:
    """Compute z of a mosaic ``(1, 1, h, w)``, of shape ``(1, 3, h, w)``."""
    gains = torch.tensor(pair.clean.white_balance)
    gains = gains / gains.max()
    colour = bayer.demosaic(raw, pair.cfa) * gains.reshape(3, 1, 1)
    return colour.clamp_min(0.0) ** (1.0 / GAMMA)
