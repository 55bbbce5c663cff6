r"""PSNR of demosaiced, white-balanced and gamma-compressed RAW, by which InvISP is measured on MIT-Adobe FiveK.

.. math:: z(y) = \left(\frac{w}{\max w} \, \mathrm{demosaic}(y)\right)^{1/2.2}, \qquad
    \mathrm{PSNR} = -10 \log_{10} \mathrm{mean} (z(\hat y) - z(y))^2

with the frame's as-shot white balance w, bilinear interpolation and :math:`\hat y` within [0, 1]; over the three
channels of each of the frame's 3 x 3 equal pieces, of which the mean is taken. Source: Y. Xing, Z. Qian, Q. Chen,
"Invertible image signal processing", CVPR 2021, and the authors' published scripts. Pieces begin at even sites here.

Frames whose picture is not what the camera made of them: overexposed, or retouched.

Overexposed: the shot with ``2^s`` times the light, RAW and picture clipped at white,

.. math:: y' = \min(2^s y, 1), \qquad x' = E(\min(2^s D(x), 1))

with the sRGB curve E and its inverse D (IEC 61966-2-1). Retouched: the RAW stays, the picture is given an S curve,
``x + c (3 x^2 - 2 x^3 - x)``, and more saturated colour, ``Y + k (x - Y)`` with the luma Y of ITU-R BT.709, as after an
edit by hand.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data.pairs import Pair
from rawaug.io import decode_srgb, encode_srgb
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


STOPS = 1.0
CONTRAST = 0.5
SATURATION = 1.3
LUMA = (0.2126, 0.7152, 0.0722)


def overexposed(pair: Pair) -> Pair:
    """The frame with :data:`STOPS` more light."""
    factor = 2.0**STOPS
    picture = encode_srgb((factor * decode_srgb(pair.srgb.float() / 255.0)).clamp(max=1.0))
    return replace(pair, srgb=_as_8_bits(picture), raw=(factor * pair.raw).clamp(max=1.0))


def retouched(pair: Pair) -> Pair:
    """The frame with an edited picture."""
    x = pair.srgb.float() / 255.0
    x = x + CONTRAST * (3.0 * x**2 - 2.0 * x**3 - x)
    luma = (torch.tensor(LUMA).reshape(3, 1, 1) * x).sum(0, keepdim=True)
    return replace(pair, srgb=_as_8_bits((luma + SATURATION * (x - luma)).clamp(0.0, 1.0)))


ALTERED: dict[str, Callable[[Pair], Pair]] = {"overexposed": overexposed, "retouched": retouched}


def _as_8_bits(picture: Tensor) -> Tensor:
    return (255.0 * picture).round().to(torch.uint8)
