r"""How strong the noise of a developed picture is, how sure it is that there is any, and whether a camera finished it.

.. math:: \sigma = \sqrt{(1 - u / 2) K r_{25}}, \qquad
   w = S(a + b \ln(255\, r_{25}) - c \ln(r_{75} / r_{50})), \qquad
   u = S(e\, (\rho_1 - t_1))\, S(e\, (t_2 - \rho_2 - \rho_{RGB})), \qquad S(z) = \frac{1}{1 + e^{-z}}

A network f that is told the level of the noise, its standard deviation, also works where the level is unknown. What it
then removes, :math:`x - f(x, 0)`, tells the level: :math:`r_q` is the q-th percentile of its deviation over squares of
16 x 16 pixels. Texture raises the upper percentiles, so the lower quartile follows the noise. Noise and fine detail are
alike, though, and the network does best when it is told the geometric mean of that quartile and a usual level K (half
of K where u is 1).

Noise lies evenly over a picture and texture does not, so the ratio of two percentiles tells them apart: w is the share
of the network's correction that is applied, near 1 for a noisy picture and smaller for a clean one. A low level would
not do instead, since a network that is told next to nothing takes the level for unknown.

u says how sure it is that nobody has finished the picture since it was developed from RAW. Demosaicing makes the noise
of neighbours alike, but hardly that of pixels two apart, and the colour correction matrix makes that of different
colours unlike; the denoising, the sharpening and the conversion to luma and chroma in a camera make both alike again.
All correlations are those of what is removed, in the half of the squares that have the least of it: :math:`\rho_1` and
:math:`\rho_2` between pixels one and two apart, :math:`\rho_{RGB}` between two colours, the mean of the pairs.

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
STEEPNESS, LEAST_OF_NEIGHBOURS, MOST_OF_OTHERS = 30.0, 0.25, 0.34
"""The constants e, t1 and t2: below t1 the picture was never demosaiced, above t2 it was finished."""

_PARTS, _PART, _SQUARE = 3, 256, 16
"""Parts along each side of a picture that are looked at, their side, and the side of their squares, in pixels."""
_SMALLEST = 1e-3 / 255.0
"""The smallest deviation that enters a logarithm."""


class PictureLevel(NamedTuple):
    """The noise of one picture.

    Args:
        level: its standard deviation, on the scale where white is 1.
        share: how much of the correction is applied, from 0 for a clean picture to 1 for a noisy one.
        unfinished: how sure it is that nobody finished the picture after its development, from 0 to 1.
    """

    level: float
    share: float
    unfinished: float = 0.0


@torch.inference_mode()
def estimate_level(network: Any, srgb: Tensor) -> PictureLevel:
    """Estimate the noise of a picture ``(1, 3, H, W)`` in [0, 1] for a network of pictures that reads a level.

    Networks that were trained without an unknown level, such as FFDNet, are told scikit-image's estimate.
    """
    if not getattr(network, "light", False):
        return PictureLevel(white_level(srgb), 1.0)

    squares = _removed_squares(network, srgb)
    percentiles = torch.tensor([0.25, 0.5, 0.75], device=srgb.device)
    deviations = squares.power.sqrt().quantile(percentiles)
    quartile, median, upper_quartile = deviations.clamp_min(_SMALLEST)

    unevenness = (upper_quartile / median).log()
    share = OFFSET + BY_LEVEL * (255.0 * quartile).log() - BY_UNEVENNESS * unevenness

    even = squares.power <= median.square()
    power = squares.power[even].sum().clamp_min(_SMALLEST**2)
    neighbours = squares.one_apart[even].sum() / power
    others = squares.two_apart[even].sum().clamp_min(0.0) / power + squares.of_colours[even].sum() / power
    was_demosaiced = (STEEPNESS * (neighbours - LEAST_OF_NEIGHBOURS)).sigmoid()
    unfinished = was_demosaiced * (STEEPNESS * (MOST_OF_OTHERS - others)).sigmoid()

    level = ((1.0 - unfinished / 2.0) * USUAL_LEVEL * quartile).sqrt()
    return PictureLevel(float(level), float(share.sigmoid()), float(unfinished))


def white_level(srgb: Tensor) -> float:
    """scikit-image's estimate of the standard deviation of white noise in a picture ``(1, 3, H, W)``."""
    with extra("raw"):
        from skimage.restoration import estimate_sigma

    return float(estimate_sigma(srgb[0].cpu().numpy(), channel_axis=0, average_sigmas=True))


class _Squares(NamedTuple):
    """Means over small squares, each ``(N,)``, of products of what a network removes.

    Attributes:
        power: the square of what is removed, the mean of the colours.
        of_colours: the product of two colours, the mean of the three pairs.
        one_apart: the product of neighbours, the mean of rows and columns and of the colours.
        two_apart: the same for pixels that are two apart.
    """

    power: Tensor
    of_colours: Tensor
    one_apart: Tensor
    two_apart: Tensor


def _removed_squares(network: Any, srgb: Tensor) -> _Squares:
    """Measure what the network removes at an unknown level, in squares of the parts of a picture."""
    side = min(_SQUARE, *srgb.shape[-2:])

    parts = []
    for part in _spread_parts(srgb):
        removed = (part - network(part, torch.zeros_like(part))).float()
        power = removed.square().mean(1, keepdim=True)

        colours = removed.shape[1]
        of_all = removed.mean(1, keepdim=True).square()
        of_colours = (colours * of_all - power) / (colours - 1)

        products = [power, of_colours, _times_shifted(removed, 1), _times_shifted(removed, 2)]
        parts.append(F.avg_pool2d(torch.cat(products, dim=1), side).flatten(2))

    return _Squares(*torch.cat(parts, dim=2)[0])


def _times_shifted(removed: Tensor, distance: int) -> Tensor:
    """Multiply the pixels of ``(1, 3, h, w)`` by those below and beside: the mean of both and of the colours."""
    below = F.pad(removed, (0, 0, 0, distance))[..., distance:, :]
    beside = F.pad(removed, (0, distance))[..., distance:]
    return (removed * (below + beside) / 2).mean(1, keepdim=True)


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
