r"""Mosaics: the colour filter array, packing, and geometry that keeps the pattern.

A mosaic keeps one colour for each site, ``y[i, j] = x[c(i, j), i, j]``, where ``c`` repeats every two rows and columns
in Bayer's patterns (US patent 3,971,065, 1976). *Packed* RAW holds the four sites of each 2 x 2 cell as four planes,
always in the order R, Gr, Gb, B (Gr is the green of the red row), so that a network need not know the sensor's pattern.

A flip or a quarter turn of a mosaic moves the pattern: a mirrored RGGB is GRBG. :func:`turn` only moves pixels,
:meth:`CFA.turn` says what the pattern becomes, and :meth:`rawaug.bayer.Pattern.turn_keeping` brings it back.
"""

from __future__ import annotations

import math
from enum import StrEnum

import torch
from torch import Tensor

_PLANES = 4
"""Packed RAW has this many planes."""

N_VIEWS = 8
"""A picture has this many flips and quarter turns: it is the order of the square's dihedral group."""


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
        indices = ["RGB".index(colour) for colour in self.value]
        return (indices[0], indices[1]), (indices[2], indices[3])

    def shift(self, rows: int, columns: int) -> CFA:
        """Give the pattern of the mosaic that starts ``rows`` lower and ``columns`` further right."""
        cell = [self.value[:2], self.value[2:]]

        colours = ""
        for i in (0, 1):
            for j in (0, 1):
                colours += cell[(i + rows) % 2][(j + columns) % 2]
        return CFA(colours)

    def turn(self, view: int) -> CFA:
        """Give the pattern after :func:`turn` of a mosaic with even sides."""
        cell = torch.arange(4).reshape(1, 1, 2, 2)
        return CFA("".join(self.value[k] for k in turn(cell, view).flatten().tolist()))

    def shift_to(self, other: CFA) -> tuple[int, int]:
        """Find (rows, columns) in {0, 1} with ``self.shift(rows, columns) == other``."""
        red_row, red_column = self.sites[0]
        other_row, other_column = other.sites[0]
        return (red_row + other_row) % 2, (red_column + other_column) % 2


def noise_variance(raw: Tensor, shot_var: float | Tensor, read_var: float | Tensor) -> Tensor:
    """Compute ``shot_var max(raw, 0) + read_var`` for RAW of any shape, white = 1; the levels broadcast."""
    return raw.clamp_min(0.0) * shot_var + read_var


def require_even(height: int, width: int) -> None:
    """Raise ValueError unless both sides of a Bayer mosaic are even and at least 2."""
    if height % 2 or width % 2:
        raise ValueError(f"a Bayer mosaic must have even sides, got {height} x {width}; crop the last row or column")
    if min(height, width) < 2:
        raise ValueError(f"a Bayer mosaic must be at least 2 x 2, got {height} x {width}")


def require_channels(image: Tensor, channels: int, what: str) -> None:
    """Raise ValueError, naming ``what`` it is, unless an image is ``(..., channels, H, W)``."""
    if image.ndim < 3 or image.shape[-3] != channels:
        raise ValueError(f"{what} must have shape (..., {channels}, H, W), got {tuple(image.shape)}")


def pack(mosaic: Tensor, cfa: CFA | str) -> Tensor:
    """Pack a mosaic ``(..., 1, H, W)`` to R, Gr, Gb, B ``(..., 4, H/2, W/2)``; raise ValueError if a side is odd."""
    require_channels(mosaic, 1, "a mosaic")
    require_even(*mosaic.shape[-2:])

    plane = mosaic[..., 0, :, :]
    return torch.stack([plane[..., i::2, j::2] for i, j in CFA(cfa).sites], dim=-3)


def unpack(packed: Tensor, cfa: CFA | str) -> Tensor:
    """Unpack planes ``(..., 4, H/2, W/2)`` to the mosaic ``(..., 1, H, W)``, the inverse of :func:`pack`."""
    require_channels(packed, 4, "packed RAW")
    *lead, _, height, width = packed.shape
    require_even(2 * height, 2 * width)

    mosaic = packed.new_empty(*lead, 1, 2 * height, 2 * width)
    for k, (i, j) in enumerate(CFA(cfa).sites):
        mosaic[..., 0, i::2, j::2] = packed[..., k, :, :]
    return mosaic


def pack_if_bayer(mosaic: Tensor, cfa: CFA | str) -> Tensor:
    """Apply :func:`pack` to a mosaic ``(..., 1, H, W)`` of a Bayer pattern; one of another pattern stays as it is."""
    if cfa in CFA.__members__:
        return pack(mosaic, cfa)
    return mosaic


def unpack_if_packed(image: Tensor, cfa: CFA | str) -> Tensor:
    """Unpack packed RAW ``(..., 4, H/2, W/2)`` by :func:`unpack`; a mosaic or full colour stays as it is."""
    if image.shape[-3] == _PLANES:
        return unpack(image, cfa)
    return image


def sites_per_value(image: Tensor) -> int:
    """Count the sites of the mosaic that a value stands for along each side of ``(..., C, H, W)``: 2 in packed RAW."""
    return 2 if image.shape[-3] == _PLANES else 1


def pack_rgb(rgb: Tensor, cfa: CFA | str) -> Tensor:
    """Pack full colour ``(..., 3, H, W)`` into planes ``(..., 4, H/2, W/2)``: each site keeps only its own colour."""
    require_channels(rgb, 3, "an RGB image")
    require_even(*rgb.shape[-2:])

    planes = []
    for channel, (i, j) in zip((0, 1, 1, 2), CFA(cfa).sites, strict=True):
        planes.append(rgb[..., channel, i::2, j::2])
    return torch.stack(planes, dim=-3)


def mosaic(rgb: Tensor, cfa: CFA | str) -> Tensor:
    """Mosaic full colour ``(..., 3, H, W)`` to ``(..., 1, H, W)``, stage f6 reversed: a site keeps its own colour."""
    return unpack(pack_rgb(rgb, cfa), cfa)


def turn(image: Tensor, view: int) -> Tensor:
    """Flip or turn an image ``(..., H, W)`` in one of eight ways; a mosaic's pattern moves along.

    ``view`` is in [0, 8): bit 2 transposes first, bit 1 then flips the rows, bit 0 the columns. View 0 is the identity,
    3 the half turn, 5 and 6 are the quarter turns to the right and to the left.
    """
    if not 0 <= view < N_VIEWS:
        raise ValueError(f"view must be in [0, {N_VIEWS}), got {view}")

    if view & 4:
        image = image.transpose(-2, -1)

    axes = []
    if view & 2:
        axes.append(-2)
    if view & 1:
        axes.append(-1)
    if not axes:
        return image
    return image.flip(axes)


def turn_back(image: Tensor, view: int) -> Tensor:
    """Undo :func:`turn` of the same ``view`` on an image ``(..., H, W)``."""
    image = turn(image, view & 3)
    if view & 4:
        image = image.transpose(-2, -1)
    return image


def crop(raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
    """Crop a Bayer mosaic ``(..., H, W)`` and keep its pattern.

    Args:
        raw: the mosaic.
        top, left: the first row and column, even.
        height, width: the size of the crop, even.

    Raises:
        ValueError: if a number is odd, which would move the pattern, or the crop extends beyond the mosaic.
    """
    if any(value % 2 for value in (top, left, height, width)):
        raise ValueError(f"offset ({top}, {left}) and size {height} x {width} must be even to keep the CFA")
    return crop_window(raw, top, left, height, width)


def crop_window(raw: Tensor, top: int, left: int, height: int, width: int) -> Tensor:
    """Crop ``raw`` ``(..., H, W)`` at ``top``, ``left`` to ``height`` x ``width``; raise ValueError outside it."""
    sides = tuple(raw.shape[-2:])
    if min(top, left) < 0 or min(height, width) < 1 or top + height > sides[0] or left + width > sides[1]:
        raise ValueError(f"crop {height} x {width} at ({top}, {left}) extends beyond the mosaic {sides}")
    return raw[..., top : top + height, left : left + width]


def bin_mosaic(raw: Tensor, cfa: CFA | str, factor: int, together: bool = False) -> Tensor:
    """Bin a mosaic: each new site is the mean of its colour around its place.

    The mean is over 2 ``factor`` pixels of the old mosaic either way, which are ``factor`` sites of a colour, about the
    centre of the new site. With an even factor, a site at the window's end counts by the part of it that is inside. The
    sites of the new mosaic are therefore as far apart as a sensor's, and demosaicing finds edges where they are. The
    pattern stays, and independent noise keeps :func:`bin_mosaic_variance` of its variance. Beyond the border the last
    sites are repeated.

    Args:
        raw: ``(..., 1, H, W)``, sides multiples of 2 ``factor``.
        cfa: its pattern, one of Bayer's.
        factor: factor by which the sides shrink.
        together: take the means of a new cell's four sites around the cell's centre. A pixel of full colour needs this,
            so that the colours of its ground truth are in register.

    Returns:
        ``(..., 1, H / factor, W / factor)``.

    Raises:
        ValueError: if the CFA is not Bayer's, or a side is not such a multiple.

    Example:
        >>> bin_mosaic(torch.rand(1, 16, 24), "GRBG", 4).shape
        torch.Size([1, 4, 6])
    """
    height, width = raw.shape[-2:]
    if factor < 1 or height % (2 * factor) or width % (2 * factor):
        raise ValueError(f"a mosaic of {(height, width)} cannot be binned by {factor}; use multiples of 2 factor")
    CFA(cfa)  # any Bayer pattern will do: each of its 2 x 2 sites is averaged with its own kind

    return unpack(bin_packed(pack(raw, CFA.RGGB), factor, together), CFA.RGGB)


def bin_packed(packed: Tensor, factor: int, together: bool = False) -> Tensor:
    """Bin as :func:`bin_mosaic` does: packed RGGB ``(..., 4, h, w)`` to ``(..., 4, h / factor, w / factor)``."""
    reach = _window_offset(factor, together)

    binned = []
    for plane, (i, j) in zip(packed.unbind(-3), CFA.RGGB.sites, strict=True):
        rows = _window_means(plane, -2, factor, (2 * i - 1) * reach)
        binned.append(_window_means(rows, -1, factor, (2 * j - 1) * reach))
    return torch.stack(binned, -3)


def bin_mosaic_variance(factor: int, together: bool = False) -> float:
    """Return the variance that :func:`bin_mosaic` leaves of independent noise of variance 1, about ``1 / factor^2``."""
    part = _window_offset(factor, together) % 1
    return ((factor - 1 + part**2 + (1 - part) ** 2) / factor**2) ** 2


def _window_offset(factor: int, together: bool) -> float:
    """Compute how far the windows of a cell's sites lie from its middle, in sites of a colour."""
    if together:
        return -0.25
    return (factor - 1) / 4


def _window_means(plane: Tensor, axis: int, factor: int, move: float) -> Tensor:
    """Average windows of ``factor`` sites of one colour, moved by ``move`` of its sites."""
    first = math.floor(move)
    axis %= plane.ndim  # from here on, no size is taken as a number, which an exported network would keep
    sites = torch.arange(plane.shape[axis], device=plane.device)

    def means(start: int) -> Tensor:
        inside = torch.minimum((sites + start).clamp_min(0), sites[-1:])
        total = plane.index_select(axis, inside[::factor])
        for k in range(1, factor):  # torch.mean is slow where a window is short and its values adjoin
            total += plane.index_select(axis, inside[k::factor])
        return total / factor

    return torch.lerp(means(first), means(first + 1), move % 1)


def crop_to_cfa(mosaic: Tensor, cfa: CFA, target: CFA) -> Tensor:
    """Crop a mosaic ``(..., H, W)`` so that its pattern ``cfa`` reads as ``target``; sides stay even."""
    rows, columns = cfa.shift_to(target)
    height, width = mosaic.shape[-2:]
    return mosaic[..., rows : height - rows, columns : width - columns]
