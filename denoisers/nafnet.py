r"""NAFNet: a U-Net without activation functions; ``denoised = noisy + N(features)``.

Domain: packed RAW. A block is two residuals: layer norm, pointwise c to 2c, depthwise 3 x 3, simple gate
:math:`a \odot b`, simplified channel attention, pointwise; and layer norm, pointwise c to 2c, simple gate, pointwise;
each enters with a learned factor that starts at 0. Convolutions 2 x 2 of stride 2 go down, pixel shuffles go up, skips
are added. Source: Chen et al., "Simple Baselines for Image Restoration", ECCV 2022.

The channel attention averages over the whole input: a tile and the whole picture differ a little.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.network import MOST_SCALES, PACKED, RESIDUAL_GAIN, Denoiser, conv, require_bounded, require_width
from rawaug.registry import DENOISERS, require_between


class ChannelNorm(nn.Module):
    """Layer norm over the channels of every pixel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Of any shape ``(B, width, h, w)``."""
        normed = F.layer_norm(x.permute(0, 2, 3, 1), self.weight.shape, self.weight, self.bias, 1e-6)
        return normed.permute(0, 3, 1, 2)


def gate(x: Tensor) -> Tensor:
    """The first half of the channels times the second."""
    first, second = x.chunk(2, dim=1)
    return first * second


class Block(nn.Module):
    """NAFNet's block; see the module's head."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = ChannelNorm(width), ChannelNorm(width)
        self.conv1, self.conv2 = conv(width, 2 * width, 1), conv(2 * width, 2 * width, 3, groups=2 * width)
        self.attention, self.conv3 = conv(width, width, 1), conv(width, width, 1)
        self.conv4, self.conv5 = conv(width, 2 * width, 1), conv(width, width, 1)
        self.beta = nn.Parameter(torch.zeros(1, width, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, width, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Of any shape ``(B, width, h, w)``."""
        y = gate(self.conv2(self.conv1(self.norm1(x))))
        x = x + self.beta * self.conv3(y * self.attention(y.mean((2, 3), keepdim=True)))
        return x + self.gamma * self.conv5(gate(self.conv4(self.norm2(x))))


@DENOISERS.register("NAFNet")
class NAFNet(Denoiser):
    """See the module's head. Any h, w >= 2: padded by reflection inside.

    Args:
        width: features of the first scale, doubled at each further one; 32 and 64 are published.
        encoder: blocks of each scale going down; their number is that of the scales above the middle.
        middle: blocks of the middle.
        decoder: blocks of each scale going up, as many as ``encoder``.
        channels: 4 for packed RAW.
        variance_map: take the noise map as ``channels`` more inputs.
        deviation: the map is sqrt(variance).
        domain: linear, ksigma or anscombe.
        seed: of the initial weights.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> NAFNet(width=4, encoder=(1, 1), middle=1, decoder=(1, 1))(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    tiny: ClassVar[dict[str, Any]] = {"width": 4, "encoder": (1, 1), "middle": 1, "decoder": (1, 1)}

    def __init__(
        self,
        width: int = 32,
        encoder: tuple[int, ...] = (2, 2, 4, 8),
        middle: int = 12,
        decoder: tuple[int, ...] = (2, 2, 2, 2),
        channels: int = PACKED,
        variance_map: bool = True,
        deviation: bool = True,
        domain: str = "linear",
        seed: int = 0,
    ) -> None:
        require_width(width)
        if len(encoder) != len(decoder) or min((*encoder, *decoder, middle), default=0) < 0 or not encoder:
            raise ValueError(f"encoder and decoder must have the same number of scales, got {encoder} and {decoder}")
        require_between("scales", len(encoder), 1, MOST_SCALES)
        require_bounded(seed, middle=middle, encoder=max(encoder), decoder=max(decoder))
        config = {"width": width, "encoder": list(encoder), "middle": middle, "decoder": list(decoder)}
        super().__init__(channels, variance_map, deviation, 2 ** len(encoder), config, domain)
        sizes = [width * 2**k for k in range(len(encoder) + 1)]
        self.intro = conv(self.inputs, width)
        self.encoder = nn.ModuleList(_blocks(c, n) for c, n in zip(sizes, encoder, strict=False))
        self.downs = nn.ModuleList(conv(c, 2 * c, 2, stride=2, padding=0) for c in sizes[:-1])
        self.middle = _blocks(sizes[-1], middle)
        self.ups = nn.ModuleList(conv(2 * c, 4 * c, 1, bias=False) for c in reversed(sizes[:-1]))
        self.decoder = nn.ModuleList(_blocks(c, n) for c, n in zip(reversed(sizes[:-1]), decoder, strict=True))
        self.ending = conv(width, channels)
        self.initialise(seed, self.ending, gain=RESIDUAL_GAIN)

    def residual(self, features: Tensor) -> Tensor:
        """``(B, inputs, h, w)``, sides multiples of ``stride``, to the correction ``(B, channels, h, w)``."""
        x, skips = self.intro(features), []
        for blocks, down in zip(self.encoder, self.downs, strict=True):
            x = blocks(x)
            skips.append(x)
            x = down(x)
        x = self.middle(x)
        for up, blocks, skip in zip(self.ups, self.decoder, reversed(skips), strict=True):
            x = blocks(F.pixel_shuffle(up(x), 2) + skip)
        correction: Tensor = self.ending(x)
        return correction


def _blocks(width: int, number: int) -> nn.Sequential:
    return nn.Sequential(*(Block(width) for _ in range(number)))
