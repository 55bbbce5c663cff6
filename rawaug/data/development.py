"""RAW developed for the eye by one fixed pipeline: bilinear demosaic, the frame's white balance and colour matrix,
one exposure, the sRGB curve of IEC 61966-2-1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pair import Pair
from rawaug.io import encode_srgb


def develop_packed(packed: Tensor, cfa: CFA, pair: Pair, exposure: float = 1.0) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` to sRGB ``(3, H, W)`` in [0, 1] with the colours of ``pair``."""
    rgb = bayer.demosaic(bayer.unpack(packed, cfa), cfa)[0]
    balanced = rgb * exposure * torch.tensor(pair.white_balance)[:, None, None]
    linear = torch.einsum("ij,jhw->ihw", pair.color_matrix, balanced.clamp(max=1.0))
    return encode_srgb(linear.clamp(0.0, 1.0))


def exposure_of(packed: Tensor, pair: Pair) -> float:
    """The factor that brings the brightest percent of a clean frame to white."""
    green = packed[:, 1:3].flatten()
    stride = max(1, green.numel() // 1_000_000)
    return float(0.9 / torch.quantile(green[::stride], 0.99).clamp_min(1e-3)) / max(1.0, min(pair.white_balance))
