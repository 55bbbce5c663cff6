r"""PSNR of demosaiced, white-balanced and gamma-compressed RAW, by which InvISP is measured on MIT-Adobe FiveK.

.. math:: z(y) = \left(\frac{w}{\max w} \, \mathrm{demosaic}(y)\right)^{1/2.2}, \qquad
    \mathrm{PSNR} = -10 \log_{10} \mathrm{mean} (z(\hat y) - z(y))^2

with the frame's as-shot white balance w, bilinear interpolation and :math:`\hat y` within [0, 1]; over the three
channels of each of the frame's 3 x 3 equal pieces, of which the mean is taken. Source: Y. Xing, Z. Qian, Q. Chen,
"Invertible image signal processing", CVPR 2021, and the authors' published scripts. Pieces begin at even sites here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data.pair import Pair
from rawaug.isp.stages import place_in_frame
from rawaug.metrics import psnr

GAMMA = 2.2
PARTS = 3


@torch.no_grad()
def balanced_psnr(make: Callable[[Tensor, Tensor], Tensor], pair: Pair) -> float:
    """Mean over the pieces; ``make`` maps sRGB ``(1, 3, h, w)`` and its place in the frame to RAW ``(1, 1, h, w)``.

    Raises:
        ValueError: if the pair is not registered pixel by pixel.
    """
    if not pair.registered:
        raise ValueError(f"{pair.name}: is not registered pixel by pixel, so it has no balanced PSNR")
    height, width = pair.raw.shape[-2:]
    values = []
    for rows in _parts(height):
        for columns in _parts(width):
            piece = (None, slice(None), rows, columns)
            size = rows.stop - rows.start, columns.stop - columns.start
            place = place_in_frame(*size, (rows.start, columns.start), (height, width))
            made = make(pair.srgb[piece], place).clamp(0.0, 1.0)
            values.append(psnr(_seen(made, pair), _seen(pair.raw[piece], pair)).item())
    return sum(values) / len(values)


def _parts(side: int) -> Iterator[slice]:
    edges = [k * side // PARTS // 2 * 2 for k in range(PARTS)] + [side]
    return (slice(first, last) for first, last in pairwise(edges))


def _seen(raw: Tensor, pair: Pair) -> Tensor:
    """z of a mosaic ``(1, 1, h, w)``: ``(1, 3, h, w)``."""
    gains = torch.tensor(pair.white_balance)
    balanced = bayer.demosaic(raw, pair.cfa) * (gains / gains.max()).reshape(3, 1, 1)
    return balanced.clamp_min(0.0) ** (1.0 / GAMMA)
