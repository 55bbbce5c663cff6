"""The reverse pass of an ISP with reordered stages, which cannot be baked into a table.

Stage by stage as the ISP does it, with the calls of :class:`rawaug.isp.fast.BakedISP`; dozens of times slower.
"""

from __future__ import annotations

import math
from copy import deepcopy

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.isp.fast import BakedISP, bakeable, require_batch
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams
from rawaug.isp.stages import as_float
from rawaug.kernels.raw_torch import frame_of


class UnbakedISP(nn.Module):
    """The reverse pass of an ISP as it is now; arguments, results and errors are those of ``BakedISP``."""

    def __init__(self, isp: DictionaryISP) -> None:
        super().__init__()
        self.isp = deepcopy(isp)

    @torch.no_grad()
    def choose(self, srgb: Tensor) -> ISPParams:
        """The setting that the encoders (or their constants) choose."""
        return self.isp.choose(srgb)

    @torch.no_grad()
    def forward(self, srgb: Tensor, params: ISPParams, place: Tensor | None = None, white: float = math.inf) -> Tensor:
        """sRGB to clean packed RAW."""
        return bayer.pack_rgb(self.colours(srgb, params, place, white), self.isp.cfa)

    @torch.no_grad()
    def colours(self, srgb: Tensor, params: ISPParams, place: Tensor | None = None, white: float = math.inf) -> Tensor:
        """RAW of all three colours at every site, ``(B, 3, H, W)``."""
        require_batch(srgb, params, place)
        x5 = self.isp.reverse_pixels(as_float(srgb), params, None if place is None else _coordinates(srgb, place))
        return x5.clamp(max=white)


def reverse_pass(isp: DictionaryISP) -> BakedISP | UnbakedISP:
    """The fastest form that the ISP's stages allow.

    Example:
        >>> from rawaug.isp.config import ISPConfig
        >>> type(reverse_pass(DictionaryISP(ISPConfig(stages=("gamma", "gains", "colour"))))).__name__
        'UnbakedISP'
    """
    return BakedISP(isp) if bakeable(isp.ordered_stages) else UnbakedISP(isp)


def _coordinates(srgb: Tensor, place: Tensor) -> Tensor:
    """Of the pixels of turned crops in their full frames, ``(B, 2, H, W)``."""
    height, width = srgb.shape[-2:]
    corners = [frame_of(p, height, width, (0.0, 0.0)) for p in place.tolist()]
    frames = torch.tensor(corners, device=srgb.device, dtype=torch.float32)
    start, down, right = frames.reshape(-1, 3, 2, 1, 1).unbind(1)
    rows = torch.arange(height, device=srgb.device)[:, None]
    return start + down * rows + right * torch.arange(width, device=srgb.device)
