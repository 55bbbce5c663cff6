r"""Demosaicing by gradient-corrected linear interpolation.

    c^(i, j) = bilinear c(i, j) + alpha_c Laplacian of the colour known at (i, j),    alpha = 1/2, 5/8, 3/4

as 5 x 5 kernels: the missing colour follows its neighbours, corrected by how the known colour bends there.
Source: H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned color
images", ICASSP 2004.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA

_GREEN_AT_RED_OR_BLUE = (
    (0, 0, -1, 0, 0),
    (0, 0, 2, 0, 0),
    (-1, 2, 4, 2, -1),
    (0, 0, 2, 0, 0),
    (0, 0, -1, 0, 0),
)
_AT_GREEN_ALONG_ROW = (
    (0, 0, 0.5, 0, 0),
    (0, -1, 0, -1, 0),
    (-1, 4, 5, 4, -1),
    (0, -1, 0, -1, 0),
    (0, 0, 0.5, 0, 0),
)
_RED_AT_BLUE = (
    (0, 0, -1.5, 0, 0),
    (0, 2, 0, 2, 0),
    (-1.5, 0, 6, 0, -1.5),
    (0, 2, 0, 2, 0),
    (0, 0, -1.5, 0, 0),
)


def demosaic_malvar(raw: Tensor, cfa: CFA | str) -> Tensor:
    """Mosaic ``(1, H, W)`` to ``(3, H, W)``, float32, sides even and at least 4; sites keep their own colour."""
    along_row = torch.tensor(_AT_GREEN_ALONG_ROW)
    kernels = torch.stack([torch.tensor(_GREEN_AT_RED_OR_BLUE), along_row, along_row.T, torch.tensor(_RED_AT_BLUE)])
    # reflection about the border sites keeps the pattern
    padded = F.pad(raw[None], (2, 2, 2, 2), mode="reflect")
    green, row, column, opposite = F.conv2d(padded, kernels[:, None].to(raw) / 8)[0]
    known = raw[0]
    colours_at = {  # (R, G, B) at the sites R, Gr, Gb, B
        0: (known, green, opposite),
        1: (row, known, column),
        2: (column, known, row),
        3: (opposite, green, known),
    }
    rgb = raw.new_empty(3, *raw.shape[-2:])
    for site, (i, j) in enumerate(CFA(cfa).sites):
        for channel, plane in enumerate(colours_at[site]):
            rgb[channel, i::2, j::2] = plane[i::2, j::2]
    return rgb
