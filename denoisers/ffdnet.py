"""FFDNet, a chain of convolutions at half the sides that takes the level of the noise (Zhang et al., TIP 2018)."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from denoisers.layers import conv, require_bounded, require_width
from denoisers.network import DENOISERS, Denoiser


@DENOISERS.register("FFDNet")
class FFDNet(Denoiser):
    """FFDNet (Zhang, Zuo and Zhang, TIP 2018), of sRGB by default; its normalisations are folded into the convolutions.

    It computes ``x - S(f([sigma, S^-1(x)]))``. S is the pixel shuffle, sigma is the deviation of each channel as a
    plane, and f are 3 x 3 convolutions, all at half the sides. The noise is white and has the level that a call passes.

    Args:
        width: features of each layer but the last.
        depth: convolutions, 3 to 1000; 12 is published for colour, 15 with a width of 64 for grey.
        channels, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(1, 3, 33, 50)
        >>> FFDNet(width=8, depth=3)(noisy, torch.full_like(noisy, (15 / 255) ** 2)).shape
        torch.Size([1, 3, 33, 50])
    """

    def __init__(self, width: int = 96, depth: int = 12, channels: int = 3, seed: int = 0) -> None:
        require_width(width)
        require_bounded(depth=depth)
        if depth < 3:
            raise ValueError(f"depth must be at least 3, got {depth}")
        super().__init__({"width": width, "depth": depth}, 2, channels=channels, seed=seed)

        self.depth = depth
        inputs = 5 * channels
        for k in range(depth - 1):
            self.add_module(f"conv{k:02d}", conv(inputs, width))
            inputs = width
        last = conv(width, 4 * channels)
        self.add_module(f"conv{depth - 1:02d}", last)

        self.initialise(seed, last, gain=math.sqrt(2.0))

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from the picture and its deviations, ``(B, inputs, h, w)``."""
        picture, deviation = features.split(self.channels, dim=1)
        x = torch.cat([F.avg_pool2d(deviation, 2), F.pixel_unshuffle(picture, 2)], dim=1)

        for k in range(self.depth - 1):
            layer = self.get_submodule(f"conv{k:02d}")
            x = layer(x).relu_()
        last = self.get_submodule(f"conv{self.depth - 1:02d}")
        return -F.pixel_shuffle(last(x), 2)
