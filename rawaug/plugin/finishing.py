r"""Finishing as cameras do it between demosaicing and the file: softness, noise reduction, sharpening, JPEG.

Let Y be the luma and C the chroma (R - Y and B - Y, Y of BT.601) of the developed picture. With a Gaussian blur
:math:`G_s` of deviation s pixels, the mean :math:`M` within a square window, and shares m and n,

.. math:: x' = G_s x, \qquad C' = C + m (G_c C - C), \qquad Y' = Y + n (\bar a Y + M[(1 - a) M Y] - Y),
   \qquad Y'' = Y' + u (Y' - G_r Y')

The lens, the low-pass filter and demosaicing soften the picture, :math:`G_s`. Luma noise is reduced by the self-guided
filter (He, Sun and Tang, PAMI 2013). Its weights :math:`a = \max(0, 1 - k \sigma^2 / v)` go from 0 in flat areas to 1
at edges. There v is the variance of noisy luma in the window, :math:`\sigma^2` the variance of its noise, and
:math:`\bar a = M a`. Noise is therefore left at edges, as cameras leave it. The clean picture is finished with the
weights that the noisy one gave, so that it is what the mean of many such shots would be, if it was their mean before
(``shots`` of :class:`rawaug.Srgb`). JPEG acts on the noisy picture alone.

Pictures that are shown smaller than they were taken need nothing here. A picture is scaled before its crop, in the
loader of pictures; a pair could be scaled only by cutting a larger crop than was asked for. ``zoom`` of
:class:`rawaug.RawPairs` makes softer pictures, like those that come out of a camera at full size.

The ranges are fitted to the noise of developed pictures (``python -m benchmarks.picture_noise``): its autocorrelation
by channel, the correlation between channels, its power by band, and the ratio of its variance at edges to that in flat
areas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.kernels import fastest
from rawaug.kernels.runtime import move_together, one_thread, replace_pictures, take_pictures
from rawaug.noise.models import per_picture

_REACH = 2.5
"""Half-width of a Gaussian filter, in standard deviations."""


@dataclass(frozen=True)
class Finish:
    """How cameras finish pictures. Each picture draws its values from ranges, given as lowest and highest.

    Args:
        softness: deviation s of the blur of the whole picture, in pixels.
        window: half the side of the window in which luma noise is reduced, in pixels.
        luma: share n of the filtered luma.
        edge: k, the factor by which local variance must exceed the noise variance at an edge; drawn log-uniformly.
        chroma_blur: deviation c of the chroma blur, in pixels, drawn log-uniformly.
        chroma: share m of the blurred chroma.
        sharpening: amount u of the unsharp mask.
        radius: deviation r of that mask, in pixels.
        quality: quality of the JPEG; None leaves out JPEG.
        unfinished: share of the pictures that are only compressed.

    Raises:
        ValueError: if a range is out of order, or a share leaves [0, 1].
    """

    softness: tuple[float, float] = (0.59, 0.81)
    window: tuple[float, float] = (6.5, 8.0)
    luma: tuple[float, float] = (0.36, 0.51)
    edge: tuple[float, float] = (2.2, 5.2)
    chroma_blur: tuple[float, float] = (1.1, 3.7)
    chroma: tuple[float, float] = (0.62, 0.9)
    sharpening: tuple[float, float] = (0.25, 1.65)
    radius: tuple[float, float] = (1.0, 1.9)
    quality: tuple[int, int] | None = (90, 99)
    unfinished: float = 0.0

    def __post_init__(self) -> None:
        for key in _RANGES:
            low, high = getattr(self, key)
            most = 1.0 if key in ("luma", "chroma") else 100.0
            if not 0.0 <= low <= high <= most:
                raise ValueError(f"finish: {key} must be (lowest, highest) within 0 to {most:g}, got ({low}, {high})")

        if not 0.0 <= self.unfinished <= 1.0:
            raise ValueError(f"finish: unfinished must be a share in [0, 1], got {self.unfinished}")

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``finish`` ``(batch, 8)``, a column for each range before ``quality``, zeros for unfinished pictures.

        ``chroma_420`` ``(batch,)`` says where JPEG halves the chroma.
        """
        *shares, unfinished, chroma = torch.rand(len(_RANGES) + 2, batch, generator=generator)
        columns = []
        for key, share in zip(_RANGES, shares, strict=True):
            columns.append(_between(getattr(self, key), share, by_logarithm=key in _BY_LOGARITHM))

        is_finished = unfinished >= self.unfinished
        return {"finish": torch.stack(columns, dim=1) * is_finished[:, None], "chroma_420": chroma < 0.5}

    @one_thread()  # the same bits everywhere
    def apply(self, noisy: Tensor, clean: Tensor, finish: Tensor) -> tuple[Tensor, Tensor]:
        """Finish noisy and clean sRGB ``(B, 3, H, W)`` in [0, 1] alike, by the ``finish`` of :meth:`sample`."""
        pictures, finish = torch.cat([noisy, clean], dim=1), finish.cpu()
        is_finished = finish.any(dim=1)
        if is_finished.any():
            finished = _finish(take_pictures(pictures, is_finished), finish[is_finished])
            pictures = replace_pictures(pictures, is_finished, finished)

        noisy, clean = pictures.split(3, dim=1)
        return noisy.contiguous(), clean.contiguous()


_RANGES = ("softness", "window", "luma", "edge", "chroma_blur", "chroma", "sharpening", "radius")
_BY_LOGARITHM = ("edge", "chroma_blur")


def _between(limits: tuple[float, float], share: Tensor, by_logarithm: bool) -> Tensor:
    """The values at shares ``(B,)`` of the way from the lowest to the highest."""
    low, high = limits
    if by_logarithm and low > 0.0:
        return low * (high / low) ** share
    return low + (high - low) * share


def _finish(pictures: Tensor, finish: Tensor) -> Tensor:
    """Finish noisy and clean pictures ``(B, 6, H, W)``, colour by colour, as ``finish`` ``(B, 8)`` says."""
    softness, window, share, edge, chroma_blur, mix, amount, radius = finish.unbind(1)
    taps = gaussian(softness), gaussian(chroma_blur), box(window), gaussian(radius)
    shares = [per_picture(values, finish) for values in (share, edge, mix, amount)]
    soft, blurred, flat, unsharp, share, edge, mix, amount = move_together([*taps, *shares], pictures.device)

    pictures = smooth(pictures, soft)
    red, green, blue = pictures[:, 0::3], pictures[:, 1::3], pictures[:, 2::3]

    luma = (0.299 * red).add_(green, alpha=0.587).add_(blue, alpha=0.114)
    chroma = torch.cat([red - luma, blue - luma], dim=1)
    chroma.add_(smooth(chroma, blurred).sub_(chroma).mul_(mix))  # a lerp's bits depend on what else is in the batch
    luma = _reduce_noise(luma, flat, share, edge)
    luma.add_((luma - smooth(luma, unsharp)).mul_(amount))

    torch.add(chroma[:, :2], luma, out=red)
    torch.add(chroma[:, 2:], luma, out=blue)
    torch.sub(luma, chroma[:, :2], alpha=0.299 / 0.587, out=green).sub_(chroma[:, 2:], alpha=0.114 / 0.587)
    return pictures.clamp_(0.0, 1.0)


def _reduce_noise(luma: Tensor, window: Tensor, share: Tensor, edge: Tensor) -> Tensor:
    """Pass noisy and clean luma ``(B, 2, H, W)`` through the module's guided filter."""
    noise = fastest("mean_square", luma, otherwise=lambda: _mean_square(luma))[:, None, None, None]
    mean = smooth(torch.cat([luma, luma[:, :1].square()], dim=1), window)
    variance = (mean[:, 2:] - mean[:, :1].square()).clamp_min(1e-9)

    weights = (1.0 - edge * noise / variance).clamp_min(0.0)
    smoothed = smooth(torch.cat([weights, (1.0 - weights) * mean[:, :2]], dim=1), window)
    mean_weights, flat = smoothed[:, :1], smoothed[:, 1:]
    return luma + share * (flat - (1.0 - mean_weights) * luma)


def _mean_square(luma: Tensor) -> Tensor:
    """The mean squared difference ``(B,)`` of noisy and clean luma ``(B, 2, H, W)``, picture by picture."""
    return torch.stack([(noisy - clean).square().mean() for noisy, clean in luma])


def gaussian_blur(image: Tensor, deviation: Tensor) -> Tensor:
    """Blur ``(B, N, H, W)`` with Gaussians of deviations ``(B,)`` in pixels; the edge is repeated outwards."""
    return smooth(image, gaussian(deviation.cpu()))


def gaussian(deviation: Tensor) -> Tensor:
    """The taps ``(B, K)`` of Gaussians of deviations ``(B,)`` in pixels, for :func:`smooth`."""
    reach = _REACH * deviation[:, None].double()
    distance = torch.arange(math.ceil(float(reach.max())) + 1)
    taps = torch.exp(-0.5 * (distance * _REACH / reach.clamp_min(0.1)).square())
    return _normalise(torch.where(distance < reach.ceil() + 1, taps, 0.0))


def box(reach: Tensor) -> Tensor:
    """The taps ``(B, K)`` of means in squares of sides ``2 reach + 1``, ``(B,)``, whose border counts in part."""
    distance = torch.arange(math.ceil(float(reach.max())) + 1)
    return _normalise((reach[:, None].double() + 1.0 - distance).clamp(0.0, 1.0))


def _normalise(taps: Tensor) -> Tensor:
    """Divide float64 taps by their sum; rounded to float32, they do not depend on how many pictures there are."""
    return (taps / (2.0 * taps.sum(1, keepdim=True) - taps[:, :1])).float()


def smooth(image: Tensor, taps: Tensor) -> Tensor:
    """Filter ``(B, N, H, W)`` along both axes with taps ``(B, K)``, the middle one first, which are on both sides."""
    return fastest("smooth", image, taps, otherwise=lambda: _convolve(image, taps))


def _convolve(image: Tensor, taps: Tensor) -> Tensor:
    batch, count, height, width = image.shape
    reach = taps.shape[1] - 1
    (taps,) = move_together([taps], image.device)
    kernel = torch.cat([taps[:, 1:].flip(1), taps], dim=1).to(image).repeat_interleave(count, 0)[:, None, None]

    planes = F.pad(image.reshape(1, -1, height, width), (reach,) * 4, mode="replicate")
    for weights in (kernel, kernel.mT):
        planes = F.conv2d(planes, weights, groups=batch * count)
    return planes.view_as(image)
