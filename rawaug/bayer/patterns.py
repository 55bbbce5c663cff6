"""Colour filter arrays other than Bayer's.

They are X-Trans (Fujifilm; 6 x 6 sites, as LibRaw reads it from an origin where it begins with G B G G R G) and
Quad-Bayer (each site of a Bayer cell is 2 x 2 pixels). Their RAW has no packed form, so networks read the mosaic with
the pattern as one-hot planes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer.cfa import CFA, crop_window, require_channels, turn


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
        """The side of the cell in pixels."""
        return len(self.rows)

    def shift(self, rows: int, columns: int) -> Pattern:
        """Give the pattern of the mosaic that starts ``rows`` lower and ``columns`` further right; it has a name again.

        Example:
            >>> pattern("QUAD-RGGB").shift(1, 3).name, pattern("RGGB").shift(0, 1).name
            ('QUAD-RGGB+1+3', 'GRBG')
        """
        return _BY_ROWS[self._rows_from(rows, columns)]

    def _rows_from(self, top: int, left: int) -> tuple[str, ...]:
        """Give the rows of the cell that begins at another origin."""
        top, left = top % self.period, left % self.period
        lower_first = self.rows[top:] + self.rows[:top]
        return tuple(row[left:] + row[:left] for row in lower_first)

    def channels(self, height: int, width: int) -> Tensor:
        """Give the colour of each site as an index into RGB, int64 ``(H, W)``."""
        flat = ["RGB".index(colour) for colour in "".join(self.rows)]
        cell = torch.tensor(flat).reshape(self.period, self.period)

        down, across = math.ceil(height / self.period), math.ceil(width / self.period)
        return cell.repeat(down, across)[:height, :width]

    def planes(self, height: int, width: int) -> Tensor:
        """Make a plane for each colour, 1 at its sites and 0 elsewhere, float32 ``(3, H, W)``, as networks take it."""
        return (self.channels(height, width) == torch.arange(3)[:, None, None]).float()

    def mosaic(self, rgb: Tensor) -> Tensor:
        """Mosaic full colour ``(..., 3, H, W)`` to ``(..., 1, H, W)``."""
        require_channels(rgb, 3, "an RGB image")
        index = self.channels(*rgb.shape[-2:]).to(rgb.device)
        return rgb.gather(-3, index.expand(*rgb.shape[:-3], 1, *index.shape))

    def demosaic(self, raw: Tensor) -> Tensor:
        """Demosaic ``(B, 1, H, W)`` to ``(B, 3, H, W)`` for the eye: each site keeps its colour and gets two means.

        A mean is taken over the colour's sites nearby, with the weights of a tent as wide as the cell (normalised
        convolution: Knutsson and Westin, CVPR 1993); for Bayer's patterns it is bilinear interpolation.
        """
        planes, inverse_weights = _sites(self.name, *raw.shape[-2:])
        planes = planes.to(raw)

        means = _tent(raw * planes, self.period) * inverse_weights.to(raw)
        return torch.where(planes > 0, raw, means)

    def crop(self, raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
        """Crop a mosaic ``(..., H, W)`` at whole cells, so that the pattern begins at the corner again.

        Args:
            raw: the mosaic.
            top, left: the first row and column, multiples of the period.
            height, width: any size.

        Raises:
            ValueError: if an offset is no such multiple, or the crop extends beyond the mosaic.
        """
        if top % self.period or left % self.period:
            raise ValueError(f"offset ({top}, {left}) must be a multiple of {self.period} to keep {self.name}")
        return crop_window(raw, top, left, height, width)

    def shift_after(self, view: int) -> tuple[int, int]:
        """Find the row and column, less than the period, from which a turned mosaic reads the pattern again."""
        cell = self.channels(self.period, self.period)
        turned = turn(cell, view)

        for i, j in product(range(self.period), repeat=2):
            if torch.equal(turned.roll((-i, -j), (0, 1)), cell):
                return i, j
        raise ValueError(f"{self.name} does not come back in any place of view {view}")

    def turn_keeping(self, raw: Tensor, view: int) -> Tensor:
        """Turn ``(..., H, W)`` as :func:`turn` does, and crop to the whole cells of the pattern.

        A side, which must have whole cells, is one cell shorter where the pattern had moved.

        Example:
            >>> pattern("XTRANS").turn_keeping(torch.rand(1, 1, 24, 36), view=1).shape  # mirrored
            torch.Size([1, 1, 24, 30])
        """
        height, width = raw.shape[-2:]
        if height % self.period or width % self.period:
            raise ValueError(f"{height} x {width} must be multiples of {self.period} to turn {self.name}; crop it")

        turned = turn(raw, view)
        height, width = turned.shape[-2:]
        rows, columns = self.shift_after(view)
        if rows:
            height -= self.period
        if columns:
            width -= self.period
        if height < 1 or width < 1:
            raise ValueError(f"a mosaic of {tuple(raw.shape[-2:])} is too small to turn while keeping {self.name}")

        return turned[..., rows : rows + height, columns : columns + width]


def _tent(image: Tensor, period: int) -> Tensor:
    """Filter ``(B, C, H, W)`` by a separable tent that reaches half a cell to each side, with 0 beyond the edges."""
    reach = period // 2

    for axis, margins in ((-2, (0, 0, reach, reach)), (-1, (reach, reach))):
        side = image.shape[axis]
        padded = F.pad(image, margins)
        image = padded.narrow(axis, reach, side) * (reach + 1.0)
        for step in range(1, reach + 1):
            for start in (reach - step, reach + step):
                image.add_(padded.narrow(axis, start, side), alpha=reach + 1.0 - step)

    return image


@lru_cache(maxsize=4)
def _sites(name: str, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Make the planes of a pattern and the inverse of the tent's sum of weights on them, each ``(1, 3, H, W)``."""
    array = pattern(name)
    planes = array.planes(height, width)[None]
    return planes, 1.0 / _tent(planes, array.period)


def _bayer(cfa: CFA) -> Pattern:
    return Pattern(cfa.value, (cfa.value[:2], cfa.value[2:]))


def _quad(cfa: CFA) -> Pattern:
    a, b, c, d = cfa.value
    first, second = a + a + b + b, c + c + d + d
    return Pattern(f"QUAD-{cfa.value}", (first, first, second, second))


_XTRANS = Pattern("XTRANS", ("GBGGRG", "RGRBGB", "GBGGRG", "GRGGBG", "BGBRGR", "GRGGBG"))
_ALL = (*map(_bayer, CFA), *map(_quad, CFA), _XTRANS)

PATTERNS: dict[str, Pattern] = {array.name: array for array in _ALL}
"""This maps names to patterns."""

_BY_NAME: dict[str, Pattern] = {}
"""This maps every name to its pattern, also from other origins such as ``XTRANS+1+2``; one cell has one pattern."""

_BY_ROWS: dict[tuple[str, ...], Pattern] = {}
"""This maps the rows of a cell to its pattern, from all origins."""


def _add(name: str, rows: tuple[str, ...]) -> None:
    _BY_NAME[name] = _BY_ROWS.setdefault(rows, Pattern(name, rows))


for _array in _ALL:
    _add(_array.name, _array.rows)
for _array in _ALL:
    for _i, _j in product(range(_array.period), repeat=2):
        _add(f"{_array.name}+{_i}+{_j}", _array._rows_from(_i, _j))


def pattern_name(rows: Sequence[str]) -> str | None:
    """Name the pattern whose cell reads as ``rows`` from its top left; return None if it is unknown.

    Example:
        >>> pattern_name(["GRBGBR", "BGGRGG", "RGGBGG", "GBRGRB", "RGGBGG", "BGGRGG"])
        'XTRANS+1+1'
    """
    array = _BY_ROWS.get(tuple(rows))
    if array is None:
        return None
    return array.name


def canonical_cfa(cfa: str) -> str:
    """Give the :class:`CFA` of a Bayer pattern, or the name of any other; raise ValueError for an unknown pattern."""
    name = pattern(cfa).name
    if name in CFA.__members__:
        return CFA(name)
    return name


def plane_indices(cfa: str) -> Tensor:
    """Say which of R, Gr, Gb, B (0 to 3) each site of a cell is, int64 ``(n, n)``; greens are 1 except in Bayer's.

    Example:
        >>> plane_indices("GRBG").tolist(), plane_indices("XTRANS").shape
        ([[1, 0], [3, 2]], torch.Size([6, 6]))
    """
    array = pattern(cfa)
    if array.name not in CFA.__members__:
        return torch.tensor((0, 1, 3))[array.channels(array.period, array.period)]

    cell = torch.zeros(2, 2, dtype=torch.int64)
    for number, site in enumerate(CFA(array.name).sites):
        cell[site] = number
    return cell


def pattern(name: str) -> Pattern:
    """Find a pattern by name: a Bayer one, the same with ``QUAD-`` before it, or ``XTRANS``.

    Patterns with larger cells may begin at another origin: ``XTRANS+1+2`` begins a row lower and two columns further
    right.

    Example:
        >>> pattern("QUAD-RGGB").rows
        ('RRGG', 'RRGG', 'GGBB', 'GGBB')
    """
    if str(name) not in _BY_NAME:
        raise ValueError(f"CFA {name!r} is unknown; use one of {', '.join(PATTERNS)}")
    return _BY_NAME[str(name)]
