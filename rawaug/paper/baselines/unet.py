r"""The plain U-Net, ``y = mosaic(x + U(x))``, trained end to end with l1.

The published size is 11.77 M parameters. UPI's U-Net has this size with three channels in and out (five scales of three
convolutions, 32 to 512 features, bilinear interpolation up: 11,774,979 parameters), so the one in :mod:`denoisers.unet`
is used. It is taken for the paper's U-Net because of the number of parameters. Source: Ronneberger et al., MICCAI 2015;
Conde et al., AAAI 2022.
"""

from __future__ import annotations

from denoisers.unet import PUBLISHED_WIDTH, UNet
from rawaug.bayer import CFA
from rawaug.paper.baselines.base import BASELINES, CropTrainedISP


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
