r"""DHDN, the densely connected hierarchical network: ``denoised = noisy + D([noisy, variance])``.

Domain: packed RAW (the published network: sRGB, three channels). A U-Net of four levels, features C, 2C, 4C, 8C, with
two densely connected residual (DCR) blocks a level on the way down and on the way up. Down: max-pooling and a 1 x 1
convolution; up: a 1 x 1 convolution and pixel shuffle; skips by concatenation at every level, the lowest included.
With C = 128 and three channels it has 168.2 M parameters and takes 1,020 GMAC for 256 x 256 pixels.
Source: Park, Yu and Jeong, "Densely Connected Hierarchical Network for Image Denoising", CVPR Workshops 2019.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.network import PACKED, Denoiser, conv, require_bounded, require_width
from rawaug.registry import DENOISERS

LEVELS = 4


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
        """``(B, C, h, w)`` to the same shape."""
        dense = torch.cat([features, self.first(features)], dim=1)
        dense = torch.cat([dense, self.second(dense)], dim=1)
        return features + self.activation(self.third(dense))


def _level(features: int) -> nn.Sequential:
    return nn.Sequential(DCRBlock(features), DCRBlock(features))


def _pointwise(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(conv(inputs, outputs, size=1), nn.PReLU())


@DENOISERS.register("DHDN")
class DHDN(Denoiser):
    """Park's DHDN; see the module's head. Any h, w >= 2: padded by reflection to multiples of 8 inside.

    Args:
        width: features of the first level, even. 16 (2.6 M parameters) suits a CPU; 128 is the published width.
        channels: 4 for packed RAW, 3 in the paper.
        variance_map: take the noise map as ``channels`` more inputs (the paper's network is blind: False).
        deviation: the map is sqrt(variance); False: the variance.
        domain: linear (as published), ksigma or anscombe; see :mod:`denoisers.domains`.
        seed: of the initial weights.

    Example:
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> DHDN(width=4, variance_map=False)(noisy).shape
        torch.Size([1, 4, 20, 30])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 4}

    def __init__(
        self,
        width: int = 16,
        channels: int = PACKED,
        variance_map: bool = True,
        deviation: bool = True,
        domain: str = "linear",
        seed: int = 0,
    ) -> None:
        require_width(width, multiple=2)
        require_bounded(seed)
        super().__init__(channels, variance_map, deviation, 2 ** (LEVELS - 1), {"width": width}, domain)
        sizes = [width * 2**k for k in range(LEVELS)]
        self.first = _pointwise(self.inputs, width)
        self.encoder = nn.ModuleList(_level(size) for size in sizes)
        self.down = nn.ModuleList(_pointwise(size, 2 * size) for size in sizes[:-1])
        # What comes up and what was kept have a level's features each, so its decoder works on twice as many.
        self.up = nn.ModuleList(_pointwise(2 * size, 2 * size) for size in reversed(sizes[1:]))
        self.decoder = nn.ModuleList(_level(2 * size) for size in reversed(sizes[:-1]))
        self.last = conv(2 * width, channels, size=1)
        # Fourteen residual blocks one after another stay tame when each starts as the identity (Goyal et al. 2017).
        ends = [module.third for module in self.modules() if isinstance(module, DCRBlock)]
        self.initialise(seed, self.last, *ends)

    def residual(self, features: Tensor) -> Tensor:
        """``(B, inputs, h, w)``, sides multiples of ``stride``, to the correction ``(B, channels, h, w)``."""
        features = self.first(features)
        skips = []
        for level, down in zip(self.encoder, self.down, strict=False):
            features = level(features)
            skips.append(features)
            features = down(F.max_pool2d(features, 2))
        features = torch.cat([self.encoder[-1](features), features], dim=1)
        for up, level, skip in zip(self.up, self.decoder, reversed(skips), strict=True):
            features = level(torch.cat([F.pixel_shuffle(up(features), 2), skip], dim=1))
        return self.last(features)
