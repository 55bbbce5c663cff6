r"""FFDNet, a chain of convolutions at half the sides that takes the level of the noise (Zhang et al., TIP 2018).

Noise of developed pictures is alike in neighbours, and a network for white noise takes it for texture. Every second
pixel of a row and a column apart, it is nearly white. With S the pixel shuffle by 2, f the network, and :math:`m_k`
1 at the k-th of the four places of each 2 x 2 square and 0 elsewhere,

.. math:: u = S f(S^{-1} x), \qquad d = \frac14 \sum_{k=1}^{4} f(m_k x + (1 - m_k) u)

Each of the four pictures is filled again with a quarter of the noisy pixels, which bring back the detail that the
shuffled ones have lost (Zhou et al., "When AWGN-based Denoiser Meets Real Noises", AAAI 2020).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import conv, pad_to_multiple, require_bounded, require_width
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


class Refilled(nn.Module):
    """A network for white noise that denoises four quarters of the pixels apart and then refills them, see the module.

    It takes five times as long as the network itself.

    Args:
        network: takes a picture and its variance, ``(B, C, H, W)`` both.

    Example:
        >>> noisy = torch.rand(1, 3, 33, 50)
        >>> Refilled(FFDNet(width=8, depth=3))(noisy, torch.full_like(noisy, (50 / 255) ** 2)).shape
        torch.Size([1, 3, 33, 50])
    """

    reads_variance = True

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        """Denoise ``(B, C, H, W)`` of at least 2 x 2."""
        padded, padded_variance = pad_to_multiple(noisy, 2), pad_to_multiple(variance, 2)
        quarters, quarter_variance = _split(padded), _split(padded_variance)
        apart = _join(self.network(quarters, quarter_variance))

        total = torch.zeros_like(padded)
        for row in range(2):
            for column in range(2):
                refilled = apart.clone()
                refilled[..., row::2, column::2] = padded[..., row::2, column::2]
                total += self.network(refilled, padded_variance)
        return total[..., : noisy.shape[-2], : noisy.shape[-1]] / 4


def _split(picture: Tensor) -> Tensor:
    """Split ``(B, C, H, W)`` into the four pictures ``(4 B, C, H / 2, W / 2)`` of every second pixel."""
    batch, channels, height, width = picture.shape
    quarters = F.pixel_unshuffle(picture, 2).reshape(batch, channels, 4, height // 2, width // 2)
    return quarters.transpose(1, 2).flatten(0, 1)


def _join(quarters: Tensor) -> Tensor:
    """Put ``(4 B, C, h, w)`` together again."""
    _, channels, height, width = quarters.shape
    planes = quarters.reshape(-1, 4, channels, height, width).transpose(1, 2)
    return F.pixel_shuffle(planes.flatten(1, 2), 2)
