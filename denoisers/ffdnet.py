"""FFDNet: white noise of a level that the network is told, at half the sides, for pictures of one or three channels.

``x - S(f([sigma, S^-1(x)]))`` with the pixel shuffle S, the deviation sigma of each channel as a plane, and twelve 3 x
3 convolutions f. Source: Zhang, Zuo and Zhang, "FFDNet: Toward a Fast and Flexible Solution for CNN-Based Image
Denoising", IEEE TIP 2018.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn import functional as F

from denoisers.network import Denoiser, conv, require_bounded, require_width
from rawaug.registry import DENOISERS


@DENOISERS.register("FFDNet")
class FFDNet(Denoiser):
    """FFDNet (Zhang et al., TIP 2018), of sRGB by default; its normalisations are folded into the convolutions.

    Args:
        width: features of each layer but the last.
        depth: convolutions, 3 to 1000; 12 is published for colour, 15 with a width of 64 for grey.
        channels, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(1, 3, 33, 50)
        >>> FFDNet(width=8, depth=3)(noisy, torch.full_like(noisy, (15 / 255) ** 2)).shape
        torch.Size([1, 3, 33, 50])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 8, "depth": 3}

    def __init__(self, width: int = 96, depth: int = 12, channels: int = 3, seed: int = 0) -> None:
        require_width(width)
        require_bounded(seed, depth=depth)
        if depth < 3:
            raise ValueError(f"depth must be at least 3, got {depth}")
        super().__init__(channels, True, True, 2, {"width": width, "depth": depth})
        self.config = {"width": width, "depth": depth, "channels": channels}
        sizes = [5 * channels, *[width] * (depth - 1), 4 * channels]
        for k in range(depth):
            self.add_module(f"conv{k:02d}", conv(sizes[k], sizes[k + 1]))
        self.depth = depth
        self.initialise(seed, self.get_submodule(f"conv{depth - 1:02d}"), gain=2.0**0.5)  # type: ignore[arg-type]

    def residual(self, features: Tensor) -> Tensor:
        picture, deviation = features.split(self.channels, dim=1)
        x = torch.cat([F.avg_pool2d(deviation, 2), F.pixel_unshuffle(picture, 2)], dim=1)
        for k in range(self.depth):
            x = self.get_submodule(f"conv{k:02d}")(x)
            x = x.relu_() if k + 1 < self.depth else x
        return -F.pixel_shuffle(x, 2)
