r"""Invertible greyscale, with RAW hidden in the picture: ``x = E(r)``, ``r = D(x)``.

Xia et al. hide a colour picture in a grey one by an encoder E, from which a decoder D restores it. In InvISP's
comparison, the hidden picture is the RAW and the visible one is the sRGB; r is RAW as InvISP prepares it
(:mod:`rawaug.paper.baselines.invisp`). E is a residual encoder-decoder of 64, 128 and 256 features with 2, 4 and 2
residual blocks, strides of 2 down, nearest neighbours up, and the finer features added; D has 64 features and 8
residual blocks, then 256 features and a 1 x 1 convolution.

Loss: ``|E(r) - x|_1`` for the picture, ``|D(E(r)) - r|_1`` for what is hidden in it, and ``|D(x) - r|_1``, since here
RAW is also made of a camera's own picture. Two things differ from the source and are assumptions: outputs are linear,
since the published tanh is flat where most of RAW is, and errors are l1, as for the other methods.

Source: Xia et al., "Invertible Grayscale", ACM TOG 37(6), 2018; Xing et al., CVPR 2021.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from denoisers.layers import pad_to_multiple
from rawaug.bayer import CFA
from rawaug.paper.baselines.base import BASELINES, Crops
from rawaug.paper.baselines.invisp import CompressedISP
from rawaug.seeding import derive_seed, initialise_from


def conv3x3(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    """Make a 3 x 3 convolution that keeps the size at a stride of 1."""
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)


class GreyBlock(nn.Module):
    """``x + conv(relu(conv(x)))`` of features ``(B, C, H, W)``."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(conv3x3(features, features), nn.ReLU(), conv3x3(features, features))

    def forward(self, x: Tensor) -> Tensor:
        """Map features ``(B, C, H, W)`` to features of the same shape."""
        return x + self.layers(x)


def residual_blocks(features: int, count: int) -> nn.Sequential:
    """Make ``count`` residual blocks in a row."""
    return nn.Sequential(*[GreyBlock(features) for _ in range(count)])


def scale_change(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    """Make layers that change the size and the number of features."""
    return nn.Sequential(conv3x3(inputs, outputs, stride), conv3x3(outputs, outputs), nn.ReLU())


class Encoder(nn.Module):
    """E, with ``features``, twice as many and four times as many in its three scales."""

    def __init__(self, features: int) -> None:
        super().__init__()
        fine, middle, coarse = features, 2 * features, 4 * features
        self.first = nn.Sequential(conv3x3(3, fine), residual_blocks(fine, 2))
        self.to_middle = scale_change(fine, middle, stride=2)
        self.to_coarse = scale_change(middle, coarse, stride=2)
        self.centre = residual_blocks(coarse, 4)
        self.back_to_middle = scale_change(coarse, middle, stride=1)
        self.back_to_fine = scale_change(middle, fine, stride=1)
        self.last = nn.Sequential(residual_blocks(fine, 2), conv3x3(fine, 3))

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` to ``(B, 3, H, W)``; sides are padded to multiples of 4 inside."""
        height, width = x.shape[-2:]
        fine = self.first(pad_to_multiple(x, 4))
        middle = self.to_middle(fine)
        coarse = self.centre(self.to_coarse(middle))

        doubled = F.interpolate(coarse, scale_factor=2.0, mode="nearest")
        middle = self.back_to_middle(doubled) + middle
        doubled = F.interpolate(middle, scale_factor=2.0, mode="nearest")
        fine = self.back_to_fine(doubled) + fine
        return self.last(fine)[..., :height, :width]


@BASELINES.register("invgrey")
class InvertibleGrey(CompressedISP):
    """The invertible-greyscale networks, one for each direction.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
        features: in the finest scale of either direction.
        blocks: number of residual blocks of the decoder, from sRGB to RAW.
        seed: decides the initial weights.
    """

    name = "invgrey"
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", features: int = 64, blocks: int = 8, seed: int = 0) -> None:
        super().__init__(cfa)
        with initialise_from(derive_seed(seed, "baseline")):
            self.encoder = Encoder(features)
            self.reverse_network = nn.Sequential(
                conv3x3(3, features),
                residual_blocks(features, blocks),
                conv3x3(features, 4 * features),
                nn.ReLU(),
                nn.Conv2d(4 * features, 3, 1),
            )

    def from_picture(self, srgb: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to balanced, compressed colour of the same shape, by the decoder."""
        compressed: Tensor = self.reverse_network(srgb)
        return compressed

    def to_picture(self, compressed: Tensor) -> Tensor:
        """Balanced, compressed colour ``(B, 3, H, W)`` to sRGB of the same shape, by the encoder."""
        picture: Tensor = self.encoder(compressed)
        return picture

    def loss(self, crops: Crops, share_done: float = 1.0) -> Tensor:
        """Compute l1 of the picture, of what is hidden in it and of RAW from the camera's picture, a scalar."""
        compressed = self.compress(crops.raw, crops.white_balance)
        rendered = self.to_picture(compressed)
        hidden = self.from_picture(rendered)
        recovered = self.from_picture(crops.srgb)

        conformity = F.l1_loss(rendered, crops.srgb)
        invertibility = F.l1_loss(hidden, compressed)
        return conformity + invertibility + F.l1_loss(recovered, compressed)
