"""TIFF-based RAW files (DNG, NEF, CR2, ...): the tags that LibRaw does not expose, read by tifffile.

A directory (IFD) names its successor and its children (SubIFDs, tag 330) by their offset. Damaged offsets make circles,
in which a reader that trusts them never ends, so directories are followed once before tifffile follows them. Source:
TIFF 6.0, section 2; BigTIFF; TIFF Technical Note 1 (SubIFDs).

A DNG's NoiseProfile (tag 51041, DNG specification 1.3 and later) holds pairs (S, O), one for all colour planes or one a
plane, with noise variance S y + O for a signal y whose black is 0 and white 1: our ``shot_var`` and ``read_var``.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from rawaug.errors import extra
from rawaug.io.gain_map import GainMap, parse_gain_maps
from rawaug.io.isolated import damage_as_os_error

MOST_DIRECTORIES = 512
_SUB_DIRECTORIES = 330
_OFFSETS = {4: "I", 13: "I", 16: "Q", 18: "Q"}
"""TIFF types that hold offsets (LONG, IFD, LONG8, IFD8), as struct names them."""


class _Layout(NamedTuple):
    """Formats of struct: of an offset, of the number of entries, of an entry up to its value."""

    offset: str
    number: str
    entry: str


_LAYOUTS = {42: _Layout("I", "H", "HHI"), 43: _Layout("Q", "Q", "HHQ")}
"""Of TIFF and BigTIFF, by the number after the byte order."""


def require_no_circle(path: Path) -> None:
    """Raise ValueError if the directories of a TIFF form a circle; other files are not checked."""
    # a directory that two others name is no circle: some writers chain the children that a parent lists as well
    with path.open("rb") as file:
        start = file.read(4)
        order = {b"II": "<", b"MM": ">"}.get(start[:2])
        if order is None or len(start) < 4:
            return
        layout = _LAYOUTS.get(struct.unpack(order + "H", start[2:])[0])
        if layout is None:
            return
        end = file.seek(0, SEEK_END)
        todo = [_number(file, order + layout.offset, 8 if layout.offset == "Q" else 4)]
        named: dict[int, list[int]] = {}
        while todo:
            place = todo.pop()
            if place in named or not 0 < place < end:
                continue
            if len(named) == MOST_DIRECTORIES:
                raise ValueError(f"it has more than {MOST_DIRECTORIES} directories")
            named[place] = _followed(file, order, layout, place, end)
            todo += named[place]
    try:
        TopologicalSorter(named).prepare()
    except CycleError as error:
        place = error.args[1][0]
        raise ValueError(f"its directories point at one another in a circle, at byte {place}") from None


def _followed(file: BinaryIO, order: str, layout: _Layout, place: int, end: int) -> list[int]:
    """Offsets that a directory names: of its successor and of its children."""
    place += struct.calcsize(order + layout.number)
    count = _number(file, order + layout.number, place - struct.calcsize(order + layout.number))
    size, wide = struct.calcsize(order + layout.entry), struct.calcsize(order + layout.offset)
    if place + count * (size + wide) > end:
        return []  # what is cut off is left to whoever reads it
    file.seek(place)
    table = file.read(count * (size + wide))
    followed = [_number(file, order + layout.offset, place + count * (size + wide))]
    for at in range(0, len(table), size + wide):
        code, kind, values = struct.unpack_from(order + layout.entry, table, at)
        if code == _SUB_DIRECTORIES and kind in _OFFSETS:
            each = struct.calcsize(order + _OFFSETS[kind])
            inside = values * each <= wide
            where = place + at + size if inside else struct.unpack_from(order + layout.offset, table, at + size)[0]
            values = min(values, MOST_DIRECTORIES + 1)
            followed += [_number(file, order + _OFFSETS[kind], where + k * each) for k in range(values)]
    return followed


def _number(file: BinaryIO, form: str, place: int) -> int:
    """The number at ``place``; 0 behind the end of the file."""
    file.seek(place)
    data = file.read(struct.calcsize(form))
    return int(struct.unpack(form, data)[0]) if len(data) == struct.calcsize(form) else 0


MAKE, MODEL, DNG_VERSION, _NOISE_PROFILE = 271, 272, 50706, 51041
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
    black: tuple[float, float, float, float] | None = None
    gain_maps: tuple[GainMap, ...] = ()
    black_rows: Sequence[float] = ()
    black_columns: Sequence[float] = ()
    area: tuple[int, int] = (0, 0)


def read_tiff_tags(path: Path) -> TiffTags:
    """Read the tags of the first page, and of the pages of a DNG that hold the mosaic and its noise."""
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff:
            pages = list(all_pages(tiff.pages))
            make, model = (pages[0].tags.valueof(code) if pages else None for code in (MAKE, MODEL))
            if not any(DNG_VERSION in page.tags for page in pages):
                return TiffTags(make, model)
            mosaic = main_mosaic(pages)
            profile = _noise_profile(pages)
            if mosaic is None:
                return TiffTags(make, model, profile)
            (above, rows), (beside, columns) = (_deltas(mosaic, code) for code in _BLACK_DELTAS)
            black, end, maps = _black(mosaic, above + beside), _mosaic_end(mosaic), _gain_maps(mosaic)
            area = mosaic.tags.valueof(ACTIVE_AREA) or (0, 0)
            return TiffTags(make, model, profile, end, black, maps, rows, columns, area[:2])
    except tifffile.TiffFileError:
        return TiffTags()


@contextmanager
def opened_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF after checking its directories; damage becomes an OSError that names the file."""
    with extra("raw"):
        import tifffile

    with tag_damage(path):
        require_no_circle(path)
        with tifffile.TiffFile(path) as tiff:
            yield tiff


def tag_damage(path: Path) -> AbstractContextManager[None]:
    """Turn the errors of damaged tags into an OSError that names the file."""
    with extra("raw"):
        import tifffile

    return damage_as_os_error(path, "its TIFF tags are damaged", tifffile.TiffFileError, OSError)


def all_pages(pages: Any) -> Iterator[Any]:
    """Every page of a file, those of its SubIFDs after the one that they belong to."""
    for page in pages:
        yield page
        yield from all_pages(getattr(page, "pages", None) or ())


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


def _mosaic_end(mosaic: Any) -> int | None:
    parts = zip(mosaic.dataoffsets, mosaic.databytecounts, strict=True)
    return max((offset + count for offset, count in parts), default=None)


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


def _black(mosaic: Any, more: float) -> tuple[float, float, float, float] | None:
    tag = mosaic.tags.get(_BLACK)
    if tag is None:
        return (more, more, more, more) if more else None
    levels = _numbers(tag) + more
    rows, columns = mosaic.tags.valueof(_BLACK_REPEATS) or (1, 1)
    if len(levels) != rows * columns or 2 % rows or 2 % columns:
        return None
    a, b, c, d = np.tile(levels.reshape(rows, columns), (2 // rows, 2 // columns)).ravel().tolist()
    return a, b, c, d


def _gain_maps(mosaic: Any) -> tuple[GainMap, ...]:
    found: tuple[GainMap, ...] = ()
    for number, code in ((2, OPCODE_LIST_2), (3, OPCODE_LIST_3)):
        opcodes = mosaic.tags.valueof(code)
        try:
            found += parse_gain_maps(opcodes, on_mosaic=number == 2) if opcodes else ()
        except ValueError as error:
            raise ValueError(f"OpcodeList{number}: {error}") from None
    return found
