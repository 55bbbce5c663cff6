"""TIFF-based RAW files (DNG, NEF, CR2, ...): the tags that LibRaw does not expose, read by tifffile.

A DNG's NoiseProfile (tag 51041, DNG specification 1.3 and later) holds pairs (S, O), one for all colour planes or one a
plane, with noise variance S y + O for a signal y whose black is 0 and white 1: our ``shot_var`` and ``read_var``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import extra
from rawaug.io.gain_map import GainMap, parse_gain_maps
from rawaug.io.isolated import damage_as_os_error

MOST_PAGES = 64
"""More than any RAW file has. Damaged offsets make circles of directories, in which a reader never ends."""

MAKE, MODEL, DNG_VERSION, _NOISE_PROFILE = 271, 272, 50706, 51041
_CFA_REPEATS, _CFA_PATTERN = 33421, 33422
_BLACK_REPEATS, _BLACK, _BLACK_DELTAS = 50713, 50714, (50716, 50715)
ACTIVE_AREA = 50829
OPCODE_LIST_2, OPCODE_LIST_3 = 51009, 51022
CFA_PHOTOMETRIC, LINEAR_PHOTOMETRIC = 32803, 34892
_RATIONALS = (5, 10)


@dataclass(frozen=True)
class TiffTags:
    """Each field is None where the tag is missing or the file is not a TIFF."""

    make: str | None = None
    model: str | None = None
    noise_profile: tuple[float, float] | None = None
    mosaic_end: int | None = None
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
            pages = all_pages(tiff)
            make, model = (pages[0].tags.valueof(code) if pages else None for code in (MAKE, MODEL))
            if not any(DNG_VERSION in page.tags for page in pages):
                return TiffTags(make, model)
            mosaic = main_mosaic(pages)
            profile = _noise_profile(pages)
            if mosaic is None:
                return TiffTags(make, model, profile)
            (above, rows), (beside, columns) = (_deltas(mosaic, code) for code in _BLACK_DELTAS)
            black, maps = _black(mosaic, above + beside), _gain_maps(mosaic)
            end = max(map(sum, zip(mosaic.dataoffsets, mosaic.databytecounts, strict=True)), default=None)
            area = mosaic.tags.valueof(ACTIVE_AREA) or (0, 0)
            return TiffTags(make, model, profile, end, black, maps, rows, columns, area[:2], _cfa(mosaic))
    except tifffile.TiffFileError:
        return TiffTags()


@contextmanager
def opened_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF; damage becomes an OSError that names the file."""
    with extra("raw"):
        import tifffile

    with tag_damage(path), tifffile.TiffFile(path) as tiff:
        yield tiff


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
    """The page that LibRaw reads: of several mosaics, as phones write them, the largest; None without any."""
    mosaics = [page for page in pages if page.photometric == CFA_PHOTOMETRIC]
    return max(mosaics, key=lambda page: page.imagelength * page.imagewidth, default=None)


def _noise_profile(pages: list[Any]) -> tuple[float, float] | None:
    for page in pages:
        values = page.tags.valueof(_NOISE_PROFILE)
        if values:
            shot_var, read_var = (sum(values[k::2]) / (len(values) // 2) for k in (0, 1))
            if not (0 <= shot_var <= 1 and 0 <= read_var <= 1):
                raise ValueError(f"NoiseProfile {shot_var:g}, {read_var:g}")
            return shot_var, read_var
    return None


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
