"""Pictures as datasets yield them, brought to one form: RGB, channels first, even sides, values untouched."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

_CHANNELS = (1, 3, 4)


def to_rgb_tensor(picture: Any) -> Tensor:
    """A tensor, NumPy array or PIL picture to ``(3, H, W)``, uint8 or float.

    Grey is repeated to three channels, an alpha channel is dropped, HWC becomes CHW (the axis of 1, 3 or 4 is taken for
    the channels, the last one first where both could be). Values are neither scaled nor clipped.

    Raises:
        ValueError: if the shape is not that of a picture, or the type neither uint8 nor floating point.
    """
    image = picture if isinstance(picture, Tensor) else torch.from_numpy(np.array(picture))
    if image.ndim == 2:
        image = image[None]
    if image.ndim != 3 or not (image.shape[0] in _CHANNELS or image.shape[2] in _CHANNELS):
        raise ValueError(f"a picture is (3, H, W), (H, W, 3), grey or RGBA, got shape {tuple(image.shape)}")
    if image.shape[2] in _CHANNELS and (image.shape[0] not in _CHANNELS or not isinstance(picture, Tensor)):
        image = image.permute(2, 0, 1)
    if image.dtype != torch.uint8 and not image.is_floating_point():
        raise ValueError(f"a picture is uint8, or float in [0, 1], got {image.dtype}; convert it first")
    return image.expand(3, -1, -1) if image.shape[0] == 1 else image[:3]


def even_sided(image: Tensor) -> Tensor:
    """``(..., H, W)`` without its last row or column where a side is odd: a Bayer cell is 2 x 2."""
    height, width = image.shape[-2:]
    return image[..., : height - height % 2, : width - width % 2]
