r"""A plain U-Net from sRGB to RAW: ``y = mosaic(x + U(x))``, trained end to end with l1 and no model of a camera.

The published size is 11.77 M parameters. That is UPI's U-Net with three channels in and out (five scales of three
convolutions, 32 to 512 features, bilinear interpolation up: 11,774,979 parameters), so the one in
:mod:`denoisers.unet` is used. Domain: sRGB in [0, 1]; any even sides.

Source: Ronneberger et al., MICCAI 2015, and the baseline of Conde et al., AAAI 2022; that their U-Net is this one is
concluded from the number of parameters.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from denoisers.unet import PUBLISHED_WIDTH, UNet
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.baselines.base import Crops, CropTrainedISP
from rawaug.registry import BASELINES


@BASELINES.register("unet")
class UNetISP(CropTrainedISP):
    """The U-Net baseline; it has no forward pass.

    Args:
        cfa: pattern of the RAW.
        width: features of the first scale.
        seed: of the initial weights.

    Example:
        >>> import torch
        >>> UNetISP(width=4).reverse(torch.rand(1, 3, 10, 22)).shape
        torch.Size([1, 1, 10, 22])
    """

    name = "unet"
    bidirectional = False
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", width: int = PUBLISHED_WIDTH, seed: int = 0) -> None:
        super().__init__(cfa)
        self.network = UNet(width, channels=3, variance_map=False, seed=seed)

    def unprocess(self, srgb: Tensor) -> Tensor:
        return self.network(srgb)

    def loss(self, crops: Crops, both: bool) -> Tensor:
        """l1 on the mosaic; there is no other direction."""
        return F.l1_loss(bayer.mosaic(self.unprocess(crops.srgb), self.cfa), crops.raw)
