"""NAFNet, a U-Net without activation functions (Chen et al., ECCV 2022)."""

from __future__ import annotations

from typing import Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import MOST_SCALES, RESIDUAL_GAIN, conv, require_bounded, require_width
from denoisers.network import DENOISERS, Denoiser, Shared
from rawaug.registry import require_between


class ChannelNorm(nn.Module):
    """Layer norm over the channels of every pixel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``(B, C, h, w)``, each pixel over its C channels."""
        channels_last = x.permute(0, 2, 3, 1)
        norm = F.layer_norm(channels_last, self.weight.shape, self.weight, self.bias, 1e-6)
        return norm.permute(0, 3, 1, 2)


class NAFBlock(nn.Module):
    """A block of :class:`NAFNet`: two residuals whose features gate each other."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1 = ChannelNorm(width)
        self.norm2 = ChannelNorm(width)
        self.conv1 = conv(width, 2 * width, 1)
        self.conv2 = conv(2 * width, 2 * width, 3, groups=2 * width)
        self.attention = conv(width, width, 1)
        self.conv3 = conv(width, width, 1)
        self.conv4 = conv(width, 2 * width, 1)
        self.conv5 = conv(width, width, 1)
        self.beta = nn.Parameter(torch.zeros(1, width, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, width, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        y = self.conv2(self.conv1(self.norm1(x)))
        y = _gate(y)
        attention = self.attention(y.mean((2, 3), keepdim=True))
        x = x + self.beta * self.conv3(y * attention)

        y = _gate(self.conv4(self.norm2(x)))
        return x + self.gamma * self.conv5(y)


@DENOISERS.register("NAFNet")
class NAFNet(Denoiser):
    r"""A U-Net without activation functions (Chen et al., "Simple Baselines for Image Restoration", ECCV 2022).

    A block has two residuals. The first is layer norm, pointwise c to 2c, depthwise 3 x 3, simple gate :math:`a \odot
    b`, simplified channel attention, pointwise; the second is layer norm, pointwise c to 2c, simple gate, pointwise.
    Each enters with a learned factor that starts at 0. Convolutions 2 x 2 of stride 2 lead down, pixel shuffles lead
    up, and skips are added. The channel attention averages over the whole input, so a tile and the whole picture differ
    a little.

    Args:
        width: features of the first scale, doubled at each further one; 32 and 64 are published.
        encoder: blocks of each scale going down, 1 to 12 scales of up to 1000 blocks.
        middle: blocks of the middle.
        decoder: blocks of each scale going up, as many as ``encoder``.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> NAFNet(width=4, encoder=(1, 1), middle=1, decoder=(1, 1))(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    def __init__(
        self,
        width: int = 32,
        encoder: tuple[int, ...] = (2, 2, 4, 8),
        middle: int = 12,
        decoder: tuple[int, ...] = (2, 2, 2, 2),
        **shared: Unpack[Shared],
    ) -> None:
        require_width(width)
        if len(encoder) != len(decoder) or min((*encoder, *decoder, middle), default=0) < 0 or not encoder:
            raise ValueError(f"encoder and decoder must have the same number of scales, got {encoder} and {decoder}")
        require_between("scales", len(encoder), 1, MOST_SCALES)
        require_bounded(middle=middle, encoder=max(encoder), decoder=max(decoder))

        config = {"width": width, "encoder": list(encoder), "middle": middle, "decoder": list(decoder)}
        super().__init__(config, 2 ** len(encoder), **shared)

        sizes = [width * 2**k for k in range(len(encoder))]
        self.intro = conv(self.inputs, width)
        self.encoder = nn.ModuleList()
        self.downs = nn.ModuleList()
        for size, blocks in zip(sizes, encoder, strict=True):
            self.encoder.append(_blocks(size, blocks))
            self.downs.append(conv(size, 2 * size, 2, stride=2, padding=0))

        self.middle = _blocks(2 * sizes[-1], middle)

        self.ups = nn.ModuleList()
        self.decoder = nn.ModuleList()
        for size, blocks in zip(reversed(sizes), decoder, strict=True):
            self.ups.append(conv(2 * size, 4 * size, 1, bias=False))
            self.decoder.append(_blocks(size, blocks))
        self.ending = conv(width, self.channels)

        self.initialise(self.seed, self.ending, gain=RESIDUAL_GAIN)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the scales and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        x = self.intro(features)
        skips = []
        for blocks, down in zip(self.encoder, self.downs, strict=True):
            x = blocks(x)
            skips.append(x)
            x = down(x)

        x = self.middle(x)
        for up, blocks in zip(self.ups, self.decoder, strict=True):
            finer = F.pixel_shuffle(up(x), 2)
            x = blocks(finer + skips.pop())

        correction: Tensor = self.ending(x)
        return correction


def _gate(x: Tensor) -> Tensor:
    """Multiply the first half of the channels by the second."""
    first, second = x.chunk(2, dim=1)
    return first * second


def _blocks(width: int, number: int) -> nn.Sequential:
    return nn.Sequential(*[NAFBlock(width) for _ in range(number)])
