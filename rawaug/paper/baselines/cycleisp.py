r"""CycleISP: a network for each direction, ``y = mosaic(N_rgb2raw(x))`` and ``x = N_raw2rgb(pack(y), a(x'))``.

Either network has three groups of five dual-attention blocks (:mod:`denoisers.cycleisp`) of 96 features. RAW has no
trace of how its picture was coloured, so a colour branch a guides the way to sRGB: it turns a blurred sRGB picture x'
into a map in (0, 1) that re-weights the features.

The two networks are first trained separately, by ``|y - y^|_1 + |log y - log y^|_1`` and ``|x - x^|_1``, and then
together on the cycle: ``b L_raw + (1 - b) |x - N_raw2rgb(mosaic(N_rgb2raw(x)), a(x))|_1`` with b = 0.5 here.

Source: Zamir et al., "CycleISP: Real Image Restoration via Improved Data Synthesis", CVPR 2020. What its text leaves
open (the colour branch: two groups of two blocks; the blur: 21 x 21, sigma 12) follows the published checkpoints.
"""

from __future__ import annotations

import os

import torch.nn.functional as F
from torch import Tensor, nn

from denoisers.cycleisp import Trunk, load_part
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.functional import as_float
from rawaug.paper.baselines.base import BASELINES, Crops, CropTrainedISP
from rawaug.seeding import derive_seed, initialise_from

LOG_FLOOR = 1e-3
"""The log loss is flat below this value, which is four levels above black at 12 bits."""
BLUR_SIZE, BLUR_SIGMA = 21, 12.0
"""The picture that gives the colours is blurred with this side in pixels and standard deviation."""
APART = 0.75
"""The two networks are trained separately for this share of the training, and then on the cycle."""
RAW_SHARE = 0.5
"""In the loss on the cycle, the error of the RAW has this weight; the picture that comes back has the rest."""


class RGB2RAW(Trunk):
    """The network from sRGB to linear camera colour.

    Args:
        features: channels of all layers but the first.
        groups: number of residual groups.
        blocks: dual-attention blocks of each group.
        reduction: factor by which channel attention narrows the features.
    """

    def __init__(self, features: int, groups: int, blocks: int, reduction: int) -> None:
        super().__init__(3, features, groups, blocks, reduction)
        self.tail = nn.Sequential(nn.Conv2d(features, 3, 3, padding=1))

    def forward(self, srgb: Tensor) -> Tensor:
        """Map ``(B, 3, H, W)`` to ``(B, 3, H, W)``."""
        return self.tail(self.body(self.head(srgb)))


class RAW2RGB(Trunk):
    """The network from packed RAW and the colour branch's map to sRGB; the arguments are those of :class:`RGB2RAW`."""

    def __init__(self, features: int, groups: int, blocks: int, reduction: int) -> None:
        super().__init__(4, features, groups, blocks, reduction)
        shared_act = self.body[-1]
        self.tail = nn.Sequential(nn.Conv2d(features, features, 3, padding=1), shared_act)
        self.tail_rgb = nn.Sequential(nn.Conv2d(features, 12, 1))

    def forward(self, packed: Tensor, colour: Tensor) -> Tensor:
        """Render RAW ``(B, 4, H/2, W/2)`` and the map ``(B, features, H/2, W/2)`` to sRGB ``(B, 3, H, W)``."""
        features = self.body[:-1](self.head(packed))
        guided = self.body[-1](features + features * colour)
        return F.pixel_shuffle(self.tail_rgb(self.tail(guided)), 2)


class ColourBranch(Trunk):
    """The branch that guides the way to sRGB by the colours of a picture."""

    def __init__(self, features: int, reduction: int) -> None:
        super().__init__(3, features, groups=2, blocks=2, reduction=reduction)
        self.tail = nn.Sequential(nn.Conv2d(features, features, 3, padding=1), nn.Sigmoid())

    def forward(self, srgb: Tensor) -> Tensor:
        """Turn a picture ``(B, 3, H, W)`` to weights of features in (0, 1), ``(B, features, H/2, W/2)``."""
        from kornia.filters import gaussian_blur2d

        height, width = srgb.shape[-2:]
        if min(height, width) <= BLUR_SIZE // 2:
            raise ValueError(
                f"the colour branch needs sides larger than {BLUR_SIZE // 2} pixels, got {height} x {width}"
            )

        blurred = gaussian_blur2d(srgb, BLUR_SIZE, (BLUR_SIGMA, BLUR_SIGMA), border_type="reflect")
        halved = F.max_pool2d(self.head(blurred), 2)
        return self.tail(self.body(halved))


@BASELINES.register("cycleisp")
class CycleISP(CropTrainedISP):
    """CycleISP. To render RAW, it takes the colours of a picture of the same scene: ``model(raw, srgb)``.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
        features: in every layer.
        groups: of dual-attention blocks, in each network.
        blocks: in each group.
        reduction: of the features in channel attention.
        both: whether the way to sRGB and the cycle are also trained; otherwise only the way to RAW is, in a third of
            the time.
        seed: decides the initial weights.
    """

    name = "cycleisp"
    renders = True
    learning_rate = 3e-4

    def __init__(
        self,
        cfa: CFA | str = "RGGB",
        features: int = 96,
        groups: int = 3,
        blocks: int = 5,
        reduction: int = 8,
        both: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__(cfa)
        self.both = both

        with initialise_from(derive_seed(seed, "baseline")):
            self.reverse_network = RGB2RAW(features, groups, blocks, reduction)
            for layer in self.reverse_network.modules():  # a trunk's layers draw nothing when they are made
                if isinstance(layer, nn.Conv2d):
                    nn.Conv2d.reset_parameters(layer)

        with initialise_from(derive_seed(seed, "baseline, the other way")):
            self.raw2rgb = RAW2RGB(features, groups, blocks, reduction)
            self.colour_branch = ColourBranch(features, reduction)
            for layer in (*self.raw2rgb.modules(), *self.colour_branch.modules()):
                if isinstance(layer, nn.Conv2d):
                    nn.Conv2d.reset_parameters(layer)

        self.raw2rgb.requires_grad_(both)
        self.colour_branch.requires_grad_(both)

    def render(self, raw: Tensor, setting: Tensor | None = None) -> Tensor:
        """Render a mosaic ``(B, 1, H, W)`` as sRGB ``(B, 3, H, W)``; the setting is an sRGB picture of the scene."""
        if setting is None:
            raise ValueError("cycleisp renders RAW in the colours of a picture: pass the sRGB of the same scene")
        if not self.both:
            raise ValueError("this cycleisp was trained from sRGB to RAW alone; build it with both=True")

        colour = self.colour_branch(as_float(setting))
        return self.raw2rgb(bayer.pack(raw, self.cfa), colour)

    def cycle(self, srgb: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to RAW and back, in its own colours."""
        return self.forward(self.reverse(srgb), srgb)

    def loss(self, crops: Crops, share_done: float = 1.0) -> Tensor:
        """Compute the error of RAW and picture, first of each network alone and then over the cycle, a scalar."""
        predicted = bayer.mosaic(self.unprocess(crops.srgb), self.cfa)
        raw_error = self.raw_error(predicted, crops.raw)
        if not self.both:
            return raw_error

        if share_done < APART:
            return raw_error + F.l1_loss(self.render(crops.raw, crops.srgb), crops.srgb)

        returned = self.render(predicted, crops.srgb)
        return RAW_SHARE * raw_error + (1.0 - RAW_SHARE) * F.l1_loss(returned, crops.srgb)

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """Compute the l1 error of mosaics ``(B, 1, H, W)`` and of their logarithms, a scalar."""
        log_predicted = predicted.clamp_min(LOG_FLOOR).log()
        log_raw = raw.clamp_min(LOG_FLOOR).log()
        return F.l1_loss(predicted, raw) + F.l1_loss(log_predicted, log_raw)

    def load_published(self, path: str | os.PathLike[str], part: str = "rgb2raw") -> None:
        """Take the RGGB weights of a published checkpoint.

        Nothing in the file is run as code; errors are those of :func:`denoisers.cycleisp.load_part`.

        Args:
            path: path of the checkpoint.
            part: the part whose weights these are: "rgb2raw", "raw2rgb" or "ccm", which is the colour branch.
        """
        networks = {"rgb2raw": self.reverse_network, "raw2rgb": self.raw2rgb, "ccm": self.colour_branch}
        if part not in networks:
            raise ValueError(f"part must be one of {', '.join(networks)}, got {part!r}")
        load_part(networks[part], path, part)
