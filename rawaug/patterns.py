r"""Colour filter arrays of any period: X-Trans, Quad-Bayer, and Bayer's as a case of them.

``y[i, j] = x[c(i mod p, j mod p), i, j]``: a mosaic keeps one colour a site, by a cell ``c`` of p x p sites.

- X-Trans (Fujifilm): 6 x 6 with 20 green, 8 red and 8 blue sites; every row and every column has all three colours. The
  cell is the one that LibRaw reads from Fujifilm's files, from an origin where it begins with G B G G R G.
- Quad-Bayer: a Bayer cell of which each site is 2 x 2 pixels of one colour, so 4 x 4; the pixels are read one by one.

There is no packed form of such RAW: networks read the mosaic ``(B, 1, H, W)`` with the pattern as planes, one a colour,
that are 1 at its sites (:meth:`Pattern.planes`). Flips and quarter turns move all of these patterns by some sites only,
so that :meth:`Pattern.turn_keeping` brings them back by cropping.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA

X = TypeVar("X", bound=Tensor)


@dataclass(frozen=True)
class Pattern:
    """A colour filter array.

    Args:
        name: as :func:`pattern` knows it.
        rows: the cell from the top left, a string of ``R``, ``G``, ``B`` for each row; as many rows as columns.

    Example:
        >>> xtrans = pattern("XTRANS")
        >>> raw = xtrans.mosaic(torch.rand(2, 3, 24, 36))
        >>> raw.shape, torch.cat([raw, xtrans.planes(24, 36).expand(2, -1, -1, -1)], dim=1).shape
        (torch.Size([2, 1, 24, 36]), torch.Size([2, 4, 24, 36]))
    """

    name: str
    rows: tuple[str, ...]

    @property
    def period(self) -> int:
        """Side of the cell."""
        return len(self.rows)

    def channels(self, height: int, width: int) -> Tensor:
        """The colour of each site as an index into RGB, int64 ``(H, W)``."""
        cell = torch.tensor([["RGB".index(colour) for colour in row] for row in self.rows])
        times = (-(-height // self.period), -(-width // self.period))
        return cell.repeat(*times)[:height, :width]

    def planes(self, height: int, width: int) -> Tensor:
        """One plane a colour that is 1 at its sites and 0 elsewhere, float32 ``(3, H, W)``: an input of networks."""
        return (self.channels(height, width) == torch.arange(3)[:, None, None]).float()

    def mosaic(self, rgb: Tensor) -> Tensor:
        """Full-colour ``(..., 3, H, W)`` to the mosaic ``(..., 1, H, W)``.

        Raises:
            ValueError: if the shape is not that of an RGB image.
        """
        if rgb.ndim < 3 or rgb.shape[-3] != 3:
            raise ValueError(f"an RGB image must have shape (..., 3, H, W), got {tuple(rgb.shape)}")
        index = self.channels(*rgb.shape[-2:]).to(rgb.device)
        return rgb.gather(-3, index.expand(*rgb.shape[:-3], 1, *index.shape))

    def demosaic(self, raw: Tensor) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to ``(B, 3, H, W)``, for the eye: what a site measured stays, the rest are means.

        The mean is that of the sites of the colour nearby, with the weights of a tent as wide as the cell (normalised
        convolution: Knutsson and Westin, CVPR 1993); of Bayer's patterns it is bilinear interpolation.
        """
        planes, inverse = (kept.to(raw) for kept in _sites(self.name, *raw.shape[-2:]))
        return torch.where(planes > 0, raw, _tent(raw * planes, self.period) * inverse)

    def crop(self, raw: X, top: int, left: int, height: int, width: int) -> Tensor:
        """Crop ``(..., H, W)`` at whole cells, so that the pattern begins at its corner again; any size.

        Raises:
            ValueError: if the offset is none of whole cells, or the crop leaves the mosaic.
        """
        if top % self.period or left % self.period:
            raise ValueError(f"offset ({top}, {left}) must be a multiple of {self.period} to keep {self.name}")
        inside = 0 <= top <= top + height <= raw.shape[-2] and 0 <= left <= left + width <= raw.shape[-1]
        if not inside or min(height, width) < 1:
            size = tuple(raw.shape[-2:])
            raise ValueError(f"crop {height} x {width} at ({top}, {left}) extends beyond the mosaic {size}")
        return raw[..., top : top + height, left : left + width]

    def shift_after(self, view: int) -> tuple[int, int]:
        """Rows and columns, less than the period, from which a mosaic of whole cells reads the pattern again after
        :func:`rawaug.bayer.turn`."""
        cell = self.channels(self.period, self.period)
        turned = bayer.turn(cell, view)
        sites = [(i, j) for i in range(self.period) for j in range(self.period)]
        return next((i, j) for i, j in sites if torch.equal(turned.roll((-i, -j), (0, 1)), cell))

    def turn_keeping(self, raw: Tensor, view: int) -> Tensor:
        """Turn ``(..., H, W)`` as :func:`rawaug.bayer.turn` does, and crop to the whole cells of the pattern.

        A side is one cell shorter where the pattern had moved.

        Raises:
            ValueError: if a side has no whole cells, or too few.

        Example:
            >>> pattern("XTRANS").turn_keeping(torch.rand(1, 1, 24, 36), view=1).shape  # mirrored
            torch.Size([1, 1, 24, 30])
        """
        height, width = raw.shape[-2:]
        if height % self.period or width % self.period:
            raise ValueError(f"{height} x {width} must be multiples of {self.period} to turn {self.name}; crop it")
        turned = bayer.turn(raw, view)
        rows, columns = self.shift_after(view)
        height, width = (
            side - bool(shift) * self.period for side, shift in zip(turned.shape[-2:], (rows, columns), strict=True)
        )
        if height < 1 or width < 1:
            raise ValueError(f"a mosaic of {tuple(raw.shape[-2:])} is too small to turn while keeping {self.name}")
        return turned[..., rows : rows + height, columns : columns + width]


def _tent(image: Tensor, period: int) -> Tensor:
    """``(B, C, H, W)`` through a separable tent that reaches half a cell to each side; 0 beyond the edges."""
    reach = period // 2
    for axis in (-2, -1):
        side = image.shape[axis]
        padded = F.pad(image, (0, 0, reach, reach) if axis == -2 else (reach, reach))
        image = padded.narrow(axis, reach, side) * (reach + 1.0)
        for step in range(1, reach + 1):
            for start in (reach - step, reach + step):
                image.add_(padded.narrow(axis, start, side), alpha=reach + 1.0 - step)
    return image


@lru_cache(maxsize=4)
def _sites(name: str, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The planes of a pattern, and one over the sum of the tent's weights on them, each ``(1, 3, H, W)``."""
    known = pattern(name)
    planes = known.planes(height, width)[None]
    return planes, 1.0 / _tent(planes, known.period)


def _quad(cfa: CFA) -> Pattern:
    first, second = (2 * cfa.value[k] + 2 * cfa.value[k + 1] for k in (0, 2))
    return Pattern(f"QUAD-{cfa.value}", (first, first, second, second))


_XTRANS = Pattern("XTRANS", ("GBGGRG", "RGRBGB", "GBGGRG", "GRGGBG", "BGBRGR", "GRGGBG"))

PATTERNS: dict[str, Pattern] = {
    **{cfa.value: Pattern(cfa.value, (cfa.value[:2], cfa.value[2:])) for cfa in CFA},
    **{_quad(cfa).name: _quad(cfa) for cfa in CFA},
    _XTRANS.name: _XTRANS,
}
"""The patterns by name."""


def pattern(name: str) -> Pattern:
    """The pattern of this name: a Bayer one, the same with ``QUAD-`` before it, or ``XTRANS``.

    Raises:
        ValueError: if there is none.

    Example:
        >>> pattern("QUAD-RGGB").rows
        ('RRGG', 'RRGG', 'GGBB', 'GGBB')
    """
    if str(name) not in PATTERNS:
        raise ValueError(f"CFA {name!r} is unknown; use one of {', '.join(PATTERNS)}")
    return PATTERNS[str(name)]
