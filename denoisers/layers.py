"""The parts of the networks: convolutions whose weights are drawn later, padding, and limits on their size."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rawaug.registry import require_between

PACKED = 4
"""Packed RAW has this many channels: R, Gr, Gb, B."""

MOST_FEATURES = 2**16
"""A layer has at most this many features, as a few bytes of a file or a recipe can ask for any number."""
MOST_LAYERS = 1000
"""One setting may ask for at most this many layers or blocks."""
MOST_SCALES = 12
"""A U-Net has at most this many scales."""

LEAK = 0.2
"""This is the negative slope of the leaky ReLUs."""
HE_GAIN = math.sqrt(2.0 / (1.0 + LEAK**2))
"""This gain keeps the deviation of features through a convolution and its leaky ReLU."""
RESIDUAL_GAIN = math.sqrt(1.0 / 3.0)
"""Networks that add up dozens of residuals of separable convolutions use this gain; HE_GAIN would let them grow."""


def conv(
    inputs: int,
    outputs: int,
    size: int = 3,
    bias: bool = True,
    stride: int = 1,
    groups: int = 1,
    padding: int | None = None,
) -> nn.Conv2d:
    """Make a convolution that keeps the sides of a picture or divides them by ``stride``.

    Its weights are left as they are in memory; :meth:`denoisers.Denoiser.initialise` draws the whole network's weights.

    Args:
        inputs: channels that come in, a multiple of ``groups``.
        outputs: channels that go out.
        size: side of the square kernel.
        bias: whether the layer adds a constant to each channel.
        stride: step from one output pixel to the next.
        groups: parts of the channels that do not see each other; as many as there are inputs for a depthwise layer.
        padding: zeros around the picture, half of ``size`` by default.
    """
    if padding is None:
        padding = size // 2

    return _Conv2d(inputs, outputs, size, stride=stride, padding=padding, groups=groups, bias=bias)


class _Conv2d(nn.Conv2d):
    """Leaves its weights as they are in memory; ``torch.nn.utils.skip_init`` does so by importing SymPy, 0.4 s."""

    def reset_parameters(self) -> None:
        """Draw nothing."""


def can_fuse(features: Tensor) -> bool:
    """Tell whether :func:`fused_conv` takes these features: bfloat16 on a CPU with oneDNN, without gradients."""
    if torch.is_grad_enabled() or features.dtype is not torch.bfloat16 or features.device.type != "cpu":
        return False
    if torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export():
        return False
    return torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")


def fused_conv(features: Tensor, layer: nn.Conv2d, added: Tensor | None = None) -> Tensor:
    """Run a convolution without bias and, in the same pass over memory, what follows it.

    What follows is a ReLU, or the addition of features of the result's shape. The sum is rounded once, not twice. On a
    CPU, a convolution of few features waits for memory, and three passes take half as long again as one.

    Args:
        features: ``(B, C, h, w)`` that :func:`can_fuse` accepts.
        layer: a convolution of ungrouped channels.
        added: what is added to the result; None for a ReLU.
    """
    run = torch.ops.mkldnn._convolution_pointwise  # torch.compile makes this of the layers; no compiler is needed
    weight = layer.weight.to(features.dtype)
    geometry = (layer.padding, layer.stride, layer.dilation, 1)
    if added is None:
        return run(features, weight, None, *geometry, "relu", [], "")
    return run.binary(features, added, weight, None, *geometry, "add", 1.0, None, [], "")


def pad_to_multiple(image: Tensor, stride: int) -> Tensor:
    """Pad ``(B, C, h, w)`` below and on the right to multiples of ``stride``, by reflection without the edge."""
    # An exported network pads any size, even if the picture that it is traced with needs no padding.
    is_traced = torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export()

    height, width = image.shape[-2:]
    if not is_traced:
        below, beside = -height % stride, -width % stride
        if below == beside == 0:
            return image
        if below < height and beside < width:
            return F.pad(image, (0, beside, 0, below), mode="reflect")

    # torch's own padding reflects at most once, which is not enough for a picture smaller than the stride.
    for axis, size in ((-2, height), (-1, width)):
        period = 2 * (size - 1)
        position = torch.remainder(torch.arange(size + -size % stride, device=image.device), period)
        image = image.index_select(axis, torch.minimum(position, period - position))
    return image


def require_width(width: int, multiple: int = 1) -> None:
    """Refuse a number of features that no layer can have, or that no machine could hold."""
    if width < 1 or width % multiple:
        raise ValueError(f"width must be a positive multiple of {multiple}, got {width}")
    require_between("width", width, 1, MOST_FEATURES)


def require_bounded(**layers: int) -> None:
    """Refuse more layers than :data:`MOST_LAYERS`, which no machine would build; names are those of the settings."""
    for key, number in layers.items():
        require_between(key, number, 0, MOST_LAYERS)
