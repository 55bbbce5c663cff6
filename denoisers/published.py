r"""PMRID and CycleISP, networks of RAW whose authors publish the weights; layers are named as in these files.

PMRID is a U-Net of separable convolutions for phones, made for the k-sigma domain. Its ReLUs and sums work in place: on
a CPU fresh memory costs more than they do. Source: Wang et al., "Practical Deep Raw Image Denoising on Mobile Devices",
ECCV 2020.

A block of CycleISP is ``v + merge([f s, f c])`` with ``f = conv(prelu(conv(v)))``, ``s = sigmoid(conv([max_c f, mean_c
f]))`` over space and ``c``, a weight a channel, the sigmoid of two layers on f's mean. Source: Zamir et al., "CycleISP:
Real Image Restoration via Improved Data Synthesis", CVPR 2020.
"""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import ClassVar, Unpack

import torch
from torch import Tensor, nn

from denoisers.network import DENOISERS, RESIDUAL_GAIN, Denoiser, Shared, conv, require_bounded, require_width

PUBLISHED_WIDTH = 16
BLOCKS = (2, 2, 4, 4)
"""Bottleneck blocks of the encoder's four stages."""


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
        """Features ``(B, inputs, h, w)`` to ``(B, outputs, h / stride, w / stride)``."""
        y: Tensor = self.pointwise(self.depthwise(x))
        return y


class EncoderBlock(nn.Module):
    """Two separable 5 x 5 convolutions through a quarter of the width, plus the input."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.conv1 = Separable(inputs, outputs // 4, 5, stride)
        self.conv2 = Separable(outputs // 4, outputs, 5)
        self.proj = Separable(inputs, outputs, 3, stride) if stride > 1 or inputs != outputs else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, inputs, h, w)`` to ``(B, outputs, h / stride, w / stride)``."""
        y: Tensor = self.conv2(self.conv1(x).relu_())
        return y.add_(self.proj(x)).relu_()


class Residual(nn.Module):
    """Two separable 3 x 3 convolutions, plus the input."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv0 = Separable(width, width, 3)
        self.conv1 = Separable(width, width, 3)

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, h, w)`` to features of the same shape."""
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
        """Features ``(B, inputs, h, w)`` and ``skip`` ``(B, skip, 2h, 2w)`` to ``(B, outputs, 2h, 2w)``."""
        y: Tensor = self.upsample(self.decode_conv(x))
        return y.add_(self.proj_conv(skip).relu_())


@DENOISERS.register("PMRID")
class PMRID(Denoiser):
    """PMRID's network (Wang et al., ECCV 2020).

    Four encoder stages of 2, 2, 4, 4 bottleneck blocks (depthwise 5 x 5 and pointwise, twice), each at half the size of
    the one before; four decoder stages of a residual of two separable 3 x 3 convolutions, a transposed convolution
    2 x 2 and a skip; 1.03 M parameters and 3.7 GMAC a mosaic megapixel at the published width.

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
        sizes = [width, 4 * width, 8 * width, 16 * width, 32 * width]
        self.conv0 = _under_conv(conv(self.inputs, width))
        for k, blocks in enumerate(BLOCKS, start=1):
            first = EncoderBlock(sizes[k - 1], sizes[k], stride=2)
            rest = [EncoderBlock(sizes[k], sizes[k], stride=1) for _ in range(blocks - 1)]
            self.add_module(f"enc{k}", nn.Sequential(first, *rest))
        self.encdec = Separable(sizes[4], sizes[1], 3)
        decoder = [(sizes[1], sizes[1]), (sizes[1], 2 * width), (2 * width, 2 * width), (2 * width, width)]
        for k, ((inputs, outputs), skip) in enumerate(zip(decoder, reversed(sizes[:4]), strict=True), start=1):
            self.add_module(f"dec{k}", DecoderStage(inputs, outputs, skip))
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
            x = self.get_submodule(f"enc{k}")(x)
        x = self.encdec(x).relu_()
        for k in range(1, 5):
            x = self.get_submodule(f"dec{k}")(x, skips[-k])
        correction: Tensor = self.out1(self.out0(x))
        return correction


def _under_conv(layer: nn.Conv2d) -> nn.Sequential:
    """Put a layer under the name ``conv``, as the published file has it."""
    return nn.Sequential(OrderedDict(conv=layer))


# -- CycleISP ---------------------------------------------------------------------------------------------------------

RENAMED = (("head.0.", "head."), ("SA.spatial.conv.", "spatial."), ("CA.conv_du.", "channel."), ("conv1x1.", "merge."))
"""Parts of the names of layers in the published checkpoints, and what they are called here."""
UNUSED = ("blur.", "merge.0.")
"""Layers, renamed, that the checkpoints hold though the published pass does not use them."""


class DualAttentionBlock(nn.Module):
    """A residual block whose features pass through attention over space and over channels; see the module."""

    def __init__(self, features: int, reduction: int, act: nn.PReLU) -> None:
        super().__init__()
        squeezed = features // reduction
        self.body = nn.Sequential(conv(features, features), act, conv(features, features))
        self.spatial = conv(2, 1, bias=False)
        self.channel = nn.Sequential(conv(features, squeezed, 1), nn.ReLU(), conv(squeezed, features, 1))
        self.merge = conv(2 * features, features, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, h, w)`` to features of the same shape."""
        f = self.body(x)
        where = self.spatial(torch.cat([f.amax(1, keepdim=True), f.mean(1, keepdim=True)], dim=1)).sigmoid()
        which = self.channel(f.mean((2, 3), keepdim=True)).sigmoid()
        return x + self.merge(torch.cat([f * where, f * which], dim=1))


class ResidualGroup(nn.Module):
    """Dual-attention blocks and a convolution, whose result is added to their input.

    Args:
        features: channels that come in and go out.
        blocks: number of dual-attention blocks.
        reduction: factor by which channel attention narrows the features.
        act: the PReLU that all blocks of the network share.
    """

    def __init__(self, features: int, blocks: int, reduction: int, act: nn.PReLU) -> None:
        super().__init__()
        layers: list[nn.Module] = [DualAttentionBlock(features, reduction, act) for _ in range(blocks)]
        self.body = nn.Sequential(*layers, conv(features, features))

    def forward(self, x: Tensor) -> Tensor:
        """Features ``(B, C, h, w)`` to features of the same shape."""
        return x + self.body(x)


class Trunk(nn.Module):
    """The layers that all three of CycleISP's networks have: a first convolution, groups and a last convolution.

    One PReLU, with a slope for each feature, is used all over.

    Args:
        inputs: channels that come in.
        features: channels of all layers but the first.
        groups: number of residual groups.
        blocks: dual-attention blocks of each group.
        reduction: factor by which channel attention narrows the features.
    """

    def __init__(self, inputs: int, features: int, groups: int, blocks: int, reduction: int) -> None:
        super().__init__()
        act = nn.PReLU(features)
        self.head = conv(inputs, features)
        layers: list[nn.Module] = [ResidualGroup(features, blocks, reduction, act) for _ in range(groups)]
        self.body = nn.Sequential(*layers, conv(features, features), act)


def load_published(network: nn.Module, path: str | os.PathLike[str], part: str) -> None:
    """Load the weights of a published checkpoint into a network; nothing in the file is run as code.

    ``part`` is what messages call the network.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or its layers are not those of the network.
    """
    state, expected = _own_names(_read_state(Path(path))), network.state_dict()
    shapes, needed = ({key: tuple(value.shape) for key, value in found.items()} for found in (state, expected))
    for key in sorted(needed | shapes):
        if shapes.get(key) != needed.get(key):
            sizes = f"{shapes.get(key, 'missing')}, {part} needs {needed.get(key, 'no such layer')}"
            raise ValueError(f"{path}: layer {key} is {sizes}; build the model in the published size")
    network.load_state_dict(state)


def _read_state(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path}: not a checkpoint of plain weights: {str(error).splitlines()[0]}") from None
    state = checkpoint.get("state_dict") if isinstance(checkpoint, dict) else None
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"{path}: holds no 'state_dict' of tensors; give a checkpoint in CycleISP's layout")
    return state


def _own_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rename the layers of a published checkpoint to those here, and leave out :data:`UNUSED` ones."""
    renamed = {}
    for name, value in state.items():
        key = name.removeprefix("module.")
        for published, own in RENAMED:
            key = key.replace(published, own)
        if not key.startswith(UNUSED):
            renamed[key] = value
    return renamed


@DENOISERS.register("CycleISPDenoiser")
class CycleISPDenoiser(Denoiser):
    """Zamir's denoiser for RAW: four groups of eight dual-attention blocks on ``[noisy, variance]``, without pooling.

    It has 2.84 M parameters as published.

    Args:
        width: features, a multiple of ``reduction``; 64 as published.
        groups, blocks: 4 groups of 8 blocks as published, at most 1000 blocks in all.
        reduction: of the features in channel attention.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(1, 4, 20, 30)
        >>> CycleISPDenoiser(width=16, groups=1, blocks=1)(noisy, torch.full_like(noisy, 1e-3)).shape
        torch.Size([1, 4, 20, 30])
    """

    defaults: ClassVar[Shared] = {**Denoiser.defaults, "deviation": False}

    def __init__(
        self, width: int = 64, groups: int = 4, blocks: int = 8, reduction: int = 16, **shared: Unpack[Shared]
    ) -> None:
        require_width(width, multiple=max(reduction, 1))
        if min(groups, blocks, reduction) < 1:
            raise ValueError(f"groups, blocks and reduction must be at least 1, got {groups}, {blocks}, {reduction}")
        require_bounded(blocks=groups * blocks)
        config = {"width": width, "groups": groups, "blocks": blocks, "reduction": reduction}
        super().__init__(config, **shared)
        self.trunk = Trunk(self.inputs, width, groups, blocks, reduction)
        last = conv(width, self.channels)
        self.trunk.tail = nn.Sequential(last)
        # As in DHDN: thirty-two residual blocks one after another stay tame when each starts as the identity.
        ends = [module.merge for module in self.modules() if isinstance(module, DualAttentionBlock)]
        self.initialise(self.seed, last, *ends)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``."""
        trunk = self.trunk
        correction: Tensor = trunk.tail(trunk.body(trunk.head(features)))  # type: ignore[operator]
        return correction

    @classmethod
    def from_published(cls, path: str | os.PathLike[str]) -> CycleISPDenoiser:
        """Make the network with the weights of a published checkpoint (``sidd_denoising_raw.pth``), in eval mode.

        The weights are for RAW in RGGB, clipped to [0, 1]; errors are those of :func:`load_published`.
        """
        model = cls()
        load_published(model.trunk, path, "the denoiser")
        return model.eval()
