r"""Two networks without a model of a camera: a plain U-Net, and the invertible-greyscale network.

*The U-Net*, ``y = mosaic(x + U(x))``, is trained end to end with l1. The published size is 11.77 M parameters. That is
UPI's U-Net with three channels in and out (five scales of three convolutions, 32 to 512 features, bilinear
interpolation up: 11,774,979 parameters), so the one in :mod:`denoisers.networks` is used. That the paper's U-Net is
this one is concluded from the number of parameters. Source: Ronneberger et al., MICCAI 2015; Conde et al., AAAI 2022.

*Invertible greyscale*, ``x = E(demosaic(y))``, ``y = mosaic(D(x))``: Xia et al. hide a colour picture in a grey one by
an encoder E and restore it by a decoder D, trained together with the grey picture's likeness as a condition. In
InvISP's comparison the hidden picture is the RAW and the visible one the sRGB, so E renders RAW and D goes back. E is a
residual encoder-decoder: 3 x 3 convolutions to 64 features, 2 residual blocks, down to 128 and 256 features by strides
of 2, 4 residual blocks, up by nearest neighbours with the finer features added, 2 residual blocks. D has 64 features
throughout and 8 residual blocks, then 256 features, then a 1 x 1 convolution. Two things differ here, and are
assumptions: the outputs are linear, since most of RAW is near black, where the published tanh is flat; and the losses
are l1 of the two directions on the pairs, as for InvISP, since there is no grey picture to resemble. Source: Xia et
al., "Invertible Grayscale", ACM TOG 37(6), 2018; Xing et al., CVPR 2021, for the use on RAW.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor, nn

from denoisers.network import pad_to_multiple
from denoisers.networks import PUBLISHED_WIDTH, UNet
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.paper.baselines.base import Crops, CropTrainedISP
from rawaug.registry import BASELINES
from rawaug.seeding import derived_seed, initialised_from


@BASELINES.register("unet")
class UNetISP(CropTrainedISP):
    """The U-Net baseline, ``width`` features in its first scale; it has no forward pass.

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

    def unprocess(self, srgb: Tensor, setting: None = None) -> Tensor:
        return self.network(srgb)

    def loss(self, crops: Crops) -> Tensor:
        """l1 on the mosaic; there is no other direction."""
        return F.l1_loss(bayer.mosaic(self.unprocess(crops.srgb), self.cfa), crops.raw)


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1)


class ResidualBlock(nn.Module):
    """``x + conv(relu(conv(x)))``."""

    def __init__(self, features: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(_conv(features, features), nn.ReLU(), _conv(features, features))

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)


def _blocks(features: int, count: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualBlock(features) for _ in range(count)))


def _scale(inputs: int, outputs: int, stride: int) -> nn.Sequential:
    """A change of size and of the number of features."""
    return nn.Sequential(_conv(inputs, outputs, stride), _conv(outputs, outputs), nn.ReLU())


class Encoder(nn.Module):
    """E, RAW to sRGB; sides are padded to multiples of 4 inside."""

    def __init__(self, features: int) -> None:
        super().__init__()
        fine, middle, coarse = features, 2 * features, 4 * features
        self.first = nn.Sequential(_conv(3, fine), _blocks(fine, 2))
        self.down = nn.ModuleList([_scale(fine, middle, 2), _scale(middle, coarse, 2)])
        self.centre = _blocks(coarse, 4)
        self.up = nn.ModuleList([_scale(coarse, middle, 1), _scale(middle, fine, 1)])
        self.last = nn.Sequential(_blocks(fine, 2), _conv(fine, 3))

    def forward(self, x: Tensor) -> Tensor:
        fine = self.first(pad_to_multiple(x, 4))
        middle = self.down[0](fine)
        features = self.centre(self.down[1](middle))
        for up, skip in zip(self.up, (middle, fine), strict=True):
            features = up(F.interpolate(features, scale_factor=2.0, mode="nearest")) + skip
        return self.last(features)[..., : x.shape[-2], : x.shape[-1]]


def decoder(features: int, blocks: int) -> nn.Sequential:
    """D, sRGB to RAW."""
    last = nn.Conv2d(4 * features, 3, 1)
    return nn.Sequential(_conv(3, features), _blocks(features, blocks), _conv(features, 4 * features), last)


@BASELINES.register("invgrey")
class InvertibleGrey(CropTrainedISP):
    """The invertible-greyscale network, one network a direction; ``blocks`` are the residual ones of the way back."""

    name = "invgrey"
    learning_rate = 1e-3

    def __init__(self, cfa: CFA | str = "RGGB", features: int = 64, blocks: int = 8, seed: int = 0) -> None:
        super().__init__(cfa)
        with initialised_from(derived_seed(seed, "baseline")):
            self.encoder = Encoder(features)
            self.decoder = decoder(features, blocks)

    @property
    def reverse_network(self) -> nn.Module:
        return self.decoder

    def unprocess(self, srgb: Tensor, setting: None = None) -> Tensor:
        return self.decoder(srgb)

    def render(self, raw: Tensor, setting: None = None) -> Tensor:
        return self.encoder(bayer.demosaic(raw, self.cfa))

    def loss(self, crops: Crops) -> Tensor:
        """l1 on the mosaic, and on sRGB."""
        reverse = F.l1_loss(bayer.mosaic(self.unprocess(crops.srgb), self.cfa), crops.raw)
        return reverse + F.l1_loss(self.render(crops.raw), crops.srgb)
