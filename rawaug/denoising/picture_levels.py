r"""How strong the noise of a developed picture is for a network that is told so, and how sure it is that there is any.

.. math:: \sigma = \exp(a + b \ln r - c \rho_1 + d \rho_2), \quad
   s \le \sigma / r \le \min(u\, e^{v \max(0, \rho_1)} \max(1, 4 / r)^{3/2}, t \max(1, 10 / r)^{3/2}), \quad
   w = S(p - q \ln(r / r_{25})), \quad S(z) = \frac{1}{1 + e^{-z}}

A network f that is told the level of the noise, its standard deviation, also works where the level is unknown. What it
then removes, :math:`x - f(x, 0)`, tells the level. Its deviation is measured over squares of 16 x 16 pixels, of which
:math:`r` is the median and :math:`r_{25}` the lower quartile. r and :math:`\sigma` are in codes, on the scale where
white is 255.

The best level to tell is not that deviation alone. Noise and fine detail are alike, so b is below 1. And the network
needs a higher level the further the grain reaches, which shows in what is removed: :math:`\rho_1` and :math:`\rho_2`
are its correlations between pixels one and two apart, in the half of the squares that have the least of it. Demosaicing
makes neighbours alike, but hardly pixels two apart; the wide filters of a camera's noise reduction make both alike.

That line is for weak noise which cameras have finished. White noise, whose :math:`\rho_1` is 0, and strong noise are
removed nearly whole, and r itself is their deviation. Told much more, the network removes detail, and told less, it
leaves coarse grain. Hence the bounds: s to t times r where r is above 10 codes, and at most u times r for white noise
where r is above 4. Where little is removed, it says little.

w is the share of the network's correction that is applied, near 1 for a noisy picture and smaller for a clean one.
Noise lies evenly over a picture and texture does not, so the ratio of the median to the lower quartile tells them
apart. A low level would not do instead, since a network that is told next to nothing takes the level for unknown.

The constants are those with which pictures are denoised best (CC15, developed frames, drawn noise) while clean
photographs stay as they are; those of the bounds were chosen on the training photographs with drawn noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.errors import extra

LEVEL, BY_REMOVED, BY_NEIGHBOURS, BY_SECOND_NEIGHBOURS = 1.89, 0.65, 2.5, 3.1
"""The constants a, b, c and d of the level."""
LEAST, MOST_OF_WHITE, MOST_BY_NEIGHBOURS, MOST_OF_STRONG = 1.05, 1.15, 12.0, 1.6
"""The constants s, u, v and t of the bounds."""
SHARE, SHARE_BY_UNEVENNESS = 7.0, 5.4
"""The constants p and q of the share."""

_WHOLE, _STRONG = 4.0, 10.0
"""From these removed deviations on, in codes, white noise is removed whole, and noise is strong."""
_LOWEST = 2.0
"""No lower level is told, in codes, since the network takes one near 0 for unknown."""
_PARTS, _PART, _SQUARE = 3, 256, 16
"""Parts along each side of a picture that are looked at, their side, and the side of their squares, in pixels."""
_SMALLEST = 1e-3 / 255.0
"""The smallest deviation that enters a logarithm."""


@torch.inference_mode()
def estimate_level(network: Any, srgb: Tensor) -> tuple[float, float]:
    """Estimate the noise of a picture ``(1, 3, H, W)`` in [0, 1] for a network of pictures that reads a level.

    Networks that were trained without an unknown level, such as FFDNet, are told scikit-image's estimate.

    Returns:
        The standard deviation, on the scale where white is 1; and the share of the correction that is applied, from 0
        for a clean picture to 1 for a noisy one.
    """
    if not getattr(network, "light", False):
        return white_level(srgb), 1.0

    # What it removes at an unknown level: its power, and products of pixels one and two apart, by squares ``(N,)``.
    side = min(_SQUARE, *srgb.shape[-2:])
    squares = []
    for part in spread_parts(srgb):
        removed = (part - network(part, torch.zeros_like(part))).float()
        power = removed.square().mean(1, keepdim=True)
        products = [power, _times_shifted(removed, 1), _times_shifted(removed, 2)]
        squares.append(F.avg_pool2d(torch.cat(products, dim=1), side).flatten(2))
    powers, one_apart, two_apart = torch.cat(squares, dim=2)[0]

    percentiles = torch.tensor([0.25, 0.5], device=srgb.device)
    quartile, median = powers.sqrt().quantile(percentiles).clamp_min(_SMALLEST)

    even = powers <= median.square()
    power = powers[even].sum().clamp_min(_SMALLEST**2)
    neighbours = one_apart[even].sum() / power
    second_neighbours = two_apart[even].sum().clamp_min(0.0) / power

    codes = 255.0 * median
    log_level = LEVEL + BY_REMOVED * codes.log()
    log_level = log_level - BY_NEIGHBOURS * neighbours + BY_SECOND_NEIGHBOURS * second_neighbours

    most_of_white = MOST_OF_WHITE * (MOST_BY_NEIGHBOURS * neighbours.clamp_min(0.0)).exp()
    most_of_white = most_of_white * (_WHOLE / codes).clamp_min(1.0) ** 1.5
    most_of_strong = MOST_OF_STRONG * (_STRONG / codes).clamp_min(1.0) ** 1.5
    most = codes * torch.minimum(most_of_white, most_of_strong)
    level = log_level.exp().clamp_min(LEAST * codes).minimum(most).clamp_min(_LOWEST) / 255.0

    share = SHARE - SHARE_BY_UNEVENNESS * (median / quartile).log()
    return float(level), float(share.sigmoid())


def white_level(srgb: Tensor) -> float:
    """scikit-image's estimate of the standard deviation of white noise in a picture ``(1, 3, H, W)``."""
    with extra("raw"):
        from skimage.restoration import estimate_sigma

    return float(estimate_sigma(srgb[0].cpu().numpy(), channel_axis=0, average_sigmas=True))


def _times_shifted(removed: Tensor, distance: int) -> Tensor:
    """Multiply the pixels of ``(1, 3, h, w)`` by those below and beside: the mean of both and of the colours."""
    below = F.pad(removed, (0, 0, 0, distance))[..., distance:, :]
    beside = F.pad(removed, (0, distance))[..., distance:]
    return (removed * (below + beside) / 2).mean(1, keepdim=True)


def spread_parts(srgb: Tensor) -> Iterator[Tensor]:
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
