r"""The networks: a plain U-Net and CycleISP.

*The U-Net*, ``y = mosaic(x + U(x))``, is trained end to end with l1. The published size is 11.77 M parameters. That is
UPI's U-Net with three channels in and out (five scales of three convolutions, 32 to 512 features, bilinear
interpolation up: 11,774,979 parameters), so the one in :mod:`denoisers.networks` is used. That the paper's U-Net is
this one is concluded from the number of parameters. Source: Ronneberger et al., MICCAI 2015; Conde et al., AAAI 2022.

*CycleISP*, ``y = mosaic(N_rgb2raw(x))``: three groups of five dual-attention blocks (:mod:`denoisers.published`) of 96
features. Its other network, from RAW to sRGB, shares no weight with this one and is left out. Loss: ``|y - y^|_1 + |log
y - log y^|_1``. Source: Zamir et al., CVPR 2020, and the published checkpoints.
"""

from __future__ import annotations

import os

import torch.nn.functional as F
from torch import Tensor, nn

from denoisers import published
from denoisers.networks import PUBLISHED_WIDTH, UNet
from rawaug.bayer import CFA
from rawaug.paper.baselines.base import CropTrainedISP
from rawaug.registry import BASELINES
from rawaug.seeding import derive_seed, initialise_from

LOG_FLOOR = 1e-3
"""The value below which CycleISP's log loss is flat: at 12 bits it is four levels above black."""


@BASELINES.register("unet")
class UNetISP(CropTrainedISP):
    """The U-Net.

    Args:
        cfa: the pattern of the RAW that it makes.
        width: number of features in the first scale.
        seed: decides the initial weights.
    """

    name = "unet"
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", width: int = PUBLISHED_WIDTH, seed: int = 0) -> None:
        super().__init__(cfa)
        self.reverse_network = UNet(width, channels=3, variance_map=False, seed=seed)


# -- CycleISP ---------------------------------------------------------------------------------------------------------


class RGB2RAW(published.Trunk):
    """The network from sRGB to linear camera colour, with the ``sizes`` features, groups, blocks and reduction."""

    def __init__(self, *sizes: int) -> None:
        super().__init__(3, *sizes)
        self.tail = nn.Sequential(nn.Conv2d(sizes[0], 3, 3, padding=1))

    def forward(self, srgb: Tensor) -> Tensor:
        """``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        return self.tail(self.body(self.head(srgb)))


@BASELINES.register("cycleisp")
class CycleISP(CropTrainedISP):
    """CycleISP's network from sRGB to RAW.

    Args:
        cfa: the pattern of the RAW that it makes.
        features: in every layer.
        groups: of dual-attention blocks.
        blocks: in each group.
        reduction: of the features in channel attention.
        seed: decides the initial weights.
    """

    name = "cycleisp"
    learning_rate = 3e-4

    def __init__(
        self,
        cfa: CFA | str = "RGGB",
        features: int = 96,
        groups: int = 3,
        blocks: int = 5,
        reduction: int = 8,
        seed: int = 0,
    ) -> None:
        super().__init__(cfa)
        with initialise_from(derive_seed(seed, "baseline")):
            self.reverse_network = RGB2RAW(features, groups, blocks, reduction)
            for layer in self.modules():  # a trunk leaves its weights as they are in memory
                if isinstance(layer, nn.Conv2d):
                    layer.reset_parameters()

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """l1 of mosaics ``(B, 1, H, W)`` and of their logarithms, a scalar."""
        log_predicted, log_raw = (image.clamp_min(LOG_FLOOR).log() for image in (predicted, raw))
        return F.l1_loss(predicted, raw) + F.l1_loss(log_predicted, log_raw)

    def load_published(self, path: str | os.PathLike[str]) -> None:
        """Take the RGGB weights of a published checkpoint, as :func:`denoisers.published.load_published` does."""
        published.load_published(self.reverse_network, path, "rgb2raw")
