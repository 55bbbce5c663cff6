"""DRUNet, a U-Net of residual blocks without biases (Zhang et al., TPAMI 2021), and the base of its relatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import MOST_SCALES, can_fuse, conv, fused_conv, require_bounded, require_width
from denoisers.network import DENOISERS, Denoiser, Shared
from rawaug.registry import require_between

CONTEXT = 4
"""The signal of the last scale is taken less its mean over squares of this side, in cells."""


class Size(NamedTuple):
    """The size of a residual U-Net.

    Attributes:
        width: features of the first scale, doubled at each further one.
        scales: number of scales, 1 to 12.
        blocks: residual blocks of each scale, going down and going up, at most 1000: one number for all scales, or one
            for each, the finest first.
    """

    width: int
    scales: int
    blocks: int | Sequence[int]

    @property
    def blocks_by_scale(self) -> list[int]:
        """The residual blocks of each scale, the finest first; raise ValueError unless each scale has a number."""
        if isinstance(self.blocks, int):
            return [self.blocks] * self.scales

        if len(self.blocks) != self.scales:
            raise ValueError(f"blocks must be one number, or one for each of {self.scales} scales, got {self.blocks}")
        return list(self.blocks)


class ResidualBlock(nn.Module):
    """``x + conv(ReLU(conv(x)))``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = conv(width, width, bias=False)
        self.conv2 = conv(width, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        if can_fuse(x):
            return fused_conv(fused_conv(x, self.conv1), self.conv2, added=x)
        return self.conv2(self.conv1(x).relu_()).add_(x)


class ResidualUNet(Denoiser):
    """Base of :class:`DRUNet` and of the networks that start from its weights, for other inputs or other results.

    Its subclasses choose what the first layer and the last scale see, and what the last layer gives. Their constructors
    call :meth:`add_layers`, add layers of their own, and draw all initial weights once, by :meth:`initialise`.

    A blind network, or one with ``light``, also gets the mean over a cell of the last scale, since noise depends on
    light.

    Args:
        config: the network's settings besides its size, ``limits``, ``mend`` and the shared ones.
        size: features, scales and blocks.
        limits, mend, pyramid, shared: see :class:`denoisers.Denoiser`.
        multiple: pixels of the picture, along a side, that are one pixel of the first layer.
    """

    mixed: ClassVar[bool] = True
    growing: ClassVar[frozenset[str]] = frozenset({"blocks"})  # a new block starts as the identity
    light: bool = False

    head: nn.Conv2d
    coarse: nn.Conv2d
    tail: nn.Conv2d

    def __init__(
        self,
        config: dict[str, Any],
        size: Size,
        limits: bool = False,
        mend: bool = False,
        pyramid: int = 0,
        multiple: int = 1,
        **shared: Unpack[Shared],
    ) -> None:
        require_width(size.width)
        require_between("scales", size.scales, 1, MOST_SCALES)
        for blocks in size.blocks_by_scale:
            require_bounded(blocks=blocks)
        if not isinstance(size.blocks, int):
            size = size._replace(blocks=tuple(size.blocks))

        config = {**size._asdict(), "limits": limits, "mend": mend, **config}
        cell = 2 ** (size.scales - 1)
        super().__init__(config, multiple * CONTEXT * cell, limits, mend, pyramid, **shared)
        self.size = size
        self.cell = cell

    def add_layers(self, inputs: int, coarse: int, outputs: int) -> None:
        """Add the layers of the U-Net, in the order in which their weights are drawn.

        Args:
            inputs: channels that enter the first layer.
            coarse: channels that join at the last scale.
            outputs: channels of the last layer.
        """
        width, scales, _ = self.size
        sizes = [width * 2**k for k in range(scales)]
        numbers = self.size.blocks_by_scale

        self.head = conv(inputs, width, bias=False)
        self.encoder = nn.ModuleList()
        self.downs = nn.ModuleList()
        self.ups = nn.ModuleList()
        self.decoder = nn.ModuleList()
        for size, blocks in zip(sizes, numbers, strict=True):
            self.encoder.append(nn.Sequential(*[ResidualBlock(size) for _ in range(blocks)]))
        for size in sizes[:-1]:
            self.downs.append(conv(size, 2 * size, 2, bias=False, stride=2, padding=0))
        for size, blocks in reversed(list(zip(sizes[:-1], numbers[:-1], strict=True))):
            self.ups.append(conv(2 * size, 4 * size, 1, bias=False))
            self.decoder.append(nn.Sequential(*[ResidualBlock(size) for _ in range(blocks)]))
        self.coarse = conv(coarse, sizes[-1], bias=False)
        self.tail = conv(width, outputs, bias=False)

    def block_ends(self) -> list[nn.Conv2d]:
        """List the last layers of all blocks: as in DHDN, blocks stay stable if each starts as the identity."""
        return [module.conv2 for module in self.modules() if isinstance(module, ResidualBlock)]

    def is_relative(self, model: Denoiser) -> bool:
        """Tell whether a network is of this class or of one of its bases, or a DRUNet."""
        return isinstance(self, type(model)) or type(model) is DRUNet

    def body(self, features: Tensor) -> Tensor:
        """Run all layers but the last: the signal and its maps ``(B, C, h, w)`` to features ``(B, width, h, w)``."""
        fine, coarse = self.first_layers(features)
        return self.trunk(fine, coarse)

    def first_layers(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Run the layers that see the signal and its maps ``(B, C, h, w)``.

        Returns:
            Features ``(B, width, h, w)`` of the first layer, and those of the last scale, see :meth:`trunk`.
        """
        planes = self.coarse.in_channels
        signal = features[:, :planes]
        maps = features[:, planes:]

        mean = F.avg_pool2d(signal, self.cell)
        light = F.interpolate(mean, signal.shape[-2:], mode="bilinear")
        inputs = [signal - light, maps]
        if self.light:
            inputs.append(light)
        return self.head(torch.cat(inputs, dim=1)), self.coarse(self.wide_signal(mean))

    def wide_signal(self, mean: Tensor) -> Tensor:
        """Subtract from the mean over cells ``(B, C, h', w')`` its own local mean, for the last scale to see.

        The mean over a cell has noise of deviation 1 / cell, so it is scaled to 1.
        """
        around = F.interpolate(F.avg_pool2d(mean, CONTEXT), mean.shape[-2:], mode="bilinear")
        return self.cell * (mean - around)

    def trunk(self, x: Tensor, coarse: Tensor) -> Tensor:
        """Run the U-Net.

        Args:
            x: features ``(B, width, h, w)`` of the first layer.
            coarse: features ``(B, C, h', w')`` that join at the last scale, of its size.

        Returns:
            Features of the shape of ``x``.
        """
        skips = []
        for blocks, down in zip(self.encoder, self.downs, strict=False):
            x = blocks(x)
            skips.append(x)
            x = down(x)

        lowest = self.encoder[-1]
        x = lowest(x + coarse)
        for up, blocks in zip(self.ups, self.decoder, strict=True):
            finer = F.pixel_shuffle(up(x), 2)
            x = blocks(finer.add_(skips.pop()))
        return x


@DENOISERS.register("DRUNet")
class DRUNet(ResidualUNet):
    """A U-Net of residual blocks without biases (Zhang et al., "Plug-and-Play Image Restoration", TPAMI 2021).

    A block is ``x + conv(ReLU(conv(x)))``. Convolutions 2 x 2 of stride 2 lead down, and a pointwise convolution and a
    pixel shuffle lead up (the source has transposed convolutions); skips are added. Without biases, a network that is
    trained at some noise levels also denoises at others (Mohan et al., ICLR 2020). Here the first scale sees the signal
    less its interpolated mean over a cell of the last scale (8 x 8 pixels), and the last scale sees that mean less its
    own mean over 4 x 4 cells. Light and shade are then the same problem, bfloat16 spends its digits on the noise and
    not on the brightness, and noise wider than a cell is seen, too. A blind network is also given the mean, since noise
    depends on light.

    Args:
        width: features of the first scale, doubled at each further one; 64 is published.
        scales: of the pyramid, 1 to 12; 4 is published.
        blocks: of each scale, going down and going up, at most 1000; 4 is published. One number, or one for each scale,
            the finest first: where noise is weak, fine scales have the most to do.
        patch: side of the squares of pixels that enter as channels, 1 to 8. A side of 2, as in FFDNet (Zhang et al.,
            TIP 2018), takes a quarter of the time and is for pictures that were demosaiced.
        light: also give the network the mean over a cell, as blind ones have it. This is for developed pictures, whose
            noise depends on light by a curve that a noise map of one level cannot show. A variance of 0 then stands for
            an unknown level.
        limits, mend, pyramid, channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> DRUNet(width=4, blocks=1)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    def __init__(
        self,
        width: int = 64,
        scales: int = 4,
        blocks: int | Sequence[int] = 4,
        limits: bool = False,
        mend: bool = False,
        patch: int = 1,
        pyramid: int = 0,
        light: bool = False,
        **shared: Unpack[Shared],
    ) -> None:
        require_between("patch", patch, 1, 8)

        # A file names these settings only if they differ from their defaults.
        config: dict[str, Any] = {}
        if patch != 1:
            config["patch"] = patch
        if pyramid:
            config["pyramid"] = pyramid
        if light:
            config["light"] = True

        super().__init__(config, Size(width, scales, blocks), limits, mend, pyramid, multiple=patch, **shared)
        self.patch = patch
        self.light = light or not self.reads_variance
        if self.light:
            self.views = 2

        planes = self.channels * patch**2
        self.add_layers(self.inputs * patch**2 + self.light * planes, planes, planes)
        self.initialise(self.seed, self.tail, *self.block_ends(), gain=1.0)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``."""
        squares = F.pixel_unshuffle(features, self.patch)
        correction = self.tail(self.body(squares))
        return F.pixel_shuffle(correction, self.patch)
