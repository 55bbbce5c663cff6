"""Convolutional networks from the literature, each ``denoised = noisy + residual([noisy, noise map])``.

The settings that they share are those of :class:`denoisers.Denoiser`. Any height and width from 2 on.
"""

from __future__ import annotations

from typing import ClassVar, Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.network import (
    DENOISERS,
    LEAK,
    MOST_SCALES,
    RESIDUAL_GAIN,
    Denoiser,
    Shared,
    conv,
    require_bounded,
    require_width,
)
from rawaug.registry import require_between

PUBLISHED_WIDTH = 32
"""Features of the U-Net's first scale in the paper."""


def _triple_conv(inputs: int, features: int) -> nn.Sequential:
    """Three convolutions, each with its leaky ReLU."""
    layers: list[nn.Module] = []
    for size in (inputs, features, features):
        layers += [conv(size, features), nn.LeakyReLU(LEAK, inplace=True)]
    return nn.Sequential(*layers)


@DENOISERS.register("UNet")
class UNet(Denoiser):
    """UPI's U-Net (Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019).

    Five scales of three 3 x 3 convolutions with leaky ReLU 0.2; features double at each scale, 32 to 512; max-pooling
    down, bilinear interpolation up, skips by concatenation. As published, ``deviation=False``.

    Args:
        width: features of the first scale, 32 as published; the last has ``width * 2**(scales - 1)``.
        scales: of the pyramid, 1 to 12; sides are padded to multiples of ``2**(scales - 1)``.
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
        self.encoder = nn.ModuleList(_triple_conv(a, b) for a, b in zip([self.inputs, *sizes], sizes, strict=False))
        self.decoder = nn.ModuleList(_triple_conv(3 * size, size) for size in reversed(sizes[:-1]))
        self.last = conv(width, self.channels)
        self.initialise(self.seed, self.last)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the scales and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        skips = []
        for k, block in enumerate(self.encoder):
            features = block(F.max_pool2d(features, 2) if k else features)
            skips.append(features)
        for block, skip in zip(self.decoder, reversed(skips[:-1]), strict=True):
            finer = F.interpolate(features, scale_factor=2, mode="bilinear", align_corners=False)
            features = block(torch.cat([finer, skip], dim=1))
        return self.last(features)


LEVELS = 4
"""The levels of DHDN's pyramid."""


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
        """Features ``(B, C, h, w)`` to features of the same shape."""
        dense = torch.cat([features, self.first(features)], dim=1)
        dense = torch.cat([dense, self.second(dense)], dim=1)
        return features + self.activation(self.third(dense))


def _level(features: int) -> nn.Sequential:
    return nn.Sequential(DCRBlock(features), DCRBlock(features))


def _pointwise(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(conv(inputs, outputs, size=1), nn.PReLU())


@DENOISERS.register("DHDN")
class DHDN(Denoiser):
    """The densely connected hierarchical network (Park, Yu and Jeong, CVPR Workshops 2019).

    A U-Net of four levels, features C, 2C, 4C, 8C, with two densely connected residual blocks a level on the way down
    and on the way up. Down: max-pooling and a 1 x 1 convolution; up: a 1 x 1 convolution and pixel shuffle; skips by
    concatenation at every level, the lowest included. With C = 128 and three channels it has 168.2 M parameters and
    takes 1,020 GMAC for 256 x 256 pixels; it is blind (``variance_map=False``).

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
        self.encoder = nn.ModuleList(_level(size) for size in sizes)
        self.down = nn.ModuleList(_pointwise(size, 2 * size) for size in sizes[:-1])
        # What comes up and what was kept have a level's features each, so its decoder works on twice as many.
        self.up = nn.ModuleList(_pointwise(2 * size, 2 * size) for size in reversed(sizes[1:]))
        self.decoder = nn.ModuleList(_level(2 * size) for size in reversed(sizes[:-1]))
        self.last = conv(2 * width, self.channels, size=1)
        # Fourteen residual blocks one after another stay tame when each starts as the identity (Goyal et al. 2017).
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
        features = torch.cat([self.encoder[-1](features), features], dim=1)
        for up, level, skip in zip(self.up, self.decoder, reversed(skips), strict=True):
            features = level(torch.cat([F.pixel_shuffle(up(features), 2), skip], dim=1))
        return self.last(features)


def _layer(width: int, batch_norm: bool) -> list[nn.Module]:
    norm = [nn.BatchNorm2d(width)] if batch_norm else []
    return [conv(width, width, bias=not batch_norm), *norm, nn.ReLU(inplace=True)]


@DENOISERS.register("DnCNN")
class DnCNN(Denoiser):
    """A chain of 3 x 3 convolutions that predicts the noise (Zhang et al., "Beyond a Gaussian Denoiser", TIP 2017).

    Convolution and ReLU, then ``depth - 2`` times convolution, batch normalisation and ReLU, then a convolution.
    Nothing is padded but the convolutions' zeros. The paper's network is blind: ``variance_map=False``.

    Args:
        width: features.
        depth: convolutions, 2 to 1000; 17 in the paper for one noise level, 20 for a range of them.
        batch_norm: as published. Denoise in eval mode: in train mode a picture's result depends on its batch.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
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
        middle = [layer for _ in range(depth - 2) for layer in _layer(width, batch_norm)]
        last = conv(width, self.channels)
        self.layers = nn.Sequential(conv(self.inputs, width), nn.ReLU(inplace=True), *middle, last)
        self.initialise(self.seed, last)

    def residual(self, features: Tensor) -> Tensor:
        """Run the chain: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``, the negative of the noise."""
        return self.layers(features)


@DENOISERS.register("FFDNet")
class FFDNet(Denoiser):
    """FFDNet (Zhang, Zuo and Zhang, TIP 2018), of sRGB by default; its normalisations are folded into the convolutions.

    It computes ``x - S(f([sigma, S^-1(x)]))`` with the pixel shuffle S, the deviation sigma of each channel as a plane
    and 3 x 3 convolutions f, all at half the sides, for white noise of a level that it is told.

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
        super().__init__({}, 2, channels=channels, seed=seed)
        self.config = {"width": width, "depth": depth, "channels": channels}
        sizes = [5 * channels, *[width] * (depth - 1), 4 * channels]
        for k in range(depth):
            self.add_module(f"conv{k:02d}", conv(sizes[k], sizes[k + 1]))
        self.depth = depth
        self.initialise(seed, self.get_submodule(f"conv{depth - 1:02d}"), gain=2.0**0.5)  # type: ignore[arg-type]

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from the picture and its deviations, ``(B, inputs, h, w)``."""
        picture, deviation = features.split(self.channels, dim=1)
        x = torch.cat([F.avg_pool2d(deviation, 2), F.pixel_unshuffle(picture, 2)], dim=1)
        for k in range(self.depth):
            x = self.get_submodule(f"conv{k:02d}")(x)
            x = x.relu_() if k + 1 < self.depth else x
        return -F.pixel_shuffle(x, 2)


class ChannelNorm(nn.Module):
    """Layer norm over the channels of every pixel."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.bias = nn.Parameter(torch.zeros(width))

    def forward(self, x: Tensor) -> Tensor:
        """Normalise ``(B, C, h, w)``, each pixel over its C channels."""
        normed = F.layer_norm(x.permute(0, 2, 3, 1), self.weight.shape, self.weight, self.bias, 1e-6)
        return normed.permute(0, 3, 1, 2)


def _gate(x: Tensor) -> Tensor:
    """Multiply the first half of the channels by the second."""
    first, second = x.chunk(2, dim=1)
    return first * second


class NAFBlock(nn.Module):
    """A block of :class:`NAFNet`: two residuals whose features gate each other."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm1, self.norm2 = ChannelNorm(width), ChannelNorm(width)
        self.conv1, self.conv2 = conv(width, 2 * width, 1), conv(2 * width, 2 * width, 3, groups=2 * width)
        self.attention, self.conv3 = conv(width, width, 1), conv(width, width, 1)
        self.conv4, self.conv5 = conv(width, 2 * width, 1), conv(width, width, 1)
        self.beta = nn.Parameter(torch.zeros(1, width, 1, 1))
        self.gamma = nn.Parameter(torch.zeros(1, width, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, h, w)`` to features of the same shape."""
        y = _gate(self.conv2(self.conv1(self.norm1(x))))
        x = x + self.beta * self.conv3(y * self.attention(y.mean((2, 3), keepdim=True)))
        return x + self.gamma * self.conv5(_gate(self.conv4(self.norm2(x))))


@DENOISERS.register("NAFNet")
class NAFNet(Denoiser):
    r"""A U-Net without activation functions (Chen et al., "Simple Baselines for Image Restoration", ECCV 2022).

    A block is two residuals: layer norm, pointwise c to 2c, depthwise 3 x 3, simple gate :math:`a \odot b`, simplified
    channel attention, pointwise; and layer norm, pointwise c to 2c, simple gate, pointwise; each enters with a learned
    factor that starts at 0. Convolutions 2 x 2 of stride 2 go down, pixel shuffles go up, skips are added. The channel
    attention averages over the whole input: a tile and the whole picture differ a little.

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
        sizes = [width * 2**k for k in range(len(encoder) + 1)]
        self.intro = conv(self.inputs, width)
        self.encoder = nn.ModuleList(_blocks(c, n) for c, n in zip(sizes, encoder, strict=False))
        self.downs = nn.ModuleList(conv(c, 2 * c, 2, stride=2, padding=0) for c in sizes[:-1])
        self.middle = _blocks(sizes[-1], middle)
        self.ups = nn.ModuleList(conv(2 * c, 4 * c, 1, bias=False) for c in reversed(sizes[:-1]))
        self.decoder = nn.ModuleList(_blocks(c, n) for c, n in zip(reversed(sizes[:-1]), decoder, strict=True))
        self.ending = conv(width, self.channels)
        self.initialise(self.seed, self.ending, gain=RESIDUAL_GAIN)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the scales and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
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
    return nn.Sequential(*(NAFBlock(width) for _ in range(number)))


CONTEXT = 4
"""Side of the squares, in cells, whose mean is subtracted from the signal of DRUNet's last scale."""


class ResidualBlock(nn.Module):
    """``x + conv(ReLU(conv(x)))``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1, self.conv2 = conv(width, width, bias=False), conv(width, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, h, w)`` to features of the same shape."""
        return x + self.conv2(self.conv1(x).relu_())


@DENOISERS.register("DRUNet")
class DRUNet(Denoiser):
    """A U-Net of residual blocks without biases (Zhang et al., "Plug-and-Play Image Restoration", TPAMI 2021).

    A block is ``x + conv(ReLU(conv(x)))``; convolutions 2 x 2 of stride 2 go down, a pointwise convolution and a pixel
    shuffle up (the source has transposed convolutions), skips are added. Without biases a network that is trained at
    some noise levels denoises at others too (Mohan et al., ICLR 2020). Here the first scale sees the signal less its
    mean over a cell of the last scale (8 x 8 pixels), interpolated, and the last scale sees that mean less its own over
    4 x 4 cells: light and shade are then the same problem, bfloat16 has digits for the noise, not for the brightness,
    and noise wider than a cell is seen, too. A blind network is given the mean as well, since noise depends on light.

    Args:
        width: features of the first scale, doubled at each further one; 64 is published.
        scales: of the pyramid, 1 to 12; 4 is published.
        blocks: of each scale, going down and going up, at most 1000; 4 is published.
        patch: side of the squares of pixels that enter as channels, 1 to 8. 2, as in FFDNet (Zhang et al., TIP 2018),
            takes a quarter of the time, for pictures that were demosaiced.
        light: give the network the mean over a cell besides, as blind ones have it: for developed pictures, whose noise
            depends on light by a curve that a noise map of one level does not tell. A variance of 0 then stands for a
            level that is not known.
        limits, mend, pyramid, channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> DRUNet(width=4, blocks=1)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    mixed: ClassVar[bool] = True
    growing: ClassVar[frozenset[str]] = frozenset({"blocks"})  # a new block is the identity at first

    def __init__(
        self,
        width: int = 64,
        scales: int = 4,
        blocks: int = 4,
        limits: bool = False,
        mend: bool = False,
        patch: int = 1,
        pyramid: int = 0,
        light: bool = False,
        **shared: Unpack[Shared],
    ) -> None:
        require_width(width)
        require_between("scales", scales, 1, MOST_SCALES)
        require_between("patch", patch, 1, 8)
        require_bounded(blocks=blocks)
        config = {"width": width, "scales": scales, "blocks": blocks, "limits": limits, "mend": mend}
        config |= ({} if patch == 1 else {"patch": patch}) | ({"pyramid": pyramid} if pyramid else {})
        config |= {"light": True} if light else {}
        cell = 2 ** (scales - 1)
        stride = patch * CONTEXT * cell
        super().__init__(config, stride, limits, mend, pyramid, **shared)
        self.cell, self.patch = cell, patch
        planes = self.channels * patch**2
        sizes = [width * 2**k for k in range(scales)]
        self.light = light or not self.reads_variance
        self.head = conv(self.inputs * patch**2 + self.light * planes, width, bias=False)
        self.encoder = nn.ModuleList(_residuals(size, blocks) for size in sizes)
        self.downs = nn.ModuleList(conv(c, 2 * c, 2, bias=False, stride=2, padding=0) for c in sizes[:-1])
        self.ups = nn.ModuleList(conv(2 * c, 4 * c, 1, bias=False) for c in reversed(sizes[:-1]))
        self.decoder = nn.ModuleList(_residuals(size, blocks) for size in reversed(sizes[:-1]))
        self.coarse = conv(planes, sizes[-1], bias=False)
        self.tail = conv(width, planes, bias=False)
        self.initialise(self.seed, self.tail, *self.block_ends(), gain=1.0)

    def block_ends(self) -> list[nn.Conv2d]:
        """The last layers of all blocks: as in DHDN, blocks stay tame when each starts as the identity."""
        return [module.conv2 for module in self.modules() if isinstance(module, ResidualBlock)]

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``."""
        return F.pixel_shuffle(self.tail(self.body(F.pixel_unshuffle(features, self.patch))), self.patch)

    def body(self, features: Tensor) -> Tensor:
        """Run all layers but the last: features ``(B, inputs, h, w)`` to ``(B, width, h, w)``."""
        planes = self.coarse.in_channels
        signal, maps = features[:, :planes], features[:, planes:]
        mean = F.avg_pool2d(signal, self.cell)
        light = F.interpolate(mean, signal.shape[-2:], mode="bilinear")
        seen = [signal - light, maps, light] if self.light else [signal - light, maps]
        x = self.head(torch.cat(seen, dim=1))
        # The mean over a cell has noise of deviation 1 / cell.
        wide = F.interpolate(F.avg_pool2d(mean, CONTEXT), mean.shape[-2:], mode="bilinear")
        return self.trunk(x, self.coarse(self.cell * (mean - wide)))

    def trunk(self, x: Tensor, coarse: Tensor) -> Tensor:
        """Run the pyramid.

        Features ``x`` ``(B, width, h, w)`` come from the first layer, and ``coarse`` ``(B, C, h', w')``, of the size of
        the last scale, join there; the result has the shape of ``x``.
        """
        skips = []
        for k, blocks in enumerate(self.encoder):
            x = self.downs[k - 1](x) if k else x
            x = blocks(x + coarse if k == len(self.encoder) - 1 else x)
            skips.append(x)
        for up, blocks, skip in zip(self.ups, self.decoder, reversed(skips[:-1]), strict=True):
            x = blocks(F.pixel_shuffle(up(x), 2) + skip)
        return x


def _residuals(width: int, number: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(width) for _ in range(number)))
