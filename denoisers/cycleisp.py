r"""CycleISP's denoiser of RAW and the layers that all three of its networks share (Zamir et al., CVPR 2020).

A block is ``v + merge([f s, f c])`` with ``f = conv(prelu(conv(v)))``, ``s = sigmoid(conv([max_c f, mean_c f]))`` over
space, and ``c``, one weight for each channel, the sigmoid of two layers on the mean of f. Layers have nearly the names
that they have in the authors' published files of weights, which :func:`load_part` reads.

Source: Zamir et al., "CycleISP: Real Image Restoration via Improved Data Synthesis", CVPR 2020.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from typing import ClassVar, Unpack

import torch
from torch import Tensor, nn

from denoisers.layers import conv, require_bounded, require_width
from denoisers.network import DENOISERS, Denoiser, Shared

RENAMED = (("head.0.", "head."), ("SA.spatial.conv.", "spatial."), ("CA.conv_du.", "channel."), ("conv1x1.", "merge."))
"""These parts of layers' names in the published checkpoints are called otherwise here."""
UNUSED = ("blur.", "merge.0.")
"""The checkpoints hold these layers (renamed), though the published pass does not use them."""


class DualAttentionBlock(nn.Module):
    """A residual block whose features pass through attention over space and over channels; the module explains it."""

    def __init__(self, features: int, reduction: int, act: nn.PReLU) -> None:
        super().__init__()
        squeezed = features // reduction
        self.body = nn.Sequential(conv(features, features), act, conv(features, features))
        self.spatial = conv(2, 1, bias=False)
        self.channel = nn.Sequential(conv(features, squeezed, 1), nn.ReLU(), conv(squeezed, features, 1))
        self.merge = conv(2 * features, features, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        f = self.body(x)

        extremes = torch.cat([f.amax(1, keepdim=True), f.mean(1, keepdim=True)], dim=1)
        over_space = self.spatial(extremes).sigmoid()
        over_channels = self.channel(f.mean((2, 3), keepdim=True)).sigmoid()

        return x + self.merge(torch.cat([f * over_space, f * over_channels], dim=1))


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
        self.body = nn.Sequential()
        for _ in range(blocks):
            self.body.append(DualAttentionBlock(features, reduction, act))
        self.body.append(conv(features, features))

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, h, w)`` to features of the same shape."""
        return x + self.body(x)


class Trunk(nn.Module):
    """The layers that all three of CycleISP's networks have: a first convolution, groups and a last convolution.

    All layers share one PReLU, which has a slope for each feature.

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
        self.body = nn.Sequential()
        for _ in range(groups):
            self.body.append(ResidualGroup(features, blocks, reduction, act))
        self.body.append(conv(features, features))
        self.body.append(act)


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

        last = conv(width, self.channels)
        self.trunk = Trunk(self.inputs, width, groups, blocks, reduction)
        self.trunk.tail = nn.Sequential(last)

        # As in DHDN, a chain of thirty-two residual blocks stays stable if each starts as the identity.
        ends = [module.merge for module in self.modules() if isinstance(module, DualAttentionBlock)]
        self.initialise(self.seed, last, *ends)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``."""
        x = self.trunk.body(self.trunk.head(features))
        correction: Tensor = self.trunk.tail(x)  # type: ignore[operator]
        return correction

    @classmethod
    def from_published(cls, path: str | os.PathLike[str]) -> CycleISPDenoiser:
        """Make the network with the weights of a published checkpoint (``sidd_denoising_raw.pth``), in eval mode.

        The weights are for RAW in RGGB, clipped to [0, 1]; errors are those of :func:`load_part`.
        """
        model = cls()
        load_part(model.trunk, path, "the denoiser")
        return model.eval()


def load_part(network: nn.Module, path: str | os.PathLike[str], part: str) -> None:
    """Load the weights of a published checkpoint into a network; nothing in the file is run as code.

    ``part`` is what messages call the network.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not such a file, or its layers are not those of the network.
    """
    state = _own_names(_read_state(Path(path)))
    expected = network.state_dict()

    for key in sorted(state | expected):
        size = "missing"
        if key in state:
            size = str(tuple(state[key].shape))
        expected_size = "no such layer"
        if key in expected:
            expected_size = str(tuple(expected[key].shape))
        if size != expected_size:
            raise ValueError(
                f"{path}: layer {key} is {size}, {part} needs {expected_size}; build the model in the published size"
            )
    network.load_state_dict(state)


def _read_state(path: Path) -> dict[str, Tensor]:
    """Read the tensors under ``state_dict`` of a checkpoint, without running what it may hold as code."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path}: not a checkpoint of plain weights: {str(error).splitlines()[0]}") from None

    state = None
    if isinstance(checkpoint, dict):
        state = checkpoint.get("state_dict")
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(f"{path}: holds no 'state_dict' of tensors; give a checkpoint in CycleISP's layout")
    return state


def _own_names(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Rename the layers of a published checkpoint to those here, and leave out :data:`UNUSED` ones."""
    renamed = {}
    for name, value in state.items():
        key = name.removeprefix("module.")
        for published, name in RENAMED:
            key = key.replace(published, name)
        if not key.startswith(UNUSED):
            renamed[key] = value
    return renamed
