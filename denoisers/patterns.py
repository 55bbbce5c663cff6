"""Packed RAW of one Bayer pattern for a network that was trained for another.

The mosaic is extended by a mirrored line on the sides where the patterns differ, and the result is cropped.
"""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional as F

from denoisers.network import PACKED
from rawaug import bayer
from rawaug.bayer import CFA, crop_to_cfa


def extend_to_pattern(packed: Tensor, cfa: CFA, target: CFA) -> Tensor:
    """Extend packed RAW ``(B, 4, h, w)`` of the pattern ``cfa`` to the pattern ``target``."""
    if target == cfa:
        return packed
    rows, columns = cfa.shift_to(target)
    mosaic = F.pad(bayer.unpack(packed, cfa), (columns, columns, rows, rows), mode="reflect")
    return bayer.pack(mosaic, target)


def crop_to_pattern(image: Tensor, target: CFA, cfa: CFA) -> Tensor:
    """Crop the lines that :func:`extend_to_pattern` added: packed RAW comes back as ``cfa``, full colour as it is."""
    if target == cfa:
        return image
    if image.shape[1] != PACKED:
        return crop_to_cfa(image, target, cfa)

    mosaic = crop_to_cfa(bayer.unpack(image, target), target, cfa)
    return bayer.pack(mosaic, cfa)
