r"""The U-Net of UPI: ``denoised = noisy + U([noisy, variance])``.

Domain: packed RAW (R, Gr, Gb, B) and its noise variance map. Five scales of three 3 x 3 convolutions with leaky ReLU
0.2; features double at each scale, 32 to 512; max-pooling down, bilinear interpolation up, skips by concatenation, a
last convolution to four channels. Source: Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.network import LEAK, MOST_SCALES, PACKED, Denoiser, conv, require_bounded, require_width
from rawaug.registry import DENOISERS, require_between

PUBLISHED_WIDTH = 32
"""Features of the first scale in the paper."""


def _block(inputs: int, features: int) -> nn.Sequential:
    """Three convolutions, each with its leaky ReLU."""
    layers: list[nn.Module] = []
    for size in (inputs, features, features):
        layers += [conv(size, features), nn.LeakyReLU(LEAK, inplace=True)]
    return nn.Sequential(*layers)


@DENOISERS.register("UNet")
class UNet(Denoiser):
    """UPI's U-Net; see the module's head. Any h, w >= 2: padded by reflection to multiples of 16 inside.

    Args:
        width: features of the first scale; the last has ``width * 2**(scales - 1)``.
        scales: of the pyramid; sides are padded to multiples of ``2**(scales - 1)``.
        channels: 4 for packed RAW.
        variance_map: take the noise map as ``channels`` more inputs.
        deviation: the map is sqrt(variance), of the size of the errors to remove; False: the variance, as published.
        domain: linear (as published), ksigma or anscombe; see :mod:`denoisers.domains`.
        seed: of the initial weights.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> UNet(width=8)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 4, "scales": 2}

    def __init__(
        self,
        width: int = PUBLISHED_WIDTH,
        scales: int = 5,
        channels: int = PACKED,
        variance_map: bool = True,
        deviation: bool = True,
        domain: str = "linear",
        seed: int = 0,
    ) -> None:
        require_width(width)
        require_between("scales", scales, 1, MOST_SCALES)
        require_bounded(seed)
        config = {"width": width, "scales": scales}
        super().__init__(channels, variance_map, deviation, 2 ** (scales - 1), config, domain)
        sizes = [width * 2**k for k in range(scales)]
        self.encoder = nn.ModuleList(_block(a, b) for a, b in zip([self.inputs, *sizes], sizes, strict=False))
        self.decoder = nn.ModuleList(_block(3 * size, size) for size in reversed(sizes[:-1]))
        self.last = conv(width, channels)
        self.initialise(seed, self.last)

    def residual(self, features: Tensor) -> Tensor:
        """``(B, inputs, h, w)``, sides multiples of ``stride``, to the correction ``(B, channels, h, w)``."""
        skips = []
        for k, block in enumerate(self.encoder):
            features = block(F.max_pool2d(features, 2) if k else features)
            skips.append(features)
        for block, skip in zip(self.decoder, reversed(skips[:-1]), strict=True):
            finer = F.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = block(torch.cat([finer, skip], dim=1))
        return self.last(features)
