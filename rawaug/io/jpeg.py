"""A picture as a JPEG file gives it back: 8 x 8 cosine transform, colour at half the width (4:2:2), one quality."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import torch
from torch import Tensor

from rawaug.extras import extra

_HALF_WIDTH = 1
"""Pillow's number of 4:2:2."""


def through_jpeg(srgb: Tensor, quality: int) -> Tensor:
    """sRGB ``(3, H, W)`` uint8, encoded at ``quality`` (1 to 100) and decoded again.

    Raises:
        ValueError: if the picture is of another kind, or the quality out of range.

    Example:
        >>> picture = torch.full((3, 16, 16), 128, dtype=torch.uint8)
        >>> bool((through_jpeg(picture, 90) == picture).all())
        True
    """
    with extra("raw"):
        from PIL import Image

    if srgb.ndim != 3 or srgb.shape[0] != 3 or srgb.dtype != torch.uint8:
        raise ValueError(f"a picture must be uint8 (3, H, W), got {srgb.dtype} {tuple(srgb.shape)}")
    if not 1 <= quality <= 100:
        raise ValueError(f"quality must be 1 to 100, got {quality}")
    stored = BytesIO()
    picture = Image.fromarray(srgb.permute(1, 2, 0).contiguous().numpy())
    picture.save(stored, "JPEG", quality=quality, subsampling=_HALF_WIDTH)
    return torch.from_numpy(np.array(Image.open(stored))).permute(2, 0, 1).contiguous()
