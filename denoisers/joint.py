r"""Demosaicing and denoising at once: ``rgb = D(noisy) + residual``, of twice the sides of packed RAW.

Domain: packed RAW ``(B, 4, h, w)``, R, Gr, Gb, B of an RGGB mosaic, to linear camera RGB ``(B, 3, 2h, 2w)``. D is
Malvar, He and Cutler's linear interpolation (ICASSP 2004) of the transformed signal, whose noise is white. With one
stencil for each colour and each site of a cell, it is a convolution of stride 2. The idea of one network for both is
from Gharbi et al., "Deep Joint Demosaicking and Denoising", SIGGRAPH Asia 2016.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.drunet import ResidualBlock, ResidualUNet, Size
from denoisers.layers import PACKED, conv, require_bounded
from denoisers.network import DENOISERS
from rawaug.bayer import CFA, demosaicing_stencils

RGB = 3
REACH = 2
"""D sees this many pixels on each side of its own."""


@DENOISERS.register("JointDRUNet")
class JointDRUNet(ResidualUNet):
    """:class:`denoisers.DRUNet` with a head for full colour: ``D(noisy + tail(x)) + detail(x)``.

    Its features x give two things: a correction of packed RAW, as in DRUNet, which D turns into full colour; and what D
    cannot know, as twelve planes that a pixel shuffle puts in place. The last layer of either starts at zero, so that
    an untrained network is D, and one that starts from a DRUNet's weights is that network followed by D.

    Args:
        width, scales, blocks, limits, mend, domain, seed: see :class:`denoisers.DRUNet`.
        refine: residual blocks before the twelve planes, at most 1000.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> JointDRUNet(width=4)(noisy, torch.full_like(noisy, 1e-4)).shape
        torch.Size([2, 3, 66, 100])
    """

    upscale: ClassVar[int] = 2

    def __init__(
        self,
        width: int = 32,
        scales: int = 4,
        blocks: int = 1,
        limits: bool = True,
        mend: bool = True,
        refine: int = 1,
        domain: str = "anscombe",
        seed: int = 0,
    ) -> None:
        require_bounded(refine=refine)
        size = Size(width, scales, blocks)
        super().__init__({"refine": refine}, size, limits, mend, variance_map=False, domain=domain, seed=seed)
        self.light = not self.reads_variance

        self.add_layers(self.inputs + self.light * PACKED, PACKED, PACKED)
        self.refine = nn.Sequential(*[ResidualBlock(width) for _ in range(refine)])
        self.detail = conv(width, RGB * PACKED, bias=False)
        self.register_buffer("stencils", _stencils(), persistent=False)
        self.initialise(self.seed, self.tail, self.detail, *self.block_ends(), gain=1.0)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction of full colour ``(B, 3, 2h, 2w)`` from features ``(B, inputs, h, w)``."""
        x = self.body(features)
        detail = F.pixel_shuffle(self.detail(self.refine(x)), 2)
        return self.base_image(self.tail(x)) + detail

    def base_image(self, packed: Tensor) -> Tensor:
        """Demosaic packed RAW ``(B, 4, h, w)`` by D to ``(B, 3, 2h, 2w)``, as :func:`rawaug.bayer.demosaic` does."""
        with _full_precision(packed.device.type):
            stencils = self.get_buffer("stencils")
            mosaic = F.pixel_shuffle(packed.to(stencils), 2)
            padded = F.pad(mosaic, (REACH,) * 4, mode="reflect")  # about the border sites, so the pattern stays
            return F.pixel_shuffle(F.conv2d(padded, stencils, stride=2), 2)


def _full_precision(device: str) -> AbstractContextManager[object]:
    """Switch autocast off, since in bfloat16 the signal would lose the digits that hold its noise."""
    if torch.is_autocast_enabled(device):
        return torch.autocast(device, enabled=False)
    return nullcontext()


def _stencils() -> Tensor:
    """Lay out the weights of D over a cell and its neighbours, for each colour and site: ``(12, 1, 6, 6)``."""
    interpolating, kinds = demosaicing_stencils(CFA.RGGB, "malvar")
    side = 2 * REACH + 1
    copying = torch.zeros(1, side, side, device="cpu")
    copying[0, REACH, REACH] = 1.0
    by_kind = torch.cat([copying, interpolating])

    stencils = torch.zeros(RGB, 2, 2, side + 1, side + 1, device="cpu")
    for colour, rows in enumerate(kinds):
        for i, row in enumerate(rows):
            for j, kind in enumerate(row):
                stencils[colour, i, j, i : i + side, j : j + side] = by_kind[kind]
    return stencils.flatten(0, 2)[:, None]
