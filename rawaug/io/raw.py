r"""RAW files, through LibRaw: the mosaic as the sensor gave it, and LibRaw's own rendering of it.

    y = min((d - black) / (white - black), 1)

where d is a digital number and black is the level of its site. Black becomes 0 and white becomes 1, and nothing is
clipped at black, since that would bias the noise in the shadows. Colour follows dcraw's convention: ``color_matrix`` M
takes white-balanced camera colour to linear sRGB and keeps grey (each row sums to 1), so that ``rgb = M
diag(white_balance) camera``. With a matrix X from XYZ to the camera (LibRaw's table, a DNG's ColorMatrix) M is the
inverse of X S with its rows scaled to sum 1, where S takes linear sRGB to XYZ (IEC 61966-2-1).

A monochrome sensor has no colours: its frame has one level, gains of 1 and the matrix of ones on the diagonal.

The mosaic and the rendering are both in the sensor's orientation, and agree pixel for pixel.
"""

from __future__ import annotations

import math
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from rawaug.bayer import CFA, pattern_name, plane_indices
from rawaug.errors import count_of, extra
from rawaug.io.ciff import read_shot_info
from rawaug.io.content import RAW_EXTENSIONS as RAW_EXTENSIONS
from rawaug.io.gain_map import GainMap, parse_gain_maps
from rawaug.io.libraw import KNOWN_PATTERNS, caught_stderr, is_stack, opened_raw
from rawaug.io.opcodes import OPCODE_LIST_2, OPCODE_LIST_3, move_opcodes
from rawaug.io.tiff import MAKE, MODEL, TiffTags, read_floats

MONOCHROME = "MONOCHROME"
"""A sensor without colour filters has this pattern."""

XYZ_FROM_SRGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_TYPICAL_COLOR_MATRIX = np.array([[1.60, -0.45, -0.15], [-0.25, 1.60, -0.35], [0.00, -0.50, 1.50]])

_LARGEST_NUMBER = 1e6
"""Plausible exposure times, f-numbers and focal lengths are at most this."""

_RENDERING = {"use_camera_wb": True, "no_auto_bright": True, "output_bps": 8, "user_flip": 0}

_rendering_process: int | None = None
"""This process started LibRaw's OpenMP threads, which a fork does not have; LibRaw would wait for them."""


@dataclass(frozen=True)
class Exposure:
    """How a shot was taken; a value is None if the file does not say."""

    seconds: float | None = None
    f_number: float | None = None
    focal_length: float | None = None
    date: str | None = None


UNKNOWN = Exposure()


@dataclass(frozen=True)
class RawFrame:
    """A mosaic, and what its file states about it.

    Attributes:
        mosaic: float32 ``(1, H, W)``, with even sides (the last line of an odd side is left out).
        cfa: the pattern of ``mosaic``: a :class:`rawaug.bayer.CFA`, or the name of another of
            :func:`rawaug.bayer.pattern`, X-Trans or Quad-Bayer from any origin; or :data:`MONOCHROME`.
        black: levels of the sites R, Gr, Gb, B, in digital numbers, with a DNG's fractions; other patterns have one
            for all greens.
        white: the saturated level, in digital numbers.
        white_balance: as-shot multipliers of R, G, B, with green at 1; LibRaw's daylight ones if the file has none.
        daylight: the multipliers for the white of sRGB (D65), with green at 1.
        color_matrix: float32 ``(3, 3)``, white-balanced camera colour to linear sRGB, rows summing to 1: the one that
            LibRaw renders with, or a typical camera's if neither the file nor LibRaw has one.
        camera: make and model, or ``"unknown"``.
        iso: None if unknown.
        noise_profile: (shot_var, read_var) that the file states (for a DNG's NoiseProfile, the mean over planes); None
            if it states none.
        orientation: LibRaw's flip: 0, or a sum of 1 (columns reversed), 2 (rows reversed), 4 (transposed last).
        name: the file's name without extension.
        color_known: False if ``color_matrix`` is not this camera's.
        gain_maps: a DNG's correction of the lens shading, which is not applied to ``mosaic``.
        exposure: seconds, f-number, focal length in mm and EXIF date, each None if unknown.
        remarks: statements of the file that cannot be right and are not used, a clause each.
        offset: rows and columns of the sensor, as the file stores it, above ``mosaic`` and to its left; None if
            unknown.
        crop: top, left, height and width of the picture within ``mosaic`` that the file states; None if it states none.
        floating: whether the digital numbers are floating point.
    """

    mosaic: Tensor
    cfa: str
    black: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    white: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    daylight: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color_matrix: Tensor = field(default_factory=lambda: torch.eye(3))
    camera: str = "unknown"
    iso: float | None = None
    noise_profile: tuple[float, float] | None = None
    orientation: int = 0
    name: str = ""
    color_known: bool = True
    gain_maps: tuple[GainMap, ...] = ()
    exposure: Exposure = UNKNOWN
    remarks: tuple[str, ...] = ()
    offset: tuple[int, int] | None = None
    crop: tuple[float, float, float, float] | None = None
    floating: bool = False

    @property
    def upright_view(self) -> int:
        """The view of :func:`rawaug.bayer.turn` that shows the frame upright."""
        if not self.orientation & 4:
            return self.orientation
        # `turn` transposes first, so the two flips change places
        return 4 | (self.orientation & 1) << 1 | (self.orientation & 2) >> 1


def read_raw(path: str | Path, monochrome: bool = False) -> RawFrame:
    """Read a RAW file with a mosaic of Bayer's, X-Trans or Quad-Bayer.

    Args:
        path: the file.
        monochrome: also take RAW of sensors without colour filters.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if LibRaw cannot read it, or it is truncated or damaged inside.
        ValueError: if it has no such mosaic (Foveon, linear or monochrome RAW, other colours).
    """
    path = Path(path)
    with opened_raw(path) as (raw, tags):
        if monochrome and is_monochrome(raw):
            return _monochrome_frame(path, raw, tags)
        return _mosaic_frame(path, raw, tags)


def develop(path: str | Path, adjust_maximum_thr: float = 0.0) -> Tensor:
    """Render a file by LibRaw, uint8 ``(3, H, W)``, even a monochrome one; see :func:`read_raw_and_develop`."""
    with opened_raw(Path(path)) as (raw, _):
        pixels = _render(raw, adjust_maximum_thr)

    height, width = _even_sides(pixels)
    return _picture(pixels, height, width)


def read_raw_and_develop(path: str | Path, adjust_maximum_thr: float = 0.0) -> tuple[RawFrame, Tensor]:
    """Read a RAW file and render it, uint8 ``(3, H, W)`` of the mosaic's size, not turned upright.

    The rendering has the camera's white balance, no automatic brightness, and LibRaw's default tone curve (that of
    BT.709). ``adjust_maximum_thr`` above 0 lets LibRaw scale a frame by its own maximum if that exceeds this part of
    white (its default is 0.75), which is a digital gain that is not recorded in the file.

    LibRaw renders with OpenMP, whose threads do not survive a fork. A process forked from one that has rendered, such
    as a DataLoader's worker, therefore renders on one thread.

    Raises:
        FileNotFoundError, OSError, ValueError: as :func:`read_raw`.
    """
    path = Path(path)
    with opened_raw(path) as (raw, tags):
        frame = _mosaic_frame(path, raw, tags)  # before rendering, which may change LibRaw's white level
        pixels = _render(raw, adjust_maximum_thr)

    height, width = frame.mosaic.shape[-2:]
    if _even_sides(pixels) != (height, width):
        raise ValueError(f"{path}: LibRaw renders {pixels.shape[:2]} from a mosaic of {height} x {width}")
    return frame, _picture(pixels, height, width)


def _render(raw: Any, adjust_maximum_thr: float) -> np.ndarray:
    """Render a file by LibRaw, uint8 ``(H, W, 3)``, or with one channel if it is monochrome."""
    global _rendering_process
    if _rendering_process is None:
        _rendering_process = os.getpid()

    threads = None if _rendering_process == os.getpid() else 1
    with threadpool_limits(threads, "openmp"):
        return np.asarray(raw.postprocess(adjust_maximum_thr=adjust_maximum_thr, **_RENDERING))


def _even_sides(pixels: np.ndarray) -> tuple[int, int]:
    """Compute height and width of ``(H, W, ...)`` without the last line of an odd side."""
    height, width = pixels.shape[:2]
    return height // 2 * 2, width // 2 * 2


def _picture(pixels: np.ndarray, height: int, width: int) -> Tensor:
    picture = torch.from_numpy(pixels[:height, :width]).permute(2, 0, 1)
    return picture.expand(3, height, width).contiguous()


def read_preview(path: str | Path) -> bytes | np.ndarray | None:
    """Read the largest preview in a RAW file: a JPEG, or uint8 ``(H, W, 3)``; return None if there is none."""
    with extra("raw"):
        import rawpy

    with opened_raw(Path(path), unpack=False) as (raw, _):
        try:
            with caught_stderr():
                preview = raw.extract_thumb()
        except rawpy.LibRawError:
            return None
        data = preview.data

    if isinstance(data, bytes):
        return data
    return np.array(data)


# -- what a file states ------------------------------------------------------------------------------------------------


def _mosaic_frame(path: Path, raw: Any, tags: TiffTags) -> RawFrame:
    cell, cfa = _cell(path, raw, tags)
    black = _black_levels(path, raw, cell, tags)
    numbers, white = _numbers(path, raw, tags)
    if not white > black.max():
        raise ValueError(f"{path}: white level {white:g} is not above black level {black.max():g}")

    with np.errstate(all="raise"):
        matrix, color_known = _color_matrix(raw)

    white_balance = _white_balance(raw)
    daylight = white_balance
    if color_known:
        daylight = _green_is_1(raw.daylight_whitebalance)

    return RawFrame(
        mosaic=_normalised(numbers, black, white),
        cfa=cfa,
        black=_mean_levels(_cell_levels(raw, cell, tags), cfa),
        white=white,
        white_balance=white_balance,
        daylight=daylight,
        color_matrix=torch.from_numpy(matrix).float(),
        color_known=color_known,
        **_about_the_shot(path, raw, tags),
    )


def is_monochrome(raw: Any) -> bool:
    """Tell whether a file is from a sensor without colour filters."""
    return not is_stack(raw) and raw.num_colors == 1


def _monochrome_frame(path: Path, raw: Any, tags: TiffTags) -> RawFrame:
    black = np.full((1, 1), raw.black_level_per_channel[0], np.float32)
    if tags.black is not None:
        black = tags.black.astype(np.float32)

    elif _is_floating(tags):
        black = np.zeros((1, 1), np.float32)

    numbers, white = _numbers(path, raw, tags)
    if not white > black.max():
        raise ValueError(f"{path}: white level {white:g} is not above black level {black.max():g}")

    level = float(black.mean())
    return RawFrame(
        mosaic=_normalised(numbers, black, white),
        cfa=MONOCHROME,
        black=(level, level, level, level),
        white=white,
        color_known=False,
        **_about_the_shot(path, raw, tags),
    )


def _about_the_shot(path: Path, raw: Any, tags: TiffTags) -> dict[str, Any]:
    """Collect the fields of a frame that have nothing to do with its pattern."""
    remarks: tuple[str, ...] = ()
    if tags.noise_fault:
        remarks = (f"NoiseProfile {tags.noise_fault}",)

    other = getattr(raw, "other", None)  # rawpy 0.27 or newer
    iso = float(getattr(other, "iso_speed", 0))
    return {
        "camera": camera_of(raw, tags),
        "iso": iso or None,
        "noise_profile": tags.noise_profile,
        "orientation": _orientation(raw, tags),
        "name": path.stem,
        "gain_maps": _gain_maps(path, raw, tags),
        "exposure": exposure_of(path, raw),
        "remarks": remarks,
        "offset": (raw.sizes.top_margin, raw.sizes.left_margin),
        "crop": _crop(raw, tags),
        "floating": _is_floating(tags),
    }


def _is_floating(tags: TiffTags) -> bool:
    return tags.mosaic is not None and tags.mosaic.floating


def _numbers(path: Path, raw: Any, tags: TiffTags) -> tuple[np.ndarray, float]:
    """Read the visible mosaic ``(H, W)`` and its white level: LibRaw's numbers, or the file's own floating point."""
    if not _is_floating(tags):
        return raw.raw_image_visible, float(raw.white_level)

    numbers = read_floats(path)
    height, width = raw.raw_image_visible.shape
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    return numbers[top : top + height, left : left + width], tags.white or 1.0


def _gain_maps(path: Path, raw: Any, tags: TiffTags) -> tuple[GainMap, ...]:
    """Read the gain maps of a DNG, moved from its active area to the mosaic."""
    if tags.area is None:
        return ()

    top, left, bottom, right = tags.area
    shift = _from_area(raw, tags)
    gain_maps: tuple[GainMap, ...] = ()
    for number, code in ((2, OPCODE_LIST_2), (3, OPCODE_LIST_3)):
        if code not in tags.opcodes:
            continue
        try:
            parse_gain_maps(tags.opcodes[code], on_mosaic=number == 2)
            moved, _ = move_opcodes(
                tags.opcodes[code], shift, (bottom - top, right - left), _even_sides(raw.raw_image_visible)
            )
            if moved:
                gain_maps += parse_gain_maps(moved, on_mosaic=number == 2)
        except ValueError as error:
            raise OSError(f"{path}: its TIFF tags are damaged (OpcodeList{number}: {error}); copy it again") from None
    return gain_maps


_SMALLEST_CROP = 0.5
"""A crop has at least this share of the mosaic's height and width; a smaller one is of another picture of the file."""


def _crop(raw: Any, tags: TiffTags) -> tuple[float, float, float, float] | None:
    """Find the picture within the mosaic: a DNG's default crop, or the camera's own as LibRaw reads it."""
    sizes = raw.sizes
    if tags.crop is not None and tags.area is not None:
        top, left, height, width = tags.crop
        top += tags.area[0]
        left += tags.area[1]
    else:
        top, left = float(sizes.crop_top_margin), float(sizes.crop_left_margin)
        height, width = float(sizes.crop_height), float(sizes.crop_width)

    rows, columns = _even_sides(raw.raw_image_visible)
    bottom = min(top + height - sizes.top_margin, rows)
    right = min(left + width - sizes.left_margin, columns)
    top, left = max(0.0, top - sizes.top_margin), max(0.0, left - sizes.left_margin)
    if bottom - top < _SMALLEST_CROP * rows or right - left < _SMALLEST_CROP * columns:
        return None
    return top, left, bottom - top, right - left


def _orientation(raw: Any, tags: TiffTags) -> int:
    """Find LibRaw's flip; 0 if the file states only numbers unknown to EXIF, which LibRaw takes for turns."""
    exif_orientations = range(1, 9)
    if tags.orientations and not set(exif_orientations).intersection(tags.orientations):
        return 0
    return int(raw.sizes.flip)


def exposure_of(path: Path, raw: Any) -> Exposure:
    """Read the exposure that the file states; 0, the year 1970 and absurd values mean unknown.

    LibRaw gives the exposure that a CRW's automatic mode aimed at; the camera's actual one is in its ShotInfo.
    """
    other = getattr(raw, "other", None)  # rawpy 0.27 or newer
    seconds = _plausible(getattr(other, "shutter_speed", 0))
    f_number = _plausible(getattr(other, "aperture", 0))
    focal_length = _plausible(getattr(other, "focal_length", 0))

    shot_info = read_shot_info(path)
    if shot_info is not None:
        seconds = _plausible(shot_info.seconds or 0) or seconds
        f_number = _plausible(shot_info.f_number or 0) or f_number

    date = None
    timestamp = getattr(other, "timestamp", None)
    if timestamp is not None and timestamp.year > 1970:
        date = f"{timestamp:%Y:%m:%d %H:%M:%S}"
    return Exposure(seconds, f_number, focal_length, date)


def _plausible(number: float) -> float | None:
    """Return a positive number of a moderate size, and None for others."""
    if not 0 < number < _LARGEST_NUMBER:
        return None
    return float(number)


def camera_of(raw: Any, tags: TiffTags) -> str:
    """Read make and model from the file's tags or from its thumbnail's EXIF."""
    make, model = tags.make, tags.model
    if not model:
        make, model = _thumbnail_camera(raw)

    make = str(make or "").strip()
    model = str(model or "").strip()
    if model.startswith(make):
        return model or "unknown"
    return f"{make} {model}"


def _thumbnail_camera(raw: Any) -> tuple[str | None, str | None]:
    with extra("raw"):
        import rawpy
        from PIL import Image

    try:
        thumbnail = raw.extract_thumb()
    except rawpy.LibRawError:
        return None, None
    if thumbnail.format != rawpy.ThumbFormat.JPEG:
        return None, None

    try:
        exif = Image.open(BytesIO(thumbnail.data)).getexif()
    except (OSError, SyntaxError, TypeError, ValueError, LookupError, struct.error):  # the mosaic may be whole
        return None, None
    return exif.get(MAKE), exif.get(MODEL)


# -- patterns ----------------------------------------------------------------------------------------------------------


def _cell(path: Path, raw: Any, tags: TiffTags) -> tuple[np.ndarray, str]:
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
        rows, columns = _from_area(raw, tags)
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


# -- levels ------------------------------------------------------------------------------------------------------------


def _cell_levels(raw: Any, cell: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Find the black levels of a cell that repeats over the mosaic: LibRaw's whole numbers or the tags' exact ones.

    For a DNG whose levels repeat in other steps than its colours, the cell is the smallest that both fill.
    """
    # if a DNG's active area begins at an odd row or column, LibRaw leaves that one out and gives the remaining sites
    # the levels of their neighbours
    per_channel = np.asarray(raw.black_level_per_channel, np.float32)
    levels = per_channel[cell]
    if _is_floating(tags):
        levels = np.zeros_like(levels)
    if tags.black is None:
        return levels

    rows = math.lcm(len(cell), tags.black.shape[0])
    columns = math.lcm(len(cell), tags.black.shape[1])
    exact = _tiled(tags.black.astype(np.float32), rows, columns)

    # LibRaw also rounds the means of rows and columns
    allowed = 2 if tags.black_rows or tags.black_columns else 1
    if exact.shape == (2, 2) and np.abs(exact - levels).max() >= allowed and not _is_floating(tags):
        return levels

    first_row, first_column = _left_out(raw, tags)
    return np.roll(exact, (-first_row, -first_column), axis=(0, 1))


def _black_levels(path: Path, raw: Any, cell: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Find levels ``(H, W)`` of a DNG whose rows or columns have their own, else those of a cell that repeats."""
    levels = _cell_levels(raw, cell, tags)
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


def _from_area(raw: Any, tags: TiffTags) -> tuple[int, int]:
    """Count the rows and columns from the active area's origin to that of the visible mosaic."""
    top, left = (0, 0) if tags.area is None else tags.area[:2]
    return raw.sizes.top_margin - top, raw.sizes.left_margin - left


def _left_out(raw: Any, tags: TiffTags) -> tuple[int, int]:
    """Count the rows and columns of a DNG's active area before the visible mosaic, 0 or 1 of each."""
    rows, columns = _from_area(raw, tags)
    if {rows, columns} <= {0, 1}:
        return rows, columns
    return 0, 0


def _tiled(cell: np.ndarray, height: int, width: int) -> np.ndarray:
    """Repeat a cell to ``(height, width)``."""
    rows, columns = cell.shape
    return np.tile(cell, (-(-height // rows), -(-width // columns)))[:height, :width]


def _mean_levels(black: np.ndarray, cfa: str) -> tuple[float, float, float, float]:
    """Average a cell's levels to those of R, Gr, Gb, B; if all greens are one, their mean comes twice."""
    kinds = _tiled(plane_indices(cfa).numpy(), *black.shape)
    means = {}
    for kind in np.unique(kinds).tolist():
        means[kind] = float(black[kinds == kind].mean())
    return means[0], means[1], means.get(2, means[1]), means[3]


def _normalised(numbers: np.ndarray, black: np.ndarray, white: float) -> Tensor:
    """Convert digital numbers ``(H, W)`` to RAW float32 ``(1, H, W)``; ``black`` is a cell's, or ``(H, W)``."""
    height, width = _even_sides(numbers)
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


# -- colour ------------------------------------------------------------------------------------------------------------


def _white_balance(raw: Any) -> tuple[float, float, float]:
    """Read the as-shot multipliers, or those for daylight if the file has none."""
    as_shot = raw.camera_whitebalance
    if min(as_shot[:3]) > 0:
        return _green_is_1(as_shot)
    return _green_is_1(raw.daylight_whitebalance)


def _green_is_1(gains: Sequence[float]) -> tuple[float, float, float]:
    if not all(0 < gain < np.inf for gain in gains[:3]):
        raise ArithmeticError(f"multipliers {', '.join(f'{gain:g}' for gain in gains[:3])}")
    return float(gains[0] / gains[1]), 1.0, float(gains[2] / gains[1])


def _color_matrix(raw: Any) -> tuple[np.ndarray, bool]:
    """Find the file's matrix, else LibRaw's for the model, else a typical one; tell whether it is known."""
    own = np.asarray(raw.color_matrix, np.float64)[:, :3]
    if own.any():
        return own / own.sum(axis=1, keepdims=True), True

    camera = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3] @ XYZ_FROM_SRGB
    if not camera.any():
        return _TYPICAL_COLOR_MATRIX, False
    return np.linalg.inv(camera / camera.sum(axis=1, keepdims=True)), True
