"""PMRID, a U-Net of separable convolutions for phones, made for the k-sigma domain (Wang et al., ECCV 2020).

Layers are named as in the file of weights that its authors publish. ReLUs and sums work in place, since on a CPU
allocating new memory costs more than they do.

Source: Wang et al., "Practical Deep Raw Image Denoising on Mobile Devices", ECCV 2020.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import ClassVar, Unpack

import torch
from torch import Tensor, nn

from denoisers.layers import RESIDUAL_GAIN, conv, require_width
from denoisers.network import DENOISERS, Denoiser, Shared

PUBLISHED_WIDTH = 16
BLOCKS = (2, 2, 4, 4)
"""The encoder's four stages have these numbers of bottleneck blocks."""


class Separable(nn.Module):
    """A depthwise convolution without bias, then a pointwise one.

    Args:
        inputs: channels that come in.
        outputs: channels that go out.
        size: side of the depthwise kernel.
        stride: step of the depthwise convolution.
    """

    def __init__(self, inputs: int, outputs: int, size: int, stride: int = 1) -> None:
        super().__init__()
        self.depthwise = conv(inputs, inputs, size, bias=False, stride=stride, groups=inputs)
        self.pointwise = conv(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, inputs, h, w)`` to ``(B, outputs, h / stride, w / stride)``."""
        y: Tensor = self.pointwise(self.depthwise(x))
        return y


class EncoderBlock(nn.Module):
    """Two separable 5 x 5 convolutions through a quarter of the width, plus the input."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = Separable(inputs, outputs // 4, 5, stride)
        self.conv2 = Separable(outputs // 4, outputs, 5)
        self.proj: nn.Module = nn.Identity()
        if stride > 1 or inputs != outputs:
            self.proj = Separable(inputs, outputs, 3, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, inputs, h, w)`` to ``(B, outputs, h / stride, w / stride)``."""
        y: Tensor = self.conv2(self.conv1(x).relu_())
        return y.add_(self.proj(x)).relu_()


class Residual(nn.Module):
    """Two separable 3 x 3 convolutions, plus the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv0 = Separable(width, width, 3)
        self.conv1 = Separable(width, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        y: Tensor = self.conv1(self.conv0(x).relu_())
        return y.add_(x)


class DecoderStage(nn.Module):
    """A residual and a transposed convolution to twice the size, to which the encoder's features are added."""

    def __init__(self, inputs: int, outputs: int, skip: int) -> None:
        super().__init__()
        self.decode_conv = Residual(inputs)
        self.upsample = nn.utils.skip_init(
            nn.ConvTranspose2d, inputs, outputs, 2, stride=2, device=torch.get_default_device()
        )
        self.proj_conv = Separable(skip, outputs, 3)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        """Map features ``(B, inputs, h, w)`` and ``skip`` ``(B, skip, 2h, 2w)`` to ``(B, outputs, 2h, 2w)``."""
        y: Tensor = self.upsample(self.decode_conv(x))
        return y.add_(self.proj_conv(skip).relu_())


@DENOISERS.register("PMRID")
class PMRID(Denoiser):
    """PMRID's network (Wang et al., ECCV 2020).

    It has four encoder stages of 2, 2, 4, 4 bottleneck blocks (depthwise 5 x 5 and pointwise, twice), each at half the
    size of the one before. Each of the four decoder stages has a residual of two separable 3 x 3 convolutions, a
    transposed convolution 2 x 2 and a skip. At the published width the network has 1.03 M parameters and takes 3.7 GMAC
    for each megapixel of mosaic.

    Args:
        width: features of the first convolution; the encoder has 4, 8, 16 and 32 times as many.
        domain: linear, ksigma (as published) or anscombe.
        channels, variance_map, deviation, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> PMRID(width=4)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 4, 33, 50])
    """

    defaults: ClassVar[Shared] = {**Denoiser.defaults, "variance_map": False, "domain": "ksigma"}

    def __init__(self, width: int = PUBLISHED_WIDTH, **shared: Unpack[Shared]) -> None:
        require_width(width)
        super().__init__({"width": width}, 16, **shared)

        self.conv0 = _under_conv(conv(self.inputs, width))
        inputs = width
        for k, blocks in enumerate(BLOCKS, start=1):
            outputs = 2 * width * 2**k
            stage = nn.Sequential(EncoderBlock(inputs, outputs, stride=2))
            for _ in range(blocks - 1):
                stage.append(EncoderBlock(outputs, outputs, stride=1))
            self.add_module(f"enc{k}", stage)
            inputs = outputs

        self.encdec = Separable(32 * width, 4 * width, 3)
        self.dec1 = DecoderStage(4 * width, 4 * width, skip=16 * width)
        self.dec2 = DecoderStage(4 * width, 2 * width, skip=8 * width)
        self.dec3 = DecoderStage(2 * width, 2 * width, skip=4 * width)
        self.dec4 = DecoderStage(2 * width, width, skip=width)
        self.out0 = Residual(width)
        last = conv(width, self.channels)
        self.out1 = _under_conv(last)

        self.initialise(self.seed, last, gain=RESIDUAL_GAIN)

    def residual(self, features: Tensor) -> Tensor:
        """Go down the stages and up again: ``(B, inputs, h, w)`` to the correction ``(B, channels, h, w)``."""
        x = self.conv0(features).relu_()
        skips = []
        for k in range(1, 5):
            skips.append(x)
            stage = self.get_submodule(f"enc{k}")
            x = stage(x)

        x = self.encdec(x).relu_()
        for stage in (self.dec1, self.dec2, self.dec3, self.dec4):
            x = stage(x, skips.pop())

        correction: Tensor = self.out1(self.out0(x))
        return correction


def _under_conv(layer: nn.Conv2d) -> nn.Sequential:
    """Put a layer under the name ``conv``, as the published file has it."""
    return nn.Sequential(OrderedDict(conv=layer))
