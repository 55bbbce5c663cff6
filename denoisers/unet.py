"""UPI's U-Net (Brooks et al., CVPR 2019): ``denoised = noisy + U([noisy, noise map])``."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import LEAK, MOST_SCALES, conv, require_width
from denoisers.network import DENOISERS, Denoiser, Shared
from rawaug.registry import require_between

PUBLISHED_WIDTH = 32
"""The U-Net's first scale has this many features in the paper."""


@DENOISERS.register("UNet")
class UNet(Denoiser):
    """UPI's U-Net (Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019).

    It has five scales of three 3 x 3 convolutions with leaky ReLU 0.2. Features double at each scale, from 32 to 512.
    Max-pooling leads down, bilinear interpolation leads up, and skips are concatenated. As published, it has
    ``deviation=False``.

    Args:
        width: features of the first scale, 32 as published; the last has ``width * 2**(scales - 1)``.
        scales: number of scales, 1 to 12; sides are padded to multiples of ``2**(scales - 1)``.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> UNet(width=8)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    def __init__(self, width: int = PUBLISHED_WIDTH, scales: int = 5, **shared: Unpack[Shared]) -> None:
        require_width(width)
        require_between("scales", scales, 1, MOST_SCALES)
        super().__init__({"width": width, "scales": scales}, 2 ** (scales - 1), **shared)

        sizes = [width * 2**k for k in range(scales)]
        self.encoder = nn.ModuleList()
        self.decoder = nn.ModuleList()
        inputs = self.inputs
        for size in sizes:
            self.encoder.append(_triple_conv(inputs, size))
            inputs = size
        for size in reversed(sizes[:-1]):
            self.decoder.append(_triple_conv(3 * size, size))
        self.last = conv(width, self.channels)

        self.initialise(self.seed, self.last)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the scales and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        skips: list[Tensor] = []
        for block in self.encoder:
            if skips:
                features = F.max_pool2d(features, 2)
            features = block(features)
            skips.append(features)

        skips.pop()  # the last scale's own features
        for block in self.decoder:
            finer = F.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = block(torch.cat([finer, skips.pop()], dim=1))
        return self.last(features)


def _triple_conv(inputs: int, features: int) -> nn.Sequential:
    """Chain three convolutions, each with its leaky ReLU."""
    return nn.Sequential(
        conv(inputs, features),
        nn.LeakyReLU(LEAK, inplace=True),
        conv(features, features),
        nn.LeakyReLU(LEAK, inplace=True),
        conv(features, features),
        nn.LeakyReLU(LEAK, inplace=True),
    )
