r"""The cell that repeats over a mosaic: its pattern and its black levels, and the mosaic that they normalise.

    y = min((d - black) / (white - black), 1)

LibRaw knows cells of 2 x 2 and 6 x 6 and whole levels. A DNG's tags also state cells of 4 x 4, fractions, and levels of
rows and columns; both count from its active area, of which LibRaw may leave out the first row and column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA, pattern_name, plane_indices
from rawaug.errors import count_of
from rawaug.io.libraw import KNOWN_PATTERNS, is_stack
from rawaug.io.tiff import TiffTags

MONOCHROME = "MONOCHROME"
"""A sensor without colour filters has this pattern."""


def read_cell(path: Path, raw: Any, tags: TiffTags) -> tuple[np.ndarray, str]:
    """Read LibRaw's colour indices ``(n, n)`` of the visible mosaic's top left cell, and the pattern's name.

    0 to 3 are R, G, B, G. LibRaw knows no cells of 4 x 4, so those of Quad-Bayer come from the tags.
    """
    cell = np.empty((0, 0), int)
    if not is_stack(raw):
        cell = _stated_cell(raw, tags)

    colours = raw.color_desc.decode("ascii", "replace")
    name = None
    if colours == "RGBG":
        rows = []
        for row in cell:
            rows.append("".join(colours[index] for index in row))
        name = pattern_name(rows)
    if name is None or (len(cell) == 2 and set(cell.flat) != {0, 1, 2, 3}):
        raise ValueError(f"{path}: has no mosaic of a known pattern but {_kind(raw)}; {KNOWN_PATTERNS}")

    if len(cell) == 2:
        name = CFA(name)
    return cell, name


def _stated_cell(raw: Any, tags: TiffTags) -> np.ndarray:
    """Read the cell of a mosaic; return an empty one if there is none that could be known."""
    if tags.cfa is not None and len(tags.cfa) == 4:
        indices = []
        for row in tags.cfa:
            indices.append(["RGB".index(colour) for colour in row])
        rows, columns = from_area(raw, tags)
        return np.roll(np.array(indices), (-rows, -columns), axis=(0, 1))

    if raw.raw_pattern is not None and raw.raw_pattern.shape in ((2, 2), (6, 6)):
        size = len(raw.raw_pattern)
        rows_of_tag = tags.cfa or ()
        if rows_of_tag[size:] == rows_of_tag[:-size]:  # rawpy sees only the first two of 8 rows
            return np.asarray(raw.raw_colors_visible[:size, :size])
    return np.empty((0, 0), int)


def _kind(raw: Any) -> str:
    """Describe what a file holds instead of a mosaic that is known."""
    if is_stack(raw):
        return "full colour at every pixel (linear DNG, small RAW, Foveon)"
    pattern = raw.raw_pattern
    if is_monochrome(raw) or pattern is None or len(set(pattern.flat)) == 1:
        return "a monochrome picture"
    return f"a mosaic of other colours ({raw.color_desc.decode()}, cell {pattern.shape[0]} x {pattern.shape[1]})"


def is_monochrome(raw: Any) -> bool:
    """Tell whether a file is from a sensor without colour filters."""
    return not is_stack(raw) and raw.num_colors == 1


def read_cell_levels(raw: Any, cell: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Find the black levels of a cell that repeats over the mosaic: LibRaw's whole numbers or the tags' exact ones.

    For a DNG whose levels repeat in other steps than its colours, the cell is the smallest that both fill.
    """
    # if a DNG's active area begins at an odd row or column, LibRaw leaves that one out and gives the remaining sites
    # the levels of their neighbours
    per_channel = np.asarray(raw.black_level_per_channel, np.float32)
    levels = per_channel[cell]
    if tags.floating:
        levels = np.zeros_like(levels)
    if tags.black is None:
        return levels

    rows = math.lcm(len(cell), tags.black.shape[0])
    columns = math.lcm(len(cell), tags.black.shape[1])
    exact = _tiled(tags.black.astype(np.float32), rows, columns)

    # LibRaw also rounds the means of rows and columns
    allowed = 2 if tags.black_rows or tags.black_columns else 1
    if exact.shape == (2, 2) and np.abs(exact - levels).max() >= allowed and not tags.floating:
        return levels

    first_row, first_column = _left_out(raw, tags)
    return np.roll(exact, (-first_row, -first_column), axis=(0, 1))


def monochrome_levels(raw: Any, tags: TiffTags) -> np.ndarray:
    """Find the black levels of a sensor without colour filters: those of the tags, or LibRaw's."""
    if tags.black is not None:
        return tags.black.astype(np.float32)
    if tags.floating:
        return np.zeros((1, 1), np.float32)
    return np.full((1, 1), raw.black_level_per_channel[0], np.float32)


def add_line_levels(path: Path, raw: Any, levels: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Find levels ``(H, W)`` of a DNG whose rows or columns have their own, else return those of the cell."""
    if not (tags.black_rows or tags.black_columns):
        return levels

    height, width = raw.raw_image_visible.shape
    first_row, first_column = _left_out(raw, tags)
    rows = _line_levels(path, tags.black_rows, first_row, height)
    columns = _line_levels(path, tags.black_columns, first_column, width)
    return np.asarray(_tiled(levels, height, width) + rows[:, None] + columns)


def _line_levels(path: Path, levels: Sequence[float], first: int, count: int) -> np.ndarray:
    """Find the levels ``(count,)`` of the visible rows or columns; they are zeros if the file states none."""
    if not levels:
        return np.zeros(count, np.float32)
    if len(levels) != first + count:
        lengths = f"black levels of {count_of(len(levels), 'line')}, not {first + count}"
        raise OSError(f"{path}: its TIFF tags are damaged ({lengths})")
    return np.array(levels, np.float32)[first:]


def from_area(raw: Any, tags: TiffTags) -> tuple[int, int]:
    """Count the rows and columns from the active area's origin to that of the visible mosaic."""
    top, left = (0, 0) if tags.area is None else tags.area[:2]
    return raw.sizes.top_margin - top, raw.sizes.left_margin - left


def _left_out(raw: Any, tags: TiffTags) -> tuple[int, int]:
    """Count the rows and columns of a DNG's active area before the visible mosaic, 0 or 1 of each."""
    rows, columns = from_area(raw, tags)
    if {rows, columns} <= {0, 1}:
        return rows, columns
    return 0, 0


def _tiled(cell: np.ndarray, height: int, width: int) -> np.ndarray:
    """Repeat a cell to ``(height, width)``."""
    rows, columns = cell.shape
    return np.tile(cell, (-(-height // rows), -(-width // columns)))[:height, :width]


def mean_levels(black: np.ndarray, cfa: str) -> tuple[float, float, float, float]:
    """Average a cell's levels to those of R, Gr, Gb, B; if all greens are one, their mean comes twice."""
    kinds = _tiled(plane_indices(cfa).numpy(), *black.shape)
    means = {}
    for kind in np.unique(kinds).tolist():
        means[kind] = float(black[kinds == kind].mean())
    return means[0], means[1], means.get(2, means[1]), means[3]


def normalise(numbers: np.ndarray, black: np.ndarray, white: float) -> Tensor:
    """Convert digital numbers ``(H, W)`` to RAW float32 ``(1, H, W)``; ``black`` is a cell's, or ``(H, W)``."""
    height, width = even_sides(numbers)
    numbers = numbers[:height, :width]
    if black.shape != (2, 2):
        levels = _tiled(black, height, width)
        mosaic = np.minimum((numbers - levels) / (white - levels), 1, dtype=np.float32)
        return torch.from_numpy(mosaic[None])

    cells = numbers.astype(np.float32).reshape(height // 2, 2, width // 2, 2)
    cells -= black[None, :, None, :]
    cells /= (white - black)[None, :, None, :]
    np.minimum(cells, 1, out=cells)
    return torch.from_numpy(cells.reshape(1, height, width))


def even_sides(pixels: np.ndarray) -> tuple[int, int]:
    """Compute height and width of ``(H, W, ...)`` without the last line of an odd side."""
    height, width = pixels.shape[:2]
    return height // 2 * 2, width // 2 * 2
