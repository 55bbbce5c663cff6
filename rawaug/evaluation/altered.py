r"""Frames whose picture is not what the camera made of them: overexposed, or retouched.

Overexposed: the shot with ``2^s`` times the light, RAW and picture clipped at white,

.. math:: y' = \min(2^s y, 1), \qquad x' = E(\min(2^s D(x), 1))

with the sRGB curve E and its inverse D (IEC 61966-2-1). Retouched: the RAW stays, the picture is given an S curve,
``x + c (3 x^2 - 2 x^3 - x)``, and more saturated colour, ``Y + k (x - Y)`` with the luma Y of ITU-R BT.709, as after an
edit by hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from rawaug.data.pair import Pair
from rawaug.io import decode_srgb, encode_srgb

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
