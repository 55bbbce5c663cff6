"""The sRGB pictures of SIDD's blocks, as the sensor saw them.

``ValidationGtBlocksSrgb.mat`` and its like hold uint8 (40 scene instances, 32 blocks, rows, columns, RGB). SIDD turns
its pictures upright and not its mosaics, and the block files do not say how: of the eight turns, a frame's blocks take
the one in which their green agrees best with the green of the mosaics.
"""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.mat import read_array

LEAST_LIKENESS = 0.8
"""Correlation of the greens below which pictures do not show the blocks of the mosaics."""


def read_block_pictures(file: Path, blocks: tuple[int, ...], side: tuple[int, int]) -> Tensor:
    """Pictures uint8 ``(*blocks, 3, H, W)`` of the array that is named after its file.

    Raises:
        FileNotFoundError, OSError: as :func:`rawaug.data.mat.read_array`.
        ValueError: if they are not uint8, or of another number or size than the mosaics.
    """
    array = read_array(file, file.stem)
    if array.dtype.name != "uint8" or array.shape != (*blocks, *side, 3):
        raise ValueError(f"{file}: holds {array.dtype} {array.shape}; the mosaics need uint8 {(*blocks, *side, 3)}")
    return torch.from_numpy(array).movedim(-1, -3)


def turned_like(pictures: Tensor, mosaics: Tensor, cfa: CFA, what: str) -> Tensor:
    """The pictures ``(K, 3, H, W)`` of a frame's blocks, turned as their mosaics ``(K, 1, H, W)`` are.

    Raises:
        ValueError: in the name of ``what``, if they do not show the same.

    Example:
        >>> coarse = torch.rand(2, 3, 2, 2, generator=torch.Generator().manual_seed(0))
        >>> rgb = coarse.repeat_interleave(4, dim=2).repeat_interleave(4, dim=3)
        >>> pictures = bayer.turn((rgb * 255).to(torch.uint8), 3)
        >>> turned = turned_like(pictures, bayer.mosaic(rgb, CFA.RGGB), CFA.RGGB, "blocks")
        >>> torch.equal(turned, (rgb * 255).to(torch.uint8))
        True
    """
    square = pictures.shape[-2] == pictures.shape[-1]
    views = range(bayer.N_VIEWS if square else bayer.N_VIEWS // 2)
    planes = bayer.pack(mosaics, cfa)
    raw = (planes[:, 1] + planes[:, 2]).clamp_min(0.0).sqrt()
    green = F.avg_pool2d(pictures[:, 1:2].float(), 2)[:, 0]
    likeness = torch.stack([_correlation(bayer.turn_back(green, view), raw) for view in views])
    best = int(likeness.argmax())
    if likeness[best] < LEAST_LIKENESS:
        raise ValueError(f"{what}: its pictures do not show its RAW blocks (correlation {likeness[best]:.2f})")
    return bayer.turn_back(pictures, best).contiguous()


def _correlation(a: Tensor, b: Tensor) -> Tensor:
    """Of two stacks of images; 1 where one of them is flat, which contradicts nothing."""
    value = torch.corrcoef(torch.stack([a.flatten(), b.flatten()]))[0, 1]
    return torch.where(value.isfinite(), value, torch.ones(()))
