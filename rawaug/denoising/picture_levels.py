r"""How strong the noise of a developed picture is, and how sure it is that there is any.

.. math:: \sigma = \sqrt{K r_{25}}, \qquad
   w = \frac{1}{1 + e^{-z}}, \qquad z = a + b \ln(255\, r_{25}) - c \ln(r_{75} / r_{50})

A network f that is told the level of the noise, its standard deviation, also works where the level is unknown. What it
then takes away, :math:`x - f(x, 0)`, tells the level: :math:`r_q` is the q-th percentile of its deviation over squares
of 16 x 16 pixels. Texture raises the upper percentiles, so the lower quartile follows the noise. Noise and fine detail
are alike, though, and the network does best when it is told the geometric mean of that quartile and a usual level K.

Noise lies evenly over a picture and texture does not, so the ratio of two percentiles tells them apart: w is the share
of the network's correction that is applied, near 1 for a noisy picture and smaller for a clean one. A low level would
not do instead, since a network that is told next to nothing takes the level for unknown.

The constants are chosen on noisy pictures (CC15, developed frames, drawn noise) and on clean photographs.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.errors import extra

USUAL_LEVEL = 20.0 / 255.0
"""The usual level K, a standard deviation on the scale where white is 1."""
OFFSET, BY_LEVEL, BY_UNEVENNESS = 4.0, 0.6, 11.0
"""The constants a, b and c of the share."""

_PARTS, _PART, _SQUARE = 3, 256, 16
"""Parts along each side of a picture that are looked at, their side, and the side of their squares, in pixels."""
_SMALLEST = 1e-3 / 255.0
"""The smallest deviation that enters a logarithm."""


class PictureLevel(NamedTuple):
    """The noise of one picture.

    Args:
        level: its standard deviation, on the scale where white is 1.
        share: how much of the correction is applied, from 0 for a clean picture to 1 for a noisy one.
    """

    level: float
    share: float


@torch.inference_mode()
def estimate_level(network: Any, srgb: Tensor) -> PictureLevel:
    """Estimate the noise of a picture ``(1, 3, H, W)`` in [0, 1] for a network of pictures that reads a level.

    Networks that were trained without an unknown level, such as FFDNet, are told scikit-image's estimate.
    """
    if not getattr(network, "light", False):
        return PictureLevel(white_level(srgb), 1.0)

    quartile, median, upper_quartile = _removed_deviations(network, srgb).clamp_min(_SMALLEST)
    unevenness = (upper_quartile / median).log()
    logit = OFFSET + BY_LEVEL * (255.0 * quartile).log() - BY_UNEVENNESS * unevenness

    level = (USUAL_LEVEL * quartile).sqrt()
    return PictureLevel(float(level), float(logit.sigmoid()))


def white_level(srgb: Tensor) -> float:
    """scikit-image's estimate of the standard deviation of white noise in a picture ``(1, 3, H, W)``."""
    with extra("raw"):
        from skimage.restoration import estimate_sigma

    return float(estimate_sigma(srgb[0].cpu().numpy(), channel_axis=0, average_sigmas=True))


def _removed_deviations(network: Any, srgb: Tensor) -> Tensor:
    """The quartiles ``(3,)`` of the deviation, over small squares, of what the network removes at an unknown level."""
    side = min(_SQUARE, *srgb.shape[-2:])

    powers = []
    for part in _spread_parts(srgb):
        correction = part - network(part, torch.zeros_like(part))
        power = correction.float().square().mean(1)
        powers.append(F.avg_pool2d(power, side).flatten())

    deviations = torch.cat(powers).sqrt()
    return deviations.quantile(torch.tensor([0.25, 0.5, 0.75], device=deviations.device))


def _spread_parts(srgb: Tensor) -> Iterator[Tensor]:
    """Cut squares that are spread over a picture ``(1, 3, H, W)``, or take the whole of a small one."""
    height, width = srgb.shape[-2:]
    for top in _spread_places(height):
        for left in _spread_places(width):
            yield srgb[..., top : top + _PART, left : left + _PART].contiguous()


def _spread_places(length: int) -> list[int]:
    """Where parts begin along a side of ``length`` pixels."""
    room = max(0, length - _PART)
    places = {room * k // (_PARTS - 1) for k in range(_PARTS)}
    return sorted(places)
