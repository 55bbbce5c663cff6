r"""What a camera does to a picture between demosaicing and the file: noise reduction, sharpening, JPEG.

With luma Y and chroma C (Cb and Cr of BT.601) of the developed picture, a Gaussian blur :math:`G_s` of deviation s
pixels, and weights a from 0 in flat areas to 1 at edges,

.. math:: C' = C + m (G_c C - C), \qquad Y' = G_l Y + a (Y - G_l Y), \qquad Y'' = Y' + u (Y' - G_r Y')

where :math:`a = \max(0, 1 - k \sigma^2 / v)`: v is the variance of noisy luma within 5 x 5 pixels, and
:math:`\sigma^2` that of its noise. Noise reduction of this kind (Lee, PAMI 1980) leaves the noise at edges, as cameras
do. The clean picture is finished with the weights that the noisy one chose, so that it is what the mean of many such
shots would be; JPEG acts on the noisy picture alone.

The ranges are fitted to the noise of developed pictures (``python -m benchmarks.picture_noise``): its autocorrelation
by channel, the correlation between channels, its power by band, and its variance at edges over that in flat areas.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.kernels.runtime import one_thread

_TO_YCC = torch.tensor([[0.299, 0.587, 0.114], [-0.168736, -0.331264, 0.5], [0.5, -0.418688, -0.081312]])
_TO_RGB = torch.linalg.inv(_TO_YCC)
_REACH = 2
"""Half the side of the window in which edges are looked for."""


@dataclass(frozen=True)
class Finish:
    """How cameras finish pictures: ranges that are drawn from for each picture, and shares of pictures.

    Args:
        luma_blur: lowest and highest deviation of the luma blur, in pixels.
        edges: share of pictures in which the luma blur spares edges.
        edge_threshold: lowest and highest k, by which local variance must exceed that of the noise to be an edge.
        chroma_blur: lowest and highest deviation of the chroma blur, in pixels, drawn by its logarithm.
        chroma_mix: lowest and highest share m of the blurred chroma.
        sharpening: lowest and highest amount u, of a mask of deviation ``sharpening_radius``.
        sharpened: share of pictures that are sharpened.
        sharpening_radius: lowest and highest deviation of that mask, in pixels.
        quality: lowest and highest quality of the JPEG; None leaves out JPEG.
        unfinished: share of pictures that are only compressed.

    Raises:
        ValueError: if a range is out of order, or a share leaves [0, 1].
    """

    luma_blur: tuple[float, float] = (0.6, 0.95)
    edges: float = 0.8
    edge_threshold: tuple[float, float] = (1.5, 4.0)
    chroma_blur: tuple[float, float] = (1.0, 4.0)
    chroma_mix: tuple[float, float] = (0.6, 1.0)
    sharpening: tuple[float, float] = (0.0, 0.6)
    sharpened: float = 0.5
    sharpening_radius: tuple[float, float] = (0.7, 1.6)
    quality: tuple[int, int] | None = (80, 99)
    unfinished: float = 0.1

    def __post_init__(self) -> None:
        for key in ("luma_blur", "edge_threshold", "chroma_blur", "chroma_mix", "sharpening", "sharpening_radius"):
            low, high = getattr(self, key)
            if not 0.0 <= low <= high <= 100.0:
                raise ValueError(f"finish: {key} must be (lowest, highest) within 0 to 100, got ({low}, {high})")
        for key in ("edges", "sharpened", "unfinished"):
            if not 0.0 <= getattr(self, key) <= 1.0:
                raise ValueError(f"finish: {key} must be a share in [0, 1], got {getattr(self, key)}")

    def sample(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """``finish`` ``(batch, 6)``: luma blur, k, chroma blur, its share, amount and deviation of sharpening.

        k is infinite where edges are not spared. ``chroma_420`` ``(batch,)`` says where JPEG halves the chroma.
        """
        drawn = torch.rand(batch, 10, generator=generator).unbind(1)
        spares, sharpens, plain = drawn[6] < self.edges, drawn[7] < self.sharpened, drawn[8] < self.unfinished
        rows = [
            _between(self.luma_blur, drawn[0]),
            torch.where(spares, _between(self.edge_threshold, drawn[1], by_logarithm=True), math.inf),
            _between(self.chroma_blur, drawn[2], by_logarithm=True),
            _between(self.chroma_mix, drawn[3]),
            torch.where(sharpens, _between(self.sharpening, drawn[4]), 0.0),
            _between(self.sharpening_radius, drawn[5]),
        ]
        rows = [torch.where(plain, 0.0, row) for row in rows]
        return {"finish": torch.stack(rows, dim=1), "chroma_420": drawn[9] < 0.5}

    @one_thread()  # the same bits everywhere
    def apply(self, noisy: Tensor, clean: Tensor, finish: Tensor) -> tuple[Tensor, Tensor]:
        """Noisy and clean sRGB ``(B, 3, H, W)`` in [0, 1], finished alike; ``finish`` is as :meth:`sample` gives it."""
        found = [_finish(*one) for one in zip(noisy, clean, finish.tolist(), strict=True)]
        first, second = (torch.stack(pictures) for pictures in zip(*found, strict=True))
        return first, second


def _between(limits: tuple[float, float], drawn: Tensor, by_logarithm: bool = False) -> Tensor:
    low, high = limits
    return low * (high / low) ** drawn if by_logarithm and low > 0.0 else low + (high - low) * drawn


def _finish(noisy: Tensor, clean: Tensor, setting: list[float]) -> tuple[Tensor, Tensor]:
    blur, threshold, chroma_blur, mix, amount, radius = setting
    if not any(setting):
        return noisy, clean
    pictures = torch.einsum("ij,njhw->nihw", _TO_YCC.to(noisy), torch.stack([noisy, clean]))
    luma, chroma = pictures[:, :1], pictures[:, 1:]
    chroma = chroma + mix * (blurred(chroma, chroma_blur) - chroma)
    smooth = blurred(luma, blur)
    if math.isfinite(threshold):
        smooth = smooth + _edges(luma[:1], (luma[0] - luma[1]).square().mean() * threshold) * (luma - smooth)
    if amount:
        smooth = smooth + amount * (smooth - blurred(smooth, radius))
    rgb = torch.einsum("ij,njhw->nihw", _TO_RGB.to(noisy), torch.cat([smooth, chroma], dim=1)).clamp_(0.0, 1.0)
    return rgb[0], rgb[1]


def _edges(luma: Tensor, variance: Tensor) -> Tensor:
    """Weights from 0 where ``(1, 1, H, W)`` has no more than this variance nearby to 1 where it has far more."""
    mean, square = (_box(x, _REACH) for x in (luma, luma.square()))
    weights = 1.0 - variance / (square - mean.square()).clamp_min(1e-9)
    return _box(weights.clamp_min(0.0), 1)


def _box(image: Tensor, reach: int) -> Tensor:
    return F.avg_pool2d(F.pad(image, (reach,) * 4, mode="replicate"), 2 * reach + 1, 1)


def blurred(image: Tensor, deviation: float) -> Tensor:
    """``(N, C, H, W)`` through a Gaussian of this deviation in pixels; the edge is repeated beyond the edge."""
    if deviation < 0.05:
        return image
    reach = math.ceil(3.0 * deviation)
    taps = torch.exp(-0.5 * (torch.arange(-reach, reach + 1, device=image.device) / deviation).square()).to(image)
    taps = taps / taps.sum()
    planes = F.pad(image.flatten(0, 1)[:, None], (reach,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(planes, taps.view(1, 1, -1, 1)), taps.view(1, 1, 1, -1))[:, 0].view_as(image)
