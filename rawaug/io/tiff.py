"""TIFF-based RAW files (DNG, NEF, CR2, ...): the tags that LibRaw does not expose, read by tifffile.

A DNG's NoiseProfile (tag 51041, DNG specification 1.3 and later) holds pairs (S, O), one for all colour planes or one a
plane, with noise variance S y + O for a signal y whose black is 0 and white 1: our ``shot_var`` and ``read_var``.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import extra
from rawaug.io.gain_map import GainMap, parse_gain_maps
from rawaug.io.isolated import damage_as_os_error

MOST_PAGES = 64
"""Maximum number of directories of a TIFF, as damaged offsets can make circles of them."""

MAKE, MODEL, ORIENTATION, DNG_VERSION, NOISE_PROFILE = 271, 272, 274, 50706, 51041
_LINEARIZATION, _RAW_DIGEST, _NEW_RAW_DIGEST = 50712, 50972, 51111
_CFA_REPEATS, _CFA_PATTERN = 33421, 33422
_BLACK_REPEATS, _BLACK, _BLACK_COLUMNS, _BLACK_ROWS = 50713, 50714, 50715, 50716
ACTIVE_AREA = 50829
OPCODE_LIST_2, OPCODE_LIST_3 = 51009, 51022
CFA_PHOTOMETRIC, LINEAR_PHOTOMETRIC = 32803, 34892
LOSSLESS_JPEG = 7
_RATIONALS = (5, 10)
_DIGEST_BYTES = 16


@dataclass(frozen=True)
class StoredMosaic:
    """How a DNG stores its mosaic.

    Attributes:
        size: height and width, margins included.
        compression: TIFF's number; 1 is none, 7 lossless JPEG.
        segments: offset and length in bytes of each strip or tile.
        plain: whether the stored numbers are whole ones of 9 to 16 bits that no table translates.
        digest: MD5 of the numbers, row by row (RawImageDigest); None if the file has none.
        tiled_digest: MD5 of the digests of tiles of 256 x 256 (NewRawImageDigest); None if the file has none.
    """

    size: tuple[int, int]
    compression: int
    segments: tuple[tuple[int, int], ...]
    plain: bool = True
    digest: bytes | None = None
    tiled_digest: bytes | None = None

    @property
    def end(self) -> int:
        """Bytes that the file has at least."""
        return max((offset + length for offset, length in self.segments), default=0)


@dataclass(frozen=True)
class TiffTags:
    """Tags of a RAW file; each field has its default where the tag is missing or the file is not a TIFF.

    Attributes:
        make, model: of the camera.
        noise_profile: (shot_var, read_var), the mean over planes.
        noise_fault: what is wrong with a NoiseProfile that cannot be used; empty if nothing is.
        orientations: EXIF's numbers, of every directory that states one.
        compressions: TIFF's numbers, of every directory of a DNG.
        mosaic: how a DNG stores its mosaic.
        black: levels of a cell that repeats over the active area, ``(rows, columns)``.
        gain_maps: a DNG's correction of the lens shading.
        black_rows, black_columns: by how much the level of each row and column differs from their mean.
        area: first row and column of the active area.
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
    gain_maps: tuple[GainMap, ...] = ()
    black_rows: Sequence[float] = ()
    black_columns: Sequence[float] = ()
    area: tuple[int, int] = (0, 0)
    cfa: tuple[str, ...] | None = None


def read_tiff_tags(path: Path) -> TiffTags:
    """Read the tags of the first page, and of the pages of a DNG that hold the mosaic and its noise."""
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff:
            return _tags_of(all_pages(tiff))
    except tifffile.TiffFileError:
        return TiffTags()


def _tags_of(pages: list[Any]) -> TiffTags:
    if not pages:
        return TiffTags()

    make = pages[0].tags.valueof(MAKE)
    model = pages[0].tags.valueof(MODEL)
    orientations = tuple(int(page.tags.valueof(ORIENTATION)) for page in pages if ORIENTATION in page.tags)
    if not any(DNG_VERSION in page.tags for page in pages):
        return TiffTags(make, model, orientations=orientations)

    profile, fault = _noise_profile(pages)
    tags = TiffTags(make, model, profile, fault, orientations, tuple(int(page.compression) for page in pages))
    page = main_mosaic(pages)
    if page is None:
        return tags

    row_mean, rows = _deltas(page, _BLACK_ROWS)
    column_mean, columns = _deltas(page, _BLACK_COLUMNS)
    area = page.tags.valueof(ACTIVE_AREA) or (0, 0)
    return replace(
        tags,
        mosaic=_stored_mosaic(page, pages[0]),
        black=_black(page, row_mean + column_mean),
        gain_maps=_gain_maps(page),
        black_rows=rows,
        black_columns=columns,
        area=(area[0], area[1]),
        cfa=_cfa(page),
    )


def _stored_mosaic(page: Any, first: Any) -> StoredMosaic:
    return StoredMosaic(
        size=(page.imagelength, page.imagewidth),
        compression=int(page.compression),
        segments=tuple(zip(page.dataoffsets, page.databytecounts, strict=True)),
        plain=8 < page.bitspersample <= 16 and page.sampleformat == 1 and _LINEARIZATION not in page.tags,
        digest=_digest(first, _RAW_DIGEST),
        tiled_digest=_digest(first, _NEW_RAW_DIGEST),
    )


def _digest(page: Any, code: int) -> bytes | None:
    value = page.tags.valueof(code)
    if value is None or len(bytes(value)) != _DIGEST_BYTES or not any(bytes(value)):  # GoPros write zeros
        return None
    return bytes(value)


@contextmanager
def opened_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF; damage becomes an OSError that names the file."""
    with extra("raw"):
        import tifffile

    with _quiet_tifffile(), tag_damage(path), tifffile.TiffFile(path) as tiff:
        yield tiff


@contextmanager
def _quiet_tifffile() -> Iterator[None]:
    """Keep tifffile's log lines of this thread away: what matters of a file is said by rawaug's own errors."""
    logger = logging.getLogger("tifffile")
    thread = threading.get_ident()

    def is_of_others(record: logging.LogRecord) -> bool:
        return record.thread != thread

    logger.addFilter(is_of_others)
    try:
        yield
    finally:
        logger.removeFilter(is_of_others)


def tag_damage(path: Path) -> AbstractContextManager[None]:
    """Turn the errors of damaged tags into an OSError that names the file."""
    with extra("raw"):
        import tifffile

    return damage_as_os_error(path, "its TIFF tags are damaged", tifffile.TiffFileError, OSError)


def all_pages(tiff: Any) -> list[Any]:
    """Every page of a file, those of its SubIFDs after the one that they belong to."""
    pages = list(islice(_pages(tiff.pages), MOST_PAGES + 1))
    if len(pages) > MOST_PAGES:
        raise ValueError(f"it has more than {MOST_PAGES} directories, or they point at one another in a circle")
    return pages


def _pages(pages: Any) -> Iterator[Any]:
    for page in pages:
        yield page
        yield from _pages(getattr(page, "pages", None) or ())


def main_mosaic(pages: list[Any]) -> Any:
    """The page that LibRaw reads: of several mosaics, as phones write them, the largest; None without any.

    The one plane of a monochrome sensor counts as a mosaic.
    """
    mosaics = [page for page in pages if page.photometric == CFA_PHOTOMETRIC]
    if not mosaics:
        mosaics = [page for page in pages if page.photometric == LINEAR_PHOTOMETRIC and page.samplesperpixel == 1]
    return max(mosaics, key=lambda page: page.imagelength * page.imagewidth, default=None)


def _noise_profile(pages: list[Any]) -> tuple[tuple[float, float] | None, str]:
    """The mean over planes of the first profile, and what is wrong with it if it cannot be used."""
    for page in pages:
        tag = page.tags.get(NOISE_PROFILE)
        if tag is None:
            continue

        values = np.ravel(tag.value).astype(np.float64)
        if len(values) < 2 or len(values) % 2:
            return None, f"has {len(values)} values, not pairs"

        shot_vars, read_vars = values[0::2], values[1::2]
        in_range = bool(((values >= 0) & (values <= 1)).all())  # False for NaN, too
        if not in_range or not (shot_vars + read_vars > 0).all():
            return None, f"is out of range: {', '.join(f'{value:g}' for value in values)}"
        count = len(shot_vars)
        return (sum(shot_vars.tolist()) / count, sum(read_vars.tolist()) / count), ""
    return None, ""


def _numbers(tag: Any) -> Any:
    """The values of a tag, rationals divided, float64 ``(N,)``."""
    values = np.ravel(tag.value).astype(np.float64)
    if tag.dtype not in _RATIONALS:
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        return values[0::2] / values[1::2]


def _deltas(mosaic: Any, code: int) -> tuple[float, list[float]]:
    """Offsets of the black level for each row or column of the active area: their mean, and what is left, if any."""
    tag = mosaic.tags.get(code)
    values: list[float] = [] if tag is None else _numbers(tag).tolist()
    if not np.isfinite(values).all():
        raise ValueError(f"tag {code}: black levels that are not finite")
    mean = sum(values) / max(1, len(values))
    left = [value - mean for value in values]
    return mean, left if any(left) else []


def _black(mosaic: Any, more: float) -> np.ndarray | None:
    """Levels of a cell, of any size that the tags give."""
    tag = mosaic.tags.get(_BLACK)
    if tag is None:
        return np.full((1, 1), more) if more else None
    levels = _numbers(tag) + more
    if not np.isfinite(levels).all():
        raise ValueError("BlackLevel: levels that are not finite")
    rows, columns = mosaic.tags.valueof(_BLACK_REPEATS) or (1, 1)
    return levels.reshape(rows, columns) if len(levels) == rows * columns else None


def _cfa(mosaic: Any) -> tuple[str, ...] | None:
    """The rows of the pattern's cell, of the colours R, G and B; None if it has others."""
    size, colours = (mosaic.tags.valueof(code) for code in (_CFA_REPEATS, _CFA_PATTERN))
    if size is None or colours is None or len(colours) != size[0] * size[1] or not set(colours) <= {0, 1, 2}:
        return None
    text = "".join("RGB"[colour] for colour in colours)
    return tuple(text[start : start + size[1]] for start in range(0, len(text), size[1]))


def _gain_maps(mosaic: Any) -> tuple[GainMap, ...]:
    found: tuple[GainMap, ...] = ()
    for number, code in ((2, OPCODE_LIST_2), (3, OPCODE_LIST_3)):
        opcodes = mosaic.tags.valueof(code)
        try:
            found += parse_gain_maps(opcodes, on_mosaic=number == 2) if opcodes else ()
        except ValueError as error:
            raise ValueError(f"OpcodeList{number}: {error}") from None
    return found
