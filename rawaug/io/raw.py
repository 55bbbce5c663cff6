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

from rawaug.errors import extra
from rawaug.io.cells import (
    MONOCHROME,
    add_line_levels,
    even_sides,
    from_area,
    is_monochrome,
    mean_levels,
    monochrome_levels,
    normalise,
    read_cell,
    read_cell_levels,
)
from rawaug.io.ciff import read_crw_exposure
from rawaug.io.content import RAW_EXTENSIONS as RAW_EXTENSIONS
from rawaug.io.gain_map import GainMap, parse_gain_maps
from rawaug.io.libraw import caught_stderr, opened_raw
from rawaug.io.opcodes import OPCODE_LIST_2, OPCODE_LIST_3, move_opcodes
from rawaug.io.tiff import MAKE, MODEL, TiffTags, read_floats

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
        return _read_frame(path, raw, tags, monochrome)


def develop(path: str | Path, adjust_maximum_thr: float = 0.0) -> Tensor:
    """Render a file by LibRaw, uint8 ``(3, H, W)``, even a monochrome one; see :func:`read_raw_and_develop`."""
    with opened_raw(Path(path)) as (raw, _):
        pixels = _render(raw, adjust_maximum_thr)

    height, width = even_sides(pixels)
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
        frame = _read_frame(path, raw, tags)  # before rendering, which may change LibRaw's white level
        pixels = _render(raw, adjust_maximum_thr)

    height, width = frame.mosaic.shape[-2:]
    if even_sides(pixels) != (height, width):
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


def _read_frame(path: Path, raw: Any, tags: TiffTags, monochrome: bool = False) -> RawFrame:
    # The pattern and its black levels, by cell and by site.
    cfa: str = MONOCHROME
    if monochrome and is_monochrome(raw):
        black = monochrome_levels(raw, tags)
        level = float(black.mean())
        levels = (level, level, level, level)
    else:
        cell, cfa = read_cell(path, raw, tags)
        cell_levels = read_cell_levels(raw, cell, tags)
        black = add_line_levels(path, raw, cell_levels, tags)
        levels = mean_levels(cell_levels, cfa)

    # The digital numbers; LibRaw would turn floating point into integers of 14 bits.
    sizes = raw.sizes
    numbers, white = raw.raw_image_visible, float(raw.white_level)
    if tags.floating:
        height, width = numbers.shape
        top, left = sizes.top_margin, sizes.left_margin
        numbers, white = read_floats(path)[top : top + height, left : left + width], tags.white or 1.0
    if not white > black.max():
        raise ValueError(f"{path}: white level {white:g} is not above black level {black.max():g}")

    # LibRaw takes numbers that EXIF does not know for turns.
    orientation = int(sizes.flip)
    if tags.orientations and not set(range(1, 9)).intersection(tags.orientations):
        orientation = 0

    colours = {"color_known": False} if cfa == MONOCHROME else _read_colours(raw)
    iso = float(getattr(getattr(raw, "other", None), "iso_speed", 0))  # rawpy 0.27 or newer
    return RawFrame(
        mosaic=normalise(numbers, black, white),
        cfa=cfa,
        black=levels,
        white=white,
        camera=_camera_name(raw, tags),
        iso=iso or None,
        noise_profile=tags.noise_profile,
        orientation=orientation,
        name=path.stem,
        gain_maps=_gain_maps(path, raw, tags),
        exposure=_read_exposure(path, raw),
        remarks=(f"NoiseProfile {tags.noise_fault}",) if tags.noise_fault else (),
        offset=(sizes.top_margin, sizes.left_margin),
        crop=_crop(raw, tags),
        floating=tags.floating,
        **colours,
    )


def _read_colours(raw: Any) -> dict[str, Any]:
    """Read the gains and the matrix, as attributes of a frame, and whether the matrix is this camera's."""
    with np.errstate(all="raise"):
        matrix, color_known = _color_matrix(raw)
    daylight = raw.daylight_whitebalance
    has_gains = min(raw.camera_whitebalance[:3]) > 0
    white_balance = _green_is_1(raw.camera_whitebalance if has_gains else daylight)
    return {
        "white_balance": white_balance,
        "daylight": _green_is_1(daylight) if color_known else white_balance,
        "color_matrix": torch.from_numpy(matrix).float(),
        "color_known": color_known,
    }


def _gain_maps(path: Path, raw: Any, tags: TiffTags) -> tuple[GainMap, ...]:
    """Read the gain maps of a DNG, moved from its active area to the mosaic."""
    if tags.area is None:
        return ()

    top, left, bottom, right = tags.area
    shift = from_area(raw, tags)
    gain_maps: tuple[GainMap, ...] = ()
    for number, code in ((2, OPCODE_LIST_2), (3, OPCODE_LIST_3)):
        if code not in tags.opcodes:
            continue
        try:
            parse_gain_maps(tags.opcodes[code], on_mosaic=number == 2)
            moved, _ = move_opcodes(
                tags.opcodes[code], shift, (bottom - top, right - left), even_sides(raw.raw_image_visible)
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

    rows, columns = even_sides(raw.raw_image_visible)
    bottom = min(top + height - sizes.top_margin, rows)
    right = min(left + width - sizes.left_margin, columns)
    top, left = max(0.0, top - sizes.top_margin), max(0.0, left - sizes.left_margin)
    if bottom - top < _SMALLEST_CROP * rows or right - left < _SMALLEST_CROP * columns:
        return None
    return top, left, bottom - top, right - left


def _read_exposure(path: Path, raw: Any) -> Exposure:
    """Read the exposure that the file states; 0, the year 1970 and absurd values mean unknown.

    LibRaw gives the exposure that a CRW's automatic mode aimed at; the camera's actual one is in its ShotInfo.
    """
    shot = getattr(raw, "other", None)  # rawpy 0.27 or newer
    seconds, f_number = read_crw_exposure(path)
    seconds = _plausible(seconds) or _plausible(getattr(shot, "shutter_speed", 0))
    f_number = _plausible(f_number) or _plausible(getattr(shot, "aperture", 0))
    focal_length = _plausible(getattr(shot, "focal_length", 0))

    date = None
    timestamp = getattr(shot, "timestamp", None)
    if timestamp is not None and timestamp.year > 1970:
        date = f"{timestamp:%Y:%m:%d %H:%M:%S}"
    return Exposure(seconds, f_number, focal_length, date)


def _plausible(number: float | None) -> float | None:
    """Return a positive number of a moderate size, and None for others."""
    if number is None or not 0 < number < _LARGEST_NUMBER:
        return None
    return float(number)


def _camera_name(raw: Any, tags: TiffTags) -> str:
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


def _green_is_1(gains: Sequence[float]) -> tuple[float, float, float]:
    if not all(0 < gain < np.inf for gain in gains[:3]):
        raise ArithmeticError(f"multipliers {', '.join(f'{gain:g}' for gain in gains[:3])}")
    return float(gains[0] / gains[1]), 1.0, float(gains[2] / gains[1])


def _color_matrix(raw: Any) -> tuple[np.ndarray, bool]:
    """Find the file's matrix, else LibRaw's for the model, else a typical one; tell whether it is known."""
    stated = np.asarray(raw.color_matrix, np.float64)[:, :3]
    if stated.any():
        return stated / stated.sum(axis=1, keepdims=True), True

    camera = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3] @ XYZ_FROM_SRGB
    if not camera.any():
        return _TYPICAL_COLOR_MATRIX, False
    return np.linalg.inv(camera / camera.sum(axis=1, keepdims=True)), True
