"""DnCNN, a chain of convolutions that predicts the noise (Zhang et al., TIP 2017)."""

from __future__ import annotations

from typing import Unpack

from torch import Tensor, nn

from denoisers.layers import conv, require_bounded, require_width
from denoisers.network import DENOISERS, Denoiser, Shared


@DENOISERS.register("DnCNN")
class DnCNN(Denoiser):
    """A chain of 3 x 3 convolutions that predicts the noise (Zhang et al., "Beyond a Gaussian Denoiser", TIP 2017).

    A convolution and a ReLU come first, then ``depth - 2`` times a convolution, batch normalisation and a ReLU, then a
    last convolution. The only padding is the convolutions' zeros. The paper's network is blind: ``variance_map=False``.

    Args:
        width: features.
        depth: convolutions, 2 to 1000; 17 in the paper for one noise level, 20 for a range of them.
        batch_norm: as published. Denoise in eval mode: in train mode a picture's result depends on its batch.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> import torch
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> DnCNN(width=8, depth=5, variance_map=False)(noisy).shape
        torch.Size([1, 4, 20, 30])
    """

    def __init__(self, width: int = 64, depth: int = 17, batch_norm: bool = True, **shared: Unpack[Shared]) -> None:
        require_width(width)
        if depth < 2:
            raise ValueError(f"depth must be at least 2, got {depth}")
        require_bounded(depth=depth)
        super().__init__({"width": width, "depth": depth, "batch_norm": batch_norm}, **shared)

        last = conv(width, self.channels)
        self.layers = nn.Sequential(conv(self.inputs, width), nn.ReLU(inplace=True))
        for _ in range(depth - 2):
            self.layers.append(conv(width, width, bias=not batch_norm))
            if batch_norm:
                self.layers.append(nn.BatchNorm2d(width))
            self.layers.append(nn.ReLU(inplace=True))
        self.layers.append(last)

        self.initialise(self.seed, last)

    def residual(self, features: Tensor) -> Tensor:
        """Run the chain: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``, the negative of the noise."""
        return self.layers(features)
