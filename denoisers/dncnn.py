r"""DnCNN: ``denoised = noisy + R([noisy, variance])``, a plain chain of 3 x 3 convolutions that predicts the noise.

Domain: packed RAW. First layer convolution + ReLU, then ``depth - 2`` times convolution + batch normalisation + ReLU,
then a convolution. Here the chain predicts what is to be added, the paper's noise with its sign turned.
Source: Zhang et al., "Beyond a Gaussian Denoiser: Residual Learning of Deep CNN for Image Denoising", TIP 2017.
"""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor, nn

from denoisers.network import PACKED, Denoiser, conv, require_bounded, require_width
from rawaug.registry import DENOISERS


def _layer(width: int, batch_norm: bool) -> list[nn.Module]:
    norm = [nn.BatchNorm2d(width)] if batch_norm else []
    return [conv(width, width, bias=not batch_norm), *norm, nn.ReLU(inplace=True)]


@DENOISERS.register("DnCNN")
class DnCNN(Denoiser):
    """Zhang's DnCNN; see the module's head. Any h, w >= 2; nothing is padded but the convolutions' zeros.

    Args:
        width: features.
        depth: convolutions; 17 in the paper for one noise level, 20 for a range of them.
        batch_norm: as published. Denoise in eval mode: in train mode a picture's result depends on its batch.
        channels: 4 for packed RAW.
        variance_map: take the noise map as ``channels`` more inputs (the paper's network is blind: False).
        deviation: the map is sqrt(variance); False: the variance.
        domain: linear (as published), ksigma or anscombe; see :mod:`denoisers.domains`.
        seed: of the initial weights.

    Example:
        >>> import torch
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> DnCNN(width=8, depth=5, variance_map=False)(noisy).shape
        torch.Size([1, 4, 20, 30])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 8, "depth": 3}

    def __init__(
        self,
        width: int = 64,
        depth: int = 17,
        batch_norm: bool = True,
        channels: int = PACKED,
        variance_map: bool = True,
        deviation: bool = True,
        domain: str = "linear",
        seed: int = 0,
    ) -> None:
        require_width(width)
        if depth < 2:
            raise ValueError(f"depth must be at least 2, got {depth}")
        require_bounded(seed, depth=depth)
        config = {"width": width, "depth": depth, "batch_norm": batch_norm}
        super().__init__(channels, variance_map, deviation, 1, config, domain)
        middle = [layer for _ in range(depth - 2) for layer in _layer(width, batch_norm)]
        last = conv(width, channels)
        self.layers = nn.Sequential(conv(self.inputs, width), nn.ReLU(inplace=True), *middle, last)
        self.initialise(seed, last)

    def residual(self, features: Tensor) -> Tensor:
        """``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        return self.layers(features)
