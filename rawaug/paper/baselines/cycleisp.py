r"""CycleISP: two networks of dual-attention blocks, ``y = mosaic(N_rgb2raw(x))`` and ``x = N_raw2rgb(pack(y), a(x'))``.

A dual-attention block adds to its input a 1 x 1 merge of two re-weighted copies of ``f = conv(prelu(conv(v)))``: one by
a map over space, sigmoid(conv([max_c f, mean_c f])), one by a weight a channel, sigmoid of two layers on f's mean. Five
blocks and a convolution make a recursive residual group, three groups a network of 96 features. RAW has no trace of how
its picture was coloured, so a colour branch ``a`` guides the way to sRGB: a blurred sRGB picture x' becomes a map
in (0, 1) that re-weights the features. Loss: ``|y - y^|_1 + |log y - log y^|_1`` to RAW, ``|x - x^|_1`` to sRGB.

Source: Zamir et al., "CycleISP: Real Image Restoration via Improved Data Synthesis", CVPR 2020; sizes that the text
leaves open (colour branch: two groups of two blocks; blur: 21 x 21, sigma 12) follow the published checkpoints.
"""

from __future__ import annotations

import os

import torch.nn.functional as F
from torch import Tensor, nn

from denoisers.cycleisp import Trunk, conv, load_published
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.paper.baselines.base import Crops, CropTrainedISP, checked_srgb
from rawaug.registry import BASELINES
from rawaug.seeding import derived_seed, initialised_from

BLUR_SIZE, BLUR_SIGMA = 21, 12.0
LOG_FLOOR = 1e-3
"""Below it the log loss is flat: at 12 bits it is four levels above black."""


class RGB2RAW(Trunk):
    """sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape."""

    def __init__(self, features: int, groups: int, blocks: int, reduction: int) -> None:
        super().__init__(3, features, groups, blocks, reduction)
        self.tail = nn.Sequential(conv(features, 3))

    def forward(self, srgb: Tensor) -> Tensor:
        return self.tail(self.body(self.head(srgb)))


class ColourBranch(Trunk):
    """A picture ``(B, 3, H, W)`` to weights of features in (0, 1), ``(B, features, H/2, W/2)``."""

    def __init__(self, features: int, reduction: int) -> None:
        super().__init__(3, features, groups=2, blocks=2, reduction=reduction)
        self.tail = nn.Sequential(conv(features, features), nn.Sigmoid())

    def forward(self, srgb: Tensor) -> Tensor:
        from kornia.filters import gaussian_blur2d

        if min(srgb.shape[-2:]) <= BLUR_SIZE // 2:
            sides = "x".join(map(str, srgb.shape[-2:]))
            raise ValueError(f"the colour branch needs sides larger than {BLUR_SIZE // 2} pixels, got {sides}")
        blurred = gaussian_blur2d(srgb, BLUR_SIZE, (BLUR_SIGMA, BLUR_SIGMA), border_type="reflect")
        return self.tail(self.body(F.max_pool2d(self.head(blurred), 2)))


class RAW2RGB(Trunk):
    """Packed RAW ``(B, 4, H/2, W/2)`` and the colour branch's weights to sRGB ``(B, 3, H, W)``."""

    def __init__(self, features: int, groups: int, blocks: int, reduction: int) -> None:
        super().__init__(4, features, groups, blocks, reduction)
        self.tail = nn.Sequential(conv(features, features), self.body[-1])
        self.tail_rgb = nn.Sequential(nn.Conv2d(features, 12, 1))

    def forward(self, packed: Tensor, colour: Tensor) -> Tensor:
        features = self.body[:-1](self.head(packed))
        features = self.body[-1](features + features * colour)
        return F.pixel_shuffle(self.tail_rgb(self.tail(features)), 2)


@BASELINES.register("cycleisp")
class CycleISP(CropTrainedISP):
    """CycleISP. To render RAW it needs a picture of the same scene whose colours it takes: ``model(raw, srgb)``.

    Args:
        cfa: pattern of the RAW; that of the published weights is RGGB.
        features, groups, blocks, reduction: size of the two networks.
        seed: of the initial weights.

    Example:
        >>> import torch
        >>> CycleISP(features=8, groups=1, blocks=1).cycle(torch.rand(1, 3, 12, 16)).shape
        torch.Size([1, 3, 12, 16])
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
        with initialised_from(derived_seed(seed, "baseline")):
            self.rgb2raw = RGB2RAW(features, groups, blocks, reduction)
            self.raw2rgb = RAW2RGB(features, groups, blocks, reduction)
            self.ccm = ColourBranch(features, reduction)

    @property
    def reverse_network(self) -> nn.Module:
        return self.rgb2raw

    def unprocess(self, srgb: Tensor, setting: None = None) -> Tensor:
        return self.rgb2raw(srgb)

    def render(self, raw: Tensor, setting: Tensor | None = None) -> Tensor:
        """As in the base class; the setting is an sRGB picture ``(B, 3, H, W)`` of the same scene, as published."""
        if setting is None:
            raise ValueError("cycleisp renders RAW in the colours of a picture: pass the sRGB of the same scene")
        srgb = checked_srgb(setting)
        if raw.shape[2:] != srgb.shape[2:]:
            raise ValueError(f"the picture {tuple(srgb.shape)} must have the sides of the mosaic {tuple(raw.shape)}")
        return self.raw2rgb(bayer.pack(raw, self.cfa), self.ccm(srgb))

    def cycle(self, srgb: Tensor) -> Tensor:
        return self.forward(self.reverse(srgb), srgb)

    def loss(self, crops: Crops) -> Tensor:
        """l1 and l1 of logarithms on the mosaic; l1 on sRGB made from the true RAW."""
        predicted = bayer.mosaic(self.unprocess(crops.srgb), self.cfa)
        log_predicted, log_raw = (image.clamp_min(LOG_FLOOR).log() for image in (predicted, crops.raw))
        reverse = F.l1_loss(predicted, crops.raw) + F.l1_loss(log_predicted, log_raw)
        return reverse + F.l1_loss(self.render(crops.raw, crops.srgb), crops.srgb)

    def load_published(self, path: str | os.PathLike[str], part: str = "rgb2raw") -> None:
        """Take the weights of a published checkpoint; nothing in it is run as code.

        Args:
            path: a file of ``torch.save({"state_dict": ...})``, keys with or without ``module.`` before them.
            part: the network that it holds: "rgb2raw", "raw2rgb" or "ccm" (the colour branch).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not such a file, its layers are not those of the part, or the part is unknown.
        """
        parts = ("rgb2raw", "raw2rgb", "ccm")
        if part not in parts:
            raise ValueError(f"part {part!r} is unknown; use one of {', '.join(parts)}")
        load_published(getattr(self, part), path, part)
