"""TIFF-based RAW files (DNG, NEF, CR2, ...): the tags that LibRaw does not expose, read by tifffile.

A DNG's NoiseProfile (tag 51041, DNG specification 1.3 and later) holds pairs (S, O), one for all colour planes or one
for each. The noise variance is S y + O for a signal y whose black is 0 and white is 1: S and O are our ``shot_var`` and
``read_var``.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import count_of, extra
from rawaug.io.isolated import damage_as_os_error
from rawaug.io.opcodes import OPCODE_LISTS

MOST_PAGES = 64
"""A TIFF has at most this many directories. Damaged offsets can link directories in a circle."""

MAKE, MODEL, ORIENTATION, DNG_VERSION, NOISE_PROFILE = 271, 272, 274, 50706, 51041
_LINEARIZATION, _RAW_DIGEST, _NEW_RAW_DIGEST = 50712, 50972, 51111
_CFA_REPEATS, _CFA_PATTERN = 33421, 33422
_BLACK_REPEATS, _BLACK, _BLACK_COLUMNS, _BLACK_ROWS, _WHITE = 50713, 50714, 50715, 50716, 50717
ACTIVE_AREA = 50829
_CROP_ORIGIN, _CROP_SIZE = 50719, 50720
CFA_PHOTOMETRIC, LINEAR_PHOTOMETRIC = 32803, 34892
JPEG = 7
"""This compression is JPEG of any process, most often the lossless one."""
_RATIONALS = (5, 10)
_DIGEST_BYTES = 16
_FLOATING_POINT = 3


@dataclass(frozen=True)
class StoredMosaic:
    """How a DNG stores its mosaic.

    Attributes:
        size: height and width, including the margins.
        compression: the TIFF code; 1 means none, 7 means JPEG.
        segments: offset and length in bytes of each strip or tile.
        tiled: whether the segments are tiles.
        floating: whether the numbers are floating point.
        plain: whether the numbers are integers of 9 to 16 bits without a linearisation table.
        digest: MD5 of the numbers, row by row (RawImageDigest); None if the file has none.
        tiled_digest: MD5 of the digests of the 256 x 256 tiles (NewRawImageDigest); None if the file has none.
    """

    size: tuple[int, int]
    compression: int
    segments: tuple[tuple[int, int], ...]
    tiled: bool = False
    floating: bool = False
    plain: bool = True
    digest: bytes | None = None
    tiled_digest: bytes | None = None


@dataclass(frozen=True)
class TiffTags:
    """Tags of a RAW file; a field has its default if the tag is missing or the file is not a TIFF.

    Attributes:
        make, model: the camera.
        noise_profile: (shot_var, read_var), the mean over planes.
        noise_fault: why the NoiseProfile is unusable; empty if it is usable or absent.
        orientations: the EXIF orientation of each directory that states one.
        compressions: the TIFF compression code of each directory of a DNG.
        mosaic: how a DNG stores its mosaic.
        black: black levels of the cell that repeats over the active area, ``(rows, columns)``.
        white: the saturated level, where a DNG states it; 1 for floating point that does not.
        opcodes: the opcode lists of a DNG by their tags; see :mod:`rawaug.io.opcodes`.
        black_rows, black_columns: deviation of the black level of each row and column from the mean.
        area: top, left, bottom and right of a DNG's active area.
        crop: top, left, height and width of the picture within the active area (DefaultCropOrigin, DefaultCropSize).
        cfa: rows of the pattern's cell, in the letters R, G and B.
    """

    make: str | None = None
    model: str | None = None
    noise_profile: tuple[float, float] | None = None
    noise_fault: str = ""
    orientations: tuple[int, ...] = ()
    compressions: tuple[int, ...] = ()
    mosaic: StoredMosaic | None = None
    black: np.ndarray | None = None
    white: float | None = None
    opcodes: Mapping[int, bytes] = field(default_factory=dict)
    black_rows: Sequence[float] = ()
    black_columns: Sequence[float] = ()
    area: tuple[int, int, int, int] | None = None
    crop: tuple[float, float, float, float] | None = None
    cfa: tuple[str, ...] | None = None

    @property
    def floating(self) -> bool:
        """Whether the mosaic holds floating point."""
        return self.mosaic is not None and self.mosaic.floating


def read_tiff_tags(path: Path) -> TiffTags:
    """Read the tags of the first page, and of the pages of a DNG that hold the mosaic and its noise."""
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff:
            return _read_tags(all_pages(tiff))
    except tifffile.TiffFileError:
        return TiffTags()


def _read_tags(pages: list[Any]) -> TiffTags:
    if not pages:
        return TiffTags()

    make = pages[0].tags.valueof(MAKE)
    model = pages[0].tags.valueof(MODEL)
    orientations = tuple(int(page.tags.valueof(ORIENTATION)) for page in pages if ORIENTATION in page.tags)
    if not is_dng(pages):
        return TiffTags(make, model, orientations=orientations)

    compressions = tuple(int(page.compression) for page in pages)
    profile, fault = _noise_profile(pages)
    tags = TiffTags(make, model, profile, fault, orientations, compressions)
    page = main_mosaic(pages)
    if page is None:
        return tags

    # How it is stored, and its levels.
    stored = _read_storage(page, pages[0])
    black, rows, columns = _black_levels(page)
    white = 1.0 if stored.floating else None
    if _WHITE in page.tags:
        white = float(np.max(_numbers(page.tags[_WHITE])))

    # Its pattern in the letters R, G and B, and its corrections.
    cfa = None
    height, width = page.tags.valueof(_CFA_REPEATS, (0, 0))[:2]
    colours = page.tags.valueof(_CFA_PATTERN, b"")
    if height and len(colours) == height * width and set(colours) <= {0, 1, 2}:
        letters = "".join("RGB"[colour] for colour in colours)
        cfa = tuple(letters[start : start + width] for start in range(0, len(letters), width))

    opcodes = {}
    for code in OPCODE_LISTS:
        if page.tags.valueof(code):
            opcodes[code] = bytes(page.tags.valueof(code))

    return replace(
        tags,
        mosaic=stored,
        black=black,
        white=white,
        opcodes=opcodes,
        black_rows=rows,
        black_columns=columns,
        area=active_area(page),
        crop=_default_crop(page),
        cfa=cfa,
    )


def _read_storage(mosaic: Any, first: Any) -> StoredMosaic:
    """Read how a mosaic is stored; the digests of its numbers are in the first directory."""
    digests: list[bytes | None] = []
    for code in (_RAW_DIGEST, _NEW_RAW_DIGEST):
        digest = bytes(first.tags.valueof(code, b""))
        is_complete = len(digest) == _DIGEST_BYTES and any(digest)  # GoPro cameras write zeros
        digests.append(digest if is_complete else None)

    has_integers = mosaic.sampleformat == 1 and 8 < mosaic.bitspersample <= 16
    return StoredMosaic(
        size=(mosaic.imagelength, mosaic.imagewidth),
        compression=int(mosaic.compression),
        segments=tuple(zip(mosaic.dataoffsets, mosaic.databytecounts, strict=True)),
        tiled=bool(mosaic.is_tiled),
        floating=mosaic.sampleformat == _FLOATING_POINT,
        plain=has_integers and _LINEARIZATION not in mosaic.tags,
        digest=digests[0],
        tiled_digest=digests[1],
    )


def is_dng(pages: list[Any]) -> bool:
    """Tell whether any directory states a DNG version."""
    return any(DNG_VERSION in page.tags for page in pages)


@contextmanager
def opened_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF; damage becomes an OSError that names the file.

    tifffile's log messages from this thread are silenced, since rawaug reports problems through its own errors.
    """
    with extra("raw"):
        import tifffile

    logger = logging.getLogger("tifffile")
    thread = threading.get_ident()

    def is_from_another_thread(record: logging.LogRecord) -> bool:
        return record.thread != thread

    logger.addFilter(is_from_another_thread)
    try:
        with tag_damage(path), tifffile.TiffFile(path) as tiff:
            yield tiff
    finally:
        logger.removeFilter(is_from_another_thread)


def tag_damage(path: Path) -> AbstractContextManager[None]:
    """Turn the errors of damaged tags into an OSError that names the file."""
    with extra("raw"):
        import tifffile

    return damage_as_os_error(path, "its TIFF tags are damaged", tifffile.TiffFileError, OSError)


def all_pages(tiff: Any) -> list[Any]:
    """List all pages of a file; the pages of a SubIFD follow their parent."""
    pages: list[Any] = []
    waiting = [iter(tiff.pages)]
    while waiting:
        page = next(waiting[-1], None)
        if page is None:
            waiting.pop()
            continue

        pages.append(page)
        waiting.append(iter(getattr(page, "pages", None) or ()))
        if len(pages) > MOST_PAGES:
            raise ValueError(f"it has more than {MOST_PAGES} directories, or they point at one another in a circle")
    return pages


def main_mosaic(pages: list[Any]) -> Any:
    """Find the largest mosaic, which is the page that LibRaw reads; return None if there is no mosaic.

    Phones write several mosaics. The single plane of a monochrome sensor counts as a mosaic.
    """
    mosaics = [page for page in pages if page.photometric == CFA_PHOTOMETRIC]
    if not mosaics:
        mosaics = [page for page in pages if page.photometric == LINEAR_PHOTOMETRIC and page.samplesperpixel == 1]
    return max(mosaics, key=lambda page: int(page.imagelength * page.imagewidth), default=None)


def active_area(mosaic: Any) -> tuple[int, int, int, int]:
    """Read top, left, bottom and right of the active area, which is all of the mosaic if the file states none."""
    area = mosaic.tags.valueof(ACTIVE_AREA)
    if area is None:
        return 0, 0, mosaic.imagelength, mosaic.imagewidth
    top, left, bottom, right = area
    return int(top), int(left), int(bottom), int(right)


def _default_crop(mosaic: Any) -> tuple[float, float, float, float] | None:
    """Read top, left, height and width of the default crop; return None if the file states none, or nonsense."""
    origin, size = mosaic.tags.get(_CROP_ORIGIN), mosaic.tags.get(_CROP_SIZE)
    if origin is None or size is None:
        return None

    left, top = (*_numbers(origin).tolist(), math.nan, math.nan)[:2]
    width, height = (*_numbers(size).tolist(), math.nan, math.nan)[:2]
    if not (0 <= top < math.inf and 0 <= left < math.inf and 0 < height < math.inf and 0 < width < math.inf):
        return None
    return top, left, height, width


def _noise_profile(pages: list[Any]) -> tuple[tuple[float, float] | None, str]:
    """Return the mean over planes of the first profile, and the reason if the profile is unusable."""
    for page in pages:
        tag = page.tags.get(NOISE_PROFILE)
        if tag is None:
            continue

        values = np.ravel(tag.value).astype(np.float64)
        if len(values) < 2 or len(values) % 2:
            return None, f"has {count_of(len(values), 'value')}, not pairs"

        shot_vars, read_vars = values[0::2], values[1::2]
        in_range = bool(((values >= 0) & (values <= 1)).all())  # False for NaN, too
        if not in_range or not (shot_vars + read_vars > 0).all():
            return None, f"is out of range: {', '.join(f'{value:g}' for value in values)}"

        count = len(shot_vars)
        shot_var = sum(shot_vars.tolist()) / count
        read_var = sum(read_vars.tolist()) / count
        return (shot_var, read_var), ""

    return None, ""


def _numbers(tag: Any) -> Any:
    """Return the values of a tag as float64 ``(N,)``; rationals are divided."""
    values = np.ravel(tag.value).astype(np.float64)
    if tag.dtype not in _RATIONALS:
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        return values[0::2] / values[1::2]


def _black_levels(mosaic: Any) -> tuple[np.ndarray | None, list[float], list[float]]:
    """Read the black levels of the cell that repeats, ``(rows, columns)``, and what each row and column adds to them.

    The cell is None if the file states none. Rows or columns that all add the same are counted to the cell.
    """
    row_mean, rows = _deviations(mosaic, _BLACK_ROWS)
    column_mean, columns = _deviations(mosaic, _BLACK_COLUMNS)
    offset = row_mean + column_mean

    if _BLACK not in mosaic.tags:
        cell = np.full((1, 1), offset) if offset else None
        return cell, rows, columns

    levels = _numbers(mosaic.tags[_BLACK]) + offset
    if not np.isfinite(levels).all():
        raise ValueError("BlackLevel: levels that are not finite")

    height, width = mosaic.tags.valueof(_BLACK_REPEATS) or (1, 1)
    if len(levels) != height * width:
        return None, rows, columns
    return np.asarray(levels.reshape(height, width)), rows, columns


def _deviations(mosaic: Any, code: int) -> tuple[float, list[float]]:
    """Compute the mean of the black level offsets of all rows or columns, and the deviation of each from it.

    There are no deviations if the tag is missing or its values are equal.
    """
    tag = mosaic.tags.get(code)
    if tag is None:
        return 0.0, []

    values: list[float] = _numbers(tag).tolist()
    if not np.isfinite(values).all():
        raise ValueError(f"tag {code}: black levels that are not finite")

    mean = sum(values) / max(1, len(values))
    deviations = [value - mean for value in values]
    if not any(deviations):
        return mean, []
    return mean, deviations


def read_floats(path: Path) -> np.ndarray:
    """Read the floating-point numbers of a DNG's mosaic, margins included, float32 ``(H, W)``.

    LibRaw would turn them into integers of 14 bits.
    """
    with opened_tiff(path) as tiff:
        numbers = main_mosaic(all_pages(tiff)).asarray()
    if not np.isfinite(numbers).all():
        raise OSError(f"{path}: is damaged inside (its mosaic holds numbers that are not finite); copy it again")
    return np.asarray(numbers, np.float32).reshape(numbers.shape[:2])
