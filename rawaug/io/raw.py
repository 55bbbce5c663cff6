r"""RAW files, through LibRaw: the mosaic as the sensor gave it, and LibRaw's own rendering of it.

    y = min((d - black) / (white - black), 1)

for a digital number d and the black level of its site: black is 0, white is 1, and nothing is clipped at black, since
that would bias the noise in the shadows. Colour follows dcraw's convention: ``color_matrix`` M takes white-balanced
camera colour to linear sRGB and keeps grey (each row sums to 1), so that ``rgb = M diag(white_balance) camera``. With a
matrix X from XYZ to the camera (LibRaw's table, a DNG's ColorMatrix) M is the inverse of X S with its rows scaled to
sum 1, where S takes linear sRGB to XYZ (IEC 61966-2-1).

The mosaic and the rendering are both in the sensor's orientation, and agree pixel for pixel.
"""

from __future__ import annotations

import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits
from torch import Tensor

from rawaug.bayer import CFA, pattern_name, plane_indices
from rawaug.errors import extra
from rawaug.files import require_file
from rawaug.io.gain_map import GainMap
from rawaug.io.masked import MaskedPixels, measure_masked
from rawaug.io.pictures import require_utf8
from rawaug.io.tiff import MAKE, MODEL, TiffTags, read_tiff_tags

RAW_EXTENSIONS = (
    *(".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw"),
    *(".nef", ".nrw", ".orf", ".pef", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw"),
)

_SENSE = 1e6


@dataclass(frozen=True)
class Exposure:
    """How a shot was taken; None where the file does not say."""

    seconds: float | None = None
    f_number: float | None = None
    focal_length: float | None = None
    date: str | None = None


UNKNOWN = Exposure()


def exposure_of(raw: Any) -> Exposure:
    """Exposure as LibRaw states it; 0, the year 1970 and absurd values mean unknown."""
    other = getattr(raw, "other", None)  # rawpy 0.27 or newer
    numbers = [float(getattr(other, name, 0)) for name in ("shutter_speed", "aperture", "focal_length")]
    seconds, f_number, focal_length = (number if 0 < number < _SENSE else None for number in numbers)
    taken = getattr(other, "timestamp", None)
    date = f"{taken:%Y:%m:%d %H:%M:%S}" if taken is not None and taken.year > 1970 else None
    return Exposure(seconds, f_number, focal_length, date)


def camera_of(raw: Any, tags: TiffTags) -> str:
    """Make and model, from the file's tags or from its thumbnail's EXIF."""
    make, model = tags.make, tags.model
    if not model:
        make, model = _thumbnail_camera(raw)
    make, model = (str(name or "").strip() for name in (make, model))
    return (model if model.startswith(make) else f"{make} {model}") or "unknown"


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


XYZ_FROM_SRGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_TYPICAL_COLOR_MATRIX = np.array([[1.60, -0.45, -0.15], [-0.25, 1.60, -0.35], [0.00, -0.50, 1.50]])

MAX_PIXELS = 200_000_000
"""Larger mosaics are refused before they are decoded; the largest sensors have 150 million sites."""

_developed_in: int | None = None
"""The process that started LibRaw's OpenMP threads, which a fork does not have; LibRaw would wait for them."""


@dataclass(frozen=True)
class RawFrame:
    """A mosaic, and what its file states of it.

    Attributes:
        mosaic: float32 ``(1, H, W)``, sides even (of an odd side the last line is left out).
        cfa: the pattern of ``mosaic``: a :class:`rawaug.bayer.CFA`, or the name of another of
            :func:`rawaug.bayer.pattern`, X-Trans or Quad-Bayer from any origin.
        black: levels of the sites R, Gr, Gb, B, in digital numbers, with a DNG's fractions; other patterns have one
            for all greens.
        white: the saturated level, in digital numbers.
        white_balance: as-shot multipliers of R, G, B, green being 1; LibRaw's daylight ones where the file has none.
        daylight: the multipliers for the white of sRGB (D65), green being 1.
        color_matrix: float32 ``(3, 3)``, white-balanced camera colour to linear sRGB, rows summing to 1: the one that
            LibRaw renders with, or a typical camera's if neither the file nor LibRaw has one.
        camera: make and model, or ``"unknown"``.
        iso: None if unknown.
        noise_profile: (shot_var, read_var) that the file states (of a DNG's NoiseProfile the mean over planes); None
            if it states none.
        orientation: LibRaw's flip: 0, or a sum of 1 (columns reversed), 2 (rows reversed), 4 (transposed last).
        name: the file's name without extension.
        color_known: false where ``color_matrix`` is not this camera's.
        gain_maps: a DNG's correction of the lens shading, which is not applied to ``mosaic``.
        exposure: seconds, f-number, focal length in mm and EXIF date, each None if unknown.
        masked: what masked pixels beside the picture tell of the black level; None if there are none.
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
    masked: MaskedPixels | None = None

    @property
    def upright_view(self) -> int:
        """The view of :func:`rawaug.bayer.turn` that shows the frame upright."""
        if not self.orientation & 4:
            return self.orientation
        # `turn` transposes first: the two flips change places
        return 4 | (self.orientation & 1) << 1 | (self.orientation & 2) >> 1


def read_raw(path: str | Path) -> RawFrame:
    """Read a RAW file with a mosaic of Bayer's, X-Trans or Quad-Bayer.

    Raises:
        FileNotFoundError: if there is no such file.
        OSError: if LibRaw cannot read it, or it is truncated.
        ValueError: if it has no such mosaic (Foveon, linear or monochrome RAW, other colours).
    """
    with _opened(Path(path)) as (raw, tags):
        return _frame(Path(path), raw, tags)


def develop(path: str | Path, adjust_maximum_thr: float = 0.0) -> Tensor:
    """LibRaw's rendering, uint8 ``(3, H, W)``: see :func:`read_raw_and_develop`."""
    return read_raw_and_develop(path, adjust_maximum_thr)[1]


def read_raw_and_develop(path: str | Path, adjust_maximum_thr: float = 0.0) -> tuple[RawFrame, Tensor]:
    """Read a RAW file and render it, uint8 ``(3, H, W)`` of the mosaic's size, not turned upright.

    The rendering has the camera's white balance, no automatic brightness, and LibRaw's default tone curve (that of
    BT.709). ``adjust_maximum_thr`` above 0 lets LibRaw scale a frame by its own maximum where that exceeds this part of
    white (its default is 0.75): a digital gain that is not recorded in the file.

    LibRaw renders with OpenMP, whose threads do not survive a fork: a process forked from one that has rendered, such
    as a DataLoader's worker, renders on one thread.

    Raises:
        FileNotFoundError, OSError, ValueError: as :func:`read_raw`.
    """
    global _developed_in
    with _opened(Path(path)) as (raw, tags):
        frame = _frame(Path(path), raw, tags)  # before rendering, which may change LibRaw's white level
        forked = _developed_in not in (None, os.getpid())
        _developed_in = _developed_in or os.getpid()
        settings = {"use_camera_wb": True, "no_auto_bright": True, "output_bps": 8, "user_flip": 0}
        with threadpool_limits(1 if forked else None, "openmp"):
            pixels = raw.postprocess(adjust_maximum_thr=adjust_maximum_thr, **settings)
    height, width = frame.mosaic.shape[-2:]
    if (pixels.shape[0] // 2 * 2, pixels.shape[1] // 2 * 2) != (height, width):
        raise ValueError(f"{path}: LibRaw renders {pixels.shape[:2]} from a mosaic of {height} x {width}")
    return frame, torch.from_numpy(pixels[:height, :width]).permute(2, 0, 1).contiguous()


DEVELOPED = (b"\xff\xd8\xff", b"\x89PNG", b"RIFF", b"GIF8", b"\x00\x00\x00\x0cJXL", b"\xff\x0a")
"""How files begin that hold a picture and never RAW: JPEG, PNG, WebP, GIF, JPEG XL."""


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, TiffTags]]:
    """The unpacked file, and its TIFF tags; LibRaw's errors become one line that names the file."""
    with extra("raw"):
        import rawpy

    require_file(path, "RAW file")
    require_utf8(path)
    # rawpy warns of forks, which rendering on one thread makes safe
    warnings.filterwarnings("ignore", "rawpy is being used in a process created by", RuntimeWarning)
    try:
        with rawpy.imread(str(path)) as raw:
            tags = read_tiff_tags(path)
            size = path.stat().st_size
            if tags.mosaic_end is not None and tags.mosaic_end > size:  # LibRaw would not say what is wrong
                raise OSError(f"{path}: cannot be read as RAW: truncated, {size} of {tags.mosaic_end} bytes")
            if raw.sizes.raw_height * raw.sizes.raw_width > MAX_PIXELS:
                declared = f"{raw.sizes.raw_height} x {raw.sizes.raw_width}"
                raise ValueError(f"{path}: declares {declared} pixels, above the limit of {MAX_PIXELS}; copy it again")
            raw.unpack()
            yield raw, tags
    except rawpy.LibRawError as error:
        with path.open("rb") as file:
            if file.read(12).startswith(DEVELOPED):
                raise ValueError(f"{path}: this is a developed picture, not RAW; give the camera's RAW file") from None
        reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
        advice = "check that it is complete and from a supported camera"
        raise OSError(f"{path}: cannot be read as RAW (LibRaw: {reason}); {advice}") from error
    except NotImplementedError as error:  # rawpy's, of a mosaic without a repeating cell
        raise ValueError(f"{path}: has no mosaic of a known pattern ({error}); {_KNOWN}") from error
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise OSError(f"{path}: its white balance or colour matrix is damaged ({error}); copy it again") from error


def _frame(path: Path, raw: Any, tags: TiffTags) -> RawFrame:
    cell, cfa = _cell(path, raw, tags)
    black, white = _black(raw, cell, tags), float(raw.white_level)
    if white <= black.max():
        raise ValueError(f"{path}: white level {white:g} is not above black level {black.max():g}")
    with np.errstate(all="raise"):
        matrix, color_known = _color_matrix(raw)
    white_balance = _white_balance(raw)
    other = getattr(raw, "other", None)  # rawpy 0.27 or newer
    return RawFrame(
        mosaic=_normalised(raw.raw_image_visible, _black_of_sites(path, raw, black, tags), white),
        cfa=cfa,
        black=_of_planes(black, cfa),
        white=white,
        white_balance=white_balance,
        daylight=_green_is_1(raw.daylight_whitebalance if color_known else white_balance),
        color_matrix=torch.from_numpy(matrix).float(),
        camera=camera_of(raw, tags),
        iso=float(getattr(other, "iso_speed", 0)) or None,
        noise_profile=tags.noise_profile,
        orientation=int(raw.sizes.flip),
        name=path.stem,
        color_known=color_known,
        gain_maps=tags.gain_maps,
        exposure=exposure_of(raw),
        masked=None if tags.black_rows or tags.black_columns else measure_masked(raw.raw_image, _window(raw), cfa),
    )


def _window(raw: Any) -> tuple[int, int, int, int]:
    """First row and column, height and width of the visible mosaic."""
    return raw.sizes.top_margin, raw.sizes.left_margin, *raw.raw_image_visible.shape


def _black(raw: Any, cell: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Levels of the cell, ``(n, n)``: LibRaw's, which are whole numbers, with a DNG's fractions."""
    # where a DNG's active area begins at an odd row or column, LibRaw leaves that one out, and gives the remaining
    # sites the levels of their neighbours
    levels = raw.black_level_per_channel
    black = np.array([[levels[k] for k in row] for row in cell], np.float32)
    if tags.black is None or any(len(cell) % side for side in tags.black.shape):
        return black
    repeats = [len(cell) // side for side in tags.black.shape]
    exact = np.tile(tags.black.astype(np.float32), repeats)
    allowed = 2 if tags.black_rows or tags.black_columns else 1  # LibRaw rounds the means of rows and columns as well
    if len(cell) == 2 and np.abs(exact - black).max() >= allowed:
        return black
    rows, columns = _left_out(raw, tags)
    return np.roll(exact, (-rows, -columns), axis=(0, 1))


def _left_out(raw: Any, tags: TiffTags) -> tuple[int, int]:
    """The rows and columns of a DNG's active area that the visible mosaic begins after, 0 or 1 of each."""
    rows, columns = raw.sizes.top_margin - tags.area[0], raw.sizes.left_margin - tags.area[1]
    return (rows, columns) if {rows, columns} <= {0, 1} else (0, 0)


def _black_of_sites(path: Path, raw: Any, black: np.ndarray, tags: TiffTags) -> np.ndarray:
    """Levels ``(H, W)`` of a DNG whose rows or columns have their own; ``(2, 2)`` of all others."""
    if not (tags.black_rows or tags.black_columns):
        return black
    (height, width), first = raw.raw_image_visible.shape, _left_out(raw, tags)
    lines = []
    for above, start, length in zip((tags.black_rows, tags.black_columns), first, (height, width), strict=True):
        if above and len(above) != start + length:
            lengths = f"black levels of {len(above)} lines, not {start + length}"
            raise OSError(f"{path}: its TIFF tags are damaged ({lengths})")
        lines.append(np.array(above or (0.0,) * (start + length), np.float32)[start:])
    return np.asarray(_tiled(black, height, width) + lines[0][:, None] + lines[1])


def _tiled(cell: np.ndarray, height: int, width: int) -> np.ndarray:
    """A cell ``(n, n)`` again and again, ``(H, W)``."""
    return np.tile(cell, (-(-height // len(cell)), -(-width // len(cell))))[:height, :width]


def _of_planes(black: np.ndarray, cfa: str) -> tuple[float, float, float, float]:
    """Levels of R, Gr, Gb, B from those of the cell; where all greens are one, its mean twice."""
    kinds = plane_indices(cfa).numpy()
    means = [float(black[kinds == kind].mean()) if (kinds == kind).any() else None for kind in range(4)]
    red, green, other, blue = (means[1] if level is None else level for level in means)
    assert red is not None and green is not None and other is not None and blue is not None
    return red, green, other, blue


def _normalised(numbers: np.ndarray, black: np.ndarray, white: float) -> Tensor:
    """Digital numbers ``(H, W)`` to RAW float32 ``(1, H, W)``, a copy; ``black`` is ``(n, n)`` or ``(H, W)``."""
    height, width = (side // 2 * 2 for side in numbers.shape)
    if black.shape != (2, 2):
        black = black if black.shape == numbers.shape else _tiled(black, *numbers.shape)
        numbers, black = numbers[:height, :width], black[:height, :width]
        return torch.from_numpy(np.minimum((numbers - black) / (white - black), 1, dtype=np.float32)[None])
    cells = numbers[:height, :width].astype(np.float32).reshape(height // 2, 2, width // 2, 2)
    cells -= black[None, :, None, :]
    cells /= (white - black)[None, :, None, :]
    np.minimum(cells, 1, out=cells)
    return torch.from_numpy(cells.reshape(1, height, width))


_KNOWN = "Bayer, X-Trans and Quad-Bayer RAW is supported"


def _cell(path: Path, raw: Any, tags: TiffTags) -> tuple[np.ndarray, str]:
    """LibRaw's colour indices of the cell at the top left of the visible mosaic, ``(n, n)``, and the pattern's name.

    0 to 3 are R, G, B, G; LibRaw knows no cells of 4 x 4, so that those of Quad-Bayer are the tags'.
    """
    shape = None if raw.raw_pattern is None else raw.raw_pattern.shape
    cell = np.empty((0, 0), int)
    if tags.cfa is not None and len(tags.cfa) == 4 and raw.raw_type != _stack():
        stated = np.array([["RGB".index(colour) for colour in row] for row in tags.cfa])
        first = raw.sizes.top_margin - tags.area[0], raw.sizes.left_margin - tags.area[1]
        cell = np.roll(stated, (-first[0], -first[1]), axis=(0, 1))
    elif shape in ((2, 2), (6, 6)) and raw.raw_type != _stack():
        stated_rows = tags.cfa or ()
        if stated_rows[shape[0] :] == stated_rows[: -shape[0]]:  # of 8 rows rawpy sees the first two
            cell = np.asarray(raw.raw_colors_visible[: shape[0], : shape[1]])
    colours = raw.color_desc.decode("ascii", "replace")
    name = pattern_name(["".join(colours[k] for k in row) for row in cell]) if colours == "RGBG" else None
    if name is None or (len(cell) == 2 and set(cell.flat) != {0, 1, 2, 3}):
        raise ValueError(f"{path}: has no mosaic of a known pattern but {_kind(raw)}; {_KNOWN}")
    return cell, CFA(name) if len(cell) == 2 else name


def _stack() -> Any:
    """LibRaw's type of RAW that has all colours at every pixel."""
    with extra("raw"):
        import rawpy

    return rawpy.RawType.Stack


def _kind(raw: Any) -> str:
    """Describe what a file holds instead of a mosaic that is known."""
    if raw.raw_type == _stack():
        return "full colour at every pixel (linear DNG, small RAW, Foveon)"
    pattern = raw.raw_pattern
    if pattern is None or len(set(pattern.flat)) == 1:
        return "a monochrome picture"
    return f"a mosaic of other colours ({raw.color_desc.decode()}, cell {pattern.shape[0]} x {pattern.shape[1]})"


def _white_balance(raw: Any) -> tuple[float, float, float]:
    """As-shot multipliers, or those for daylight if the file has none."""
    as_shot = raw.camera_whitebalance
    return _green_is_1(as_shot if min(as_shot[:3]) > 0 else raw.daylight_whitebalance)


def _green_is_1(gains: Sequence[float]) -> tuple[float, float, float]:
    if not all(0 < gain < np.inf for gain in gains[:3]):
        raise ArithmeticError(f"multipliers {', '.join(f'{gain:g}' for gain in gains[:3])}")
    return float(gains[0] / gains[1]), 1.0, float(gains[2] / gains[1])


def _color_matrix(raw: Any) -> tuple[np.ndarray, bool]:
    """The file's matrix, else LibRaw's for the model, else a typical one; and whether it is known."""
    own = np.asarray(raw.color_matrix, np.float64)[:, :3]
    if own.any():
        return own / own.sum(axis=1, keepdims=True), True
    camera = np.asarray(raw.rgb_xyz_matrix, np.float64)[:3] @ XYZ_FROM_SRGB
    if not camera.any():
        return _TYPICAL_COLOR_MATRIX, False
    return np.linalg.inv(camera / camera.sum(axis=1, keepdims=True)), True
