"""The densely connected hierarchical network, DHDN (Park, Yu and Jeong, CVPR Workshops 2019)."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import conv, require_width
from denoisers.network import DENOISERS, Denoiser, Shared

LEVELS = 4
"""DHDN's pyramid has this many levels."""


class DCRBlock(nn.Module):
    """Three densely connected convolutions, C to C/2, 3C/2 to C/2 and 2C to C, each with its PReLU, and a residual."""

    def __init__(self, features: int) -> None:
        super().__init__()
        half = features // 2
        self.first = nn.Sequential(conv(features, half), nn.PReLU())
        self.second = nn.Sequential(conv(features + half, half), nn.PReLU())
        self.third = conv(2 * features, features)
        self.activation = nn.PReLU()

    def forward(self, features: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        dense = torch.cat([features, self.first(features)], dim=1)
        dense = torch.cat([dense, self.second(dense)], dim=1)
        return features + self.activation(self.third(dense))


@DENOISERS.register("DHDN")
class DHDN(Denoiser):
    """The densely connected hierarchical network (Park, Yu and Jeong, CVPR Workshops 2019).

    It is a U-Net of four levels with C, 2C, 4C and 8C features. Each level has two densely connected residual blocks on
    the way down and two on the way up. Max-pooling and a 1 x 1 convolution lead down; a 1 x 1 convolution and a pixel
    shuffle lead up. Skips are concatenated at every level, the lowest included. With C = 128 and three channels the
    network has 168.2 M parameters and takes 1,020 GMAC for 256 x 256 pixels; it is blind (``variance_map=False``).

    Args:
        width: features of the first level, even. 16 (2.6 M parameters) suits a CPU; 128 is the published width.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> DHDN(width=4, variance_map=False)(noisy).shape
        torch.Size([1, 4, 20, 30])
    """

    def __init__(self, width: int = 16, **shared: Unpack[Shared]) -> None:
        require_width(width, multiple=2)
        super().__init__({"width": width}, 2 ** (LEVELS - 1), **shared)

        sizes = [width * 2**k for k in range(LEVELS)]
        self.first = _pointwise(self.inputs, width)
        self.encoder = nn.ModuleList()
        self.down = nn.ModuleList()
        self.up = nn.ModuleList()
        self.decoder = nn.ModuleList()
        for size in sizes:
            self.encoder.append(_level(size))
        for size in sizes[:-1]:
            self.down.append(_pointwise(size, 2 * size))
        # What comes up and the skip each have a level's features, so the level's decoder works on twice as many.
        for size in reversed(sizes[:-1]):
            self.up.append(_pointwise(4 * size, 4 * size))
            self.decoder.append(_level(2 * size))
        self.last = conv(2 * width, self.channels, size=1)

        # A chain of fourteen residual blocks stays stable if each starts as the identity (Goyal et al. 2017).
        ends = [module.third for module in self.modules() if isinstance(module, DCRBlock)]
        self.initialise(self.seed, self.last, *ends)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the levels and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        features = self.first(features)
        skips = []
        for level, down in zip(self.encoder, self.down, strict=False):
            features = level(features)
            skips.append(features)
            features = down(F.max_pool2d(features, 2))

        lowest = self.encoder[-1](features)
        features = torch.cat([lowest, features], dim=1)
        for up, level in zip(self.up, self.decoder, strict=True):
            finer = F.pixel_shuffle(up(features), 2)
            features = level(torch.cat([finer, skips.pop()], dim=1))
        return self.last(features)


def _level(features: int) -> nn.Sequential:
    return nn.Sequential(DCRBlock(features), DCRBlock(features))


def _pointwise(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(conv(inputs, outputs, size=1), nn.PReLU())
