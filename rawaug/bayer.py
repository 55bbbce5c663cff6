r"""Mosaics: the colour filter array, packing, and geometry that keeps the pattern.

A mosaic keeps one colour a site, ``y[i, j] = x[c(i, j), i, j]``, where ``c`` repeats every two rows and columns in
Bayer's patterns (US patent 3,971,065, 1976). *Packed* RAW holds the four sites of each 2 x 2 cell as four planes,
always in the order R, Gr, Gb, B (Gr is the green of the red row), so that a network need not know the sensor's pattern.

A flip or a quarter turn of a mosaic moves the pattern: a mirrored RGGB is GRBG. :func:`turn` only moves pixels,
:meth:`CFA.turned` says what the pattern becomes, and :func:`turn_keeping_cfa` crops a line where that brings it back.

:class:`Pattern` is any other array: X-Trans (Fujifilm; 6 x 6 sites, as LibRaw reads it from an origin where it begins
with G B G G R G) and Quad-Bayer (each site of a Bayer cell is 2 x 2 pixels). Their RAW has no packed form: networks
read the mosaic with the pattern as one-hot planes.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import get_worker_info

N_VIEWS = 8  # flips and quarter turns of a picture: the dihedral group of the square


class CFA(StrEnum):
    """The 2 x 2 colour filter array, read row by row from the top left: ``CFA("RGGB")`` is R G / G B."""

    RGGB = "RGGB"
    BGGR = "BGGR"
    GRBG = "GRBG"
    GBRG = "GBRG"

    @classmethod
    def _missing_(cls, value: object) -> CFA:
        names = ", ".join(member.value for member in cls)
        raise ValueError(f"CFA {value!r} is not a Bayer pattern; use one of {names}")

    @property
    def sites(self) -> tuple[tuple[int, int], ...]:
        """(row, column) within the cell of R, Gr, Gb and B, in this order."""
        red = self.value.index("R")
        row, column = divmod(red, 2)
        return (row, column), (row, 1 - column), (1 - row, column), (1 - row, 1 - column)

    @property
    def channels(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """The cell as indices into RGB: ``((0, 1), (1, 2))`` for RGGB."""
        a, b, c, d = ("RGB".index(colour) for colour in self.value)
        return (a, b), (c, d)

    def shifted(self, rows: int, columns: int) -> CFA:
        """The pattern of the mosaic that starts ``rows`` lower and ``columns`` further right."""
        cell = [self.value[:2], self.value[2:]]
        return CFA("".join(cell[(i + rows) % 2][(j + columns) % 2] for i in (0, 1) for j in (0, 1)))

    def turned(self, view: int) -> CFA:
        """The pattern after :func:`turn` of a mosaic with even sides."""
        cell = torch.arange(4).reshape(1, 1, 2, 2)
        return CFA("".join(self.value[k] for k in turn(cell, view).flatten().tolist()))

    def shift_to(self, other: CFA) -> tuple[int, int]:
        """(rows, columns) in {0, 1} with ``self.shifted(rows, columns) == other``."""
        return next((i, j) for i in (0, 1) for j in (0, 1) if self.shifted(i, j) == other)


def noise_variance(raw: Tensor, shot_var: float | Tensor, read_var: float | Tensor) -> Tensor:
    """The variance of shot and read noise, ``shot_var max(raw, 0) + read_var``, white = 1; the levels broadcast."""
    return raw.clamp_min(0.0) * shot_var + read_var


def _require_even(height: int, width: int) -> None:
    if height % 2 or width % 2:
        raise ValueError(f"a Bayer mosaic must have even sides, got {height} x {width}; crop the last row or column")
    if min(height, width) < 2:
        raise ValueError(f"a Bayer mosaic must be at least 2 x 2, got {height} x {width}")


def _require_channels(image: Tensor, channels: int, what: str) -> None:
    if image.ndim < 3 or image.shape[-3] != channels:
        raise ValueError(f"{what} must have shape (..., {channels}, H, W), got {tuple(image.shape)}")


def pack(mosaic: Tensor, cfa: CFA | str) -> Tensor:
    """Mosaic ``(..., 1, H, W)`` to packed planes R, Gr, Gb, B ``(..., 4, H/2, W/2)``; ValueError if a side is odd."""
    _require_channels(mosaic, 1, "a mosaic")
    _require_even(*mosaic.shape[-2:])
    plane = mosaic[..., 0, :, :]
    return torch.stack([plane[..., i::2, j::2] for i, j in CFA(cfa).sites], dim=-3)


def unpack(packed: Tensor, cfa: CFA | str) -> Tensor:
    """Packed planes ``(..., 4, H/2, W/2)`` to the mosaic ``(..., 1, H, W)``; the inverse of :func:`pack`."""
    _require_channels(packed, 4, "packed RAW")
    *lead, _, height, width = packed.shape
    _require_even(2 * height, 2 * width)
    mosaic = packed.new_empty(*lead, 1, 2 * height, 2 * width)
    for k, (i, j) in enumerate(CFA(cfa).sites):
        mosaic[..., 0, i::2, j::2] = packed[..., k, :, :]
    return mosaic


def pack_rgb(rgb: Tensor, cfa: CFA | str) -> Tensor:
    """Full-colour linear ``(..., 3, H, W)`` to packed ``(..., 4, H/2, W/2)``: each site keeps its own colour alone."""
    _require_channels(rgb, 3, "an RGB image")
    _require_even(*rgb.shape[-2:])
    sites = zip((0, 1, 1, 2), CFA(cfa).sites, strict=True)
    return torch.stack([rgb[..., c, i::2, j::2] for c, (i, j) in sites], dim=-3)


def mosaic(rgb: Tensor, cfa: CFA | str) -> Tensor:
    """Full-colour linear ``(..., 3, H, W)`` to the mosaic ``(..., 1, H, W)``: stage f6, reversed."""
    return unpack(pack_rgb(rgb, cfa), cfa)


# A colour that a site lacks, from its surroundings, in eighths: green at red or blue; a colour at a green whose
# neighbours along the row have it (turned, along the column); red at blue or blue at red.
STENCILS: dict[str, tuple[Tensor, Tensor, Tensor]] = {
    "bilinear": (
        torch.tensor([[0.0, 2, 0], [2, 0, 2], [0, 2, 0]]),
        torch.tensor([[0.0, 0, 0], [4, 0, 4], [0, 0, 0]]),
        torch.tensor([[2.0, 0, 2], [0, 0, 0], [2, 0, 2]]),
    ),
    "malvar": (
        torch.tensor([[0.0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]),
        torch.tensor([[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]),
        torch.tensor([[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]),
    ),
}


def demosaic(raw: Tensor, cfa: CFA | str, method: str = "bilinear") -> Tensor:
    """Mosaic ``(B, 1, H, W)``, sides even, to ``(B, 3, H, W)``: stage f6; each site keeps the colour that it measured.

    ``method`` is ``bilinear``, or ``malvar`` (sides of at least 4): the missing colour follows its neighbours,
    corrected by the Laplacian of the known one (H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation for
    demosaicing of Bayer-patterned color images", ICASSP 2004).
    """
    _require_channels(raw, 1, "a mosaic")
    _require_even(*raw.shape[-2:])
    stencils, kinds = demosaicing(cfa, method)
    edge = stencils.shape[-1] // 2
    padded = F.pad(raw, (edge, edge, edge, edge), mode="reflect")  # about the border sites: the pattern stays
    found = torch.cat([raw, F.conv2d(padded, stencils[:, None].to(raw))], dim=1)
    rgb = raw.new_empty(len(raw), 3, *raw.shape[-2:])
    for channel, rows in enumerate(kinds):
        for i, row in enumerate(rows):
            for j, kind in enumerate(row):
                rgb[:, channel, i::2, j::2] = found[:, kind, i::2, j::2]
    return rgb


@lru_cache
def demosaicing(cfa: CFA | str, method: str) -> tuple[Tensor, list[list[list[int]]]]:
    """Four stencils ``(4, K, K)``, and which makes a colour at a site: ``kinds[colour][row][column]``, 0 for none."""
    if method not in STENCILS:
        raise ValueError(f"demosaicing {method!r} is unknown; use one of {', '.join(STENCILS)}")
    cross, along_row, diagonal = STENCILS[method]
    own = CFA(cfa).channels

    def kind(colour: int, i: int, j: int) -> int:
        if own[i][j] == colour:
            return 0
        if own[i][j] == 1:
            return 2 if own[i][1 - j] == colour else 3
        return 1 if colour == 1 else 4

    kinds = [[[kind(colour, i, j) for j in (0, 1)] for i in (0, 1)] for colour in range(3)]
    return torch.stack([cross, along_row, along_row.T, diagonal]) / 8, kinds


def turn(image: Tensor, view: int) -> Tensor:
    """One of the eight flips and quarter turns of ``(..., H, W)``; a mosaic's pattern moves along.

    ``view`` is in [0, 8): bit 2 transposes first, bit 1 then flips the rows, bit 0 the columns. View 0 is the identity,
    3 the half turn, 5 and 6 are the quarter turns to the right and to the left.
    """
    if not 0 <= view < N_VIEWS:
        raise ValueError(f"view must be in [0, {N_VIEWS}), got {view}")
    if view & 4:
        image = image.transpose(-2, -1)
    axes = [axis for bit, axis in ((2, -2), (1, -1)) if view & bit]
    return image.flip(axes) if axes else image


def turn_back(image: Tensor, view: int) -> Tensor:
    """The inverse of :func:`turn` with the same ``view``."""
    flips = turn(image, view & 3)
    return flips.transpose(-2, -1) if view & 4 else flips


def turn_keeping_cfa(raw: Tensor, cfa: CFA | str, view: int) -> Tensor:
    """Turn a mosaic ``(..., H, W)`` and keep its pattern: where it would move, one line on either side is cropped."""
    _require_even(*raw.shape[-2:])
    kept = aligned(turn(raw, view), CFA(cfa).turned(view), CFA(cfa))
    if not all(kept.shape[-2:]):
        raise ValueError(f"a mosaic of {tuple(raw.shape[-2:])} is too small to turn while keeping its CFA")
    return kept


def crop(raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
    """Crop ``(..., H, W)``; ValueError if the offset or size is odd, which moves the pattern, or beyond the mosaic."""
    if any(value % 2 for value in (top, left, height, width)):
        raise ValueError(f"offset ({top}, {left}) and size {height} x {width} must be even to keep the CFA")
    return _cropped(raw, top, left, height, width)


def _cropped(raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
    sides = tuple(raw.shape[-2:])
    if min(top, left) < 0 or min(height, width) < 1 or top + height > sides[0] or left + width > sides[1]:
        raise ValueError(f"crop {height} x {width} at ({top}, {left}) extends beyond the mosaic {sides}")
    return raw[..., top : top + height, left : left + width]


def bin_mosaic(raw: Tensor, cfa: CFA | str, factor: int, together: bool = False) -> Tensor:
    """A mosaic ``(..., 1, H, W)`` at 1 / ``factor`` of its sides, each site the mean of its colour around its place.

    The mean is over 2 ``factor`` pixels of the old mosaic either way, ``factor`` sites of a colour, about the centre of
    the new site; with an even factor a site at the window's end counts by the part of it that is inside. So the sites
    of the new mosaic are as far apart as a sensor's, and demosaicing finds edges where they are. The pattern stays;
    independent noise has :func:`binned_variance` of its variance. Beyond the border its last sites are repeated.
    With ``together`` the four sites of a new cell are means over the same area, as a pixel of full colour needs them.
    ValueError if the CFA is not Bayer's, or a side is not a multiple of 2 ``factor``.

    Example:
        >>> bin_mosaic(torch.rand(1, 16, 24), "GRBG", 4).shape
        torch.Size([1, 4, 6])
    """
    if factor < 1 or any(side % (2 * factor) for side in raw.shape[-2:]):
        raise ValueError(f"a mosaic of {tuple(raw.shape[-2:])} cannot be binned by {factor}; use multiples of 2 factor")
    CFA(cfa)  # whatever the pattern of 2 x 2 sites, each is averaged with its own kind
    move = 0.0 if together else (factor - 1) / 4
    rows = [_window_means(raw[..., i::2, :], -2, factor, move * (2 * i - 1)) for i in (0, 1)]
    sites = [[_window_means(row[..., j::2], -1, factor, move * (2 * j - 1)) for j in (0, 1)] for row in rows]
    return torch.stack([torch.stack(pair, -1).flatten(-2) for pair in sites], -2).flatten(-3, -2)


def binned_variance(factor: int, together: bool = False) -> float:
    """Of independent noise of variance 1 after :func:`bin_mosaic`: about ``1 / factor^2``, 0.051 for 4."""
    part = 0.0 if together else (factor - 1) / 4 % 1
    return ((factor - 1 + part**2 + (1 - part) ** 2) / factor**2) ** 2


def _window_means(plane: Tensor, axis: int, factor: int, move: float) -> Tensor:
    """Means over ``factor`` sites of one colour, of windows moved by so many of its sites."""
    first, part = math.floor(move), move % 1
    sites = torch.arange(plane.shape[axis], device=plane.device)
    near, far = (
        plane.index_select(axis, (sites + k).clamp(0, len(sites) - 1)).unflatten(axis, (-1, factor)).mean(axis)
        for k in (first, first + 1)
    )
    return torch.lerp(near, far, part)


def aligned(mosaic: Tensor, cfa: CFA, target: CFA) -> Tensor:
    """``(..., H, W)`` from the first site where ``cfa`` reads as ``target``; sides stay even."""
    rows, columns = cfa.shift_to(target)
    height, width = mosaic.shape[-2:]
    return mosaic[..., rows : height - rows, columns : width - columns]


class _Transform(nn.Module, ABC):
    """A module with an ``apply(raw, params)`` of its own; with a function alone it is still ``nn.Module.apply``.

    Without a generator, as in ``nn.Sequential``, it draws by ``seed``, the worker that it is in and the call's number.
    """

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.seed, self._calls = seed, 0

    def _own(self, generator: torch.Generator | None) -> torch.Generator:
        if generator is not None:
            return generator
        from rawaug.seeding import keyed_generator, rank_key  # late: what only turns mosaics, denoisers, needs no seeds

        self._calls += 1
        worker = get_worker_info()
        return keyed_generator(self.seed, type(self).__name__, worker.seed if worker else 0, self._calls, *rank_key())

    def apply(self, raw: Any, params: Tensor | None = None) -> Any:
        return super().apply(raw) if params is None else self._apply_params(raw, params)

    @abstractmethod
    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor: ...


class RandomCrop(_Transform):
    """A crop ``(..., size, size)`` of mosaics ``(..., H, W)`` at a random even offset: the pattern stays.

    One draw serves all that is in the tensor: noisy and clean, stacked, are cropped alike.

    Args:
        size: even side, or (height, width), in mosaic pixels, at most those of the mosaics.
        seed: of its own draws, where no generator is passed.

    Example:
        >>> crop = RandomCrop(4)
        >>> raw, generator = torch.rand(2, 1, 8, 12), torch.Generator().manual_seed(0)
        >>> params = crop.sample(8, 12, generator)
        >>> crop.apply(raw, params).shape
        torch.Size([2, 1, 4, 4])
    """

    def __init__(self, size: int | tuple[int, int], seed: int = 0) -> None:
        super().__init__(seed)
        self.size = (size, size) if isinstance(size, int) else size
        if any(side % 2 or side < 2 for side in self.size):
            raise ValueError(f"crop must be even and at least 2, got {size}")

    def sample(self, height: int, width: int, generator: torch.Generator) -> Tensor:
        """``(2,)``: top and left of a crop of a mosaic of ``height`` x ``width``."""
        rows, columns = self.size
        if height < rows or width < columns:
            raise ValueError(f"{height} x {width} is smaller than the crop {rows} x {columns}; choose a smaller crop")
        free = ((height - rows) // 2 + 1, (width - columns) // 2 + 1)
        return 2 * torch.stack([torch.randint(n, (), generator=generator) for n in free])

    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor:
        top, left = params.tolist()
        return crop(raw, top, left, *self.size)

    def forward(self, raw: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._apply_params(raw, self.sample(raw.shape[-2], raw.shape[-1], self._own(generator)))


class RandomTurn(_Transform):
    """One of the eight flips and quarter turns of mosaics ``(..., H, W)``, the same for all that is in the tensor.

    Args:
        cfa: pattern of the mosaics.
        keep_cfa: crop a line on either side where the pattern would move; if not, it becomes ``cfa.turned(view)``.
        quarter: draw quarter turns too; without them the sides are not exchanged.
        seed: of its own draws, where no generator is passed.

    Example:
        >>> turn = RandomTurn("GRBG")
        >>> turn.apply(torch.rand(1, 1, 8, 12), torch.tensor(2)).shape
        torch.Size([1, 1, 6, 12])
    """

    def __init__(self, cfa: CFA | str, keep_cfa: bool = True, quarter: bool = True, seed: int = 0) -> None:
        super().__init__(seed)
        self.cfa, self.keep_cfa, self.views = CFA(cfa), keep_cfa, N_VIEWS if quarter else N_VIEWS // 2

    def sample(self, generator: torch.Generator) -> Tensor:
        """The view, ``()``."""
        return torch.randint(self.views, (), generator=generator)

    def _apply_params(self, raw: Tensor, params: Tensor) -> Tensor:
        view = int(params)
        return turn_keeping_cfa(raw, self.cfa, view) if self.keep_cfa else turn(raw, view)

    def forward(self, raw: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return self._apply_params(raw, self.sample(self._own(generator)))


class Pack(nn.Module):
    """:func:`pack` as a module."""

    def __init__(self, cfa: CFA | str) -> None:
        super().__init__()
        self.cfa = CFA(cfa)

    def forward(self, mosaic: Tensor) -> Tensor:
        return pack(mosaic, self.cfa)


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
        """Full-colour ``(..., 3, H, W)`` to the mosaic ``(..., 1, H, W)``."""
        _require_channels(rgb, 3, "an RGB image")
        index = self.channels(*rgb.shape[-2:]).to(rgb.device)
        return rgb.gather(-3, index.expand(*rgb.shape[:-3], 1, *index.shape))

    def demosaic(self, raw: Tensor) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to ``(B, 3, H, W)``, for the eye: what a site measured stays, the rest are means.

        The mean is that of the sites of the colour nearby, with the weights of a tent as wide as the cell (normalised
        convolution: Knutsson and Westin, CVPR 1993); of Bayer's patterns it is bilinear interpolation.
        """
        planes, inverse = (kept.to(raw) for kept in _sites(self.name, *raw.shape[-2:]))
        return torch.where(planes > 0, raw, _tent(raw * planes, self.period) * inverse)

    def crop(self, raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
        """Crop ``(..., H, W)`` at whole cells, so that the pattern begins at its corner again; any size."""
        if top % self.period or left % self.period:
            raise ValueError(f"offset ({top}, {left}) must be a multiple of {self.period} to keep {self.name}")
        return _cropped(raw, top, left, height, width)

    def shift_after(self, view: int) -> tuple[int, int]:
        """Rows and columns, less than the period, from which a turned mosaic of whole cells reads the pattern again."""
        cell = self.channels(self.period, self.period)
        turned = turn(cell, view)
        sites = [(i, j) for i in range(self.period) for j in range(self.period)]
        return next((i, j) for i, j in sites if torch.equal(turned.roll((-i, -j), (0, 1)), cell))

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
        turned, (rows, columns) = turn(raw, view), self.shift_after(view)
        height, width = turned.shape[-2] - bool(rows) * self.period, turned.shape[-1] - bool(columns) * self.period
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

    Example:
        >>> pattern("QUAD-RGGB").rows
        ('RRGG', 'RRGG', 'GGBB', 'GGBB')
    """
    if str(name) not in PATTERNS:
        raise ValueError(f"CFA {name!r} is unknown; use one of {', '.join(PATTERNS)}")
    return PATTERNS[str(name)]
