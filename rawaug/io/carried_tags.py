"""Metadata that a rewritten DNG keeps from its source: camera, colour, lens corrections, EXIF, GPS, XMP.

Left out is what describes the old pixels (their layout, levels, digests, previews, noise profile) and what points into
the old file (maker notes). The EXIF and GPS directories are copied value by value in their binary form.
Source: TIFF 6.0, section 2; DNG specification 1.4, chapter 4.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO

from rawaug.extras import extra
from rawaug.io.tiff_tags import all_pages, main_mosaic, opened_tiff

_DNG_VERSION, _ASCII = 50706, 2
_SUB_DIRECTORIES = {"ExifTag": 34665, "GPSTag": 34853}
_POINTERS = (37500, 40965)  # maker note, interoperability directory
_SIZES = (0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8)
"""Bytes of a value of the TIFF types 0 to 12."""
_VALUE = 8
"""Offset within an entry of its value, or of the pointer to it."""

_OF_ANY_TIFF = (270, 271, 272, 306, 315, 700, 33432)
_LAYOUT = (
    *range(254, 260),
    262,
    266,
    273,
    277,
    278,
    279,
    282,
    283,
    284,
    296,
    297,
    317,
    *range(320, 326),
    330,
    338,
    339,
)
_PREVIEW = (*range(512, 522), *range(529, 533), *range(50966, 50972))
_LEVELS = (33421, 33422, 50711, 50712, *range(50713, 50718), 50829, 50830, 51041)
_DIGESTS = (50781, 50828, 50972, 50973, 51111, 51114)
_REPLACED = (274, 305, 347, 37500, *_SUB_DIRECTORIES.values())
_DROPPED = frozenset((*_LAYOUT, *_PREVIEW, *_LEVELS, *_DIGESTS, *_REPLACED))
_CROP = (50718, 50719, 50720, 51125)
_ACTIVE_AREA = 50829

Tag = tuple[Any, int, int, Any, bool]
"""As tifffile takes them: code, type, count, value, once."""


@dataclass(frozen=True)
class Entry:
    """One value of a directory, its bytes in the file's order."""

    code: int
    dtype: int
    count: int
    data: bytes


@dataclass(frozen=True)
class CarriedTags:
    """Of a source: its byte order (``<`` or ``>``), the tags of the picture, and its sub-directories by name."""

    byte_order: str
    tags: dict[int, Tag]
    directories: dict[str, list[Entry]]


def read_carried_tags(path: Path, size: tuple[int, int]) -> CarriedTags:
    """What is kept of ``path`` for a mosaic of ``size`` (height, width); nothing if it is not a TIFF.

    A DNG gives all tags of its first directory and of the mosaic's; another TIFF (NEF, CR2, ARW, ...), whose private
    tags mean something else, its description, author, XMP, EXIF and GPS.

    Raises:
        OSError: if the tags are damaged.
    """
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff, path.open("rb") as file:
            pages = list(all_pages(tiff.pages))
            first = pages[0].tags
            dng = any(_DNG_VERSION in page.tags for page in pages)
            mosaics = [mosaic] if dng and (mosaic := main_mosaic(pages)) is not None else []
            tags: dict[int, Tag] = {}
            for page in (pages[0], *mosaics):
                kept = [tag for tag in page.tags if (tag.code not in _DROPPED if dng else tag.code in _OF_ANY_TIFF)]
                tags |= {tag.code: (tag.code, int(tag.dtype), tag.count, _value(tag), True) for tag in kept}
            if mosaics and not _fills_active_area(mosaics[0], size):
                tags = {code: tag for code, tag in tags.items() if code not in _CROP}
            order = tiff.byteorder
            pointers = {name: first[code].offset + _VALUE for name, code in _SUB_DIRECTORIES.items() if code in first}
            return CarriedTags(order, tags, {name: _read(file, order, at) for name, at in pointers.items()})
    except tifffile.TiffFileError:
        return CarriedTags("<", {}, {})


def _value(tag: Any) -> Any:
    """Text as tifffile writes it: 7 bits; other texts as the bytes that they are in UTF-8."""
    if tag.dtype == _ASCII and isinstance(tag.value, str) and not tag.value.isascii():
        return tag.value.encode() + b"\0"
    return tag.value


def _fills_active_area(mosaic: Any, size: tuple[int, int]) -> bool:
    area = mosaic.tags.valueof(_ACTIVE_AREA) or (0, 0, mosaic.imagelength, mosaic.imagewidth)
    return bool((area[2] - area[0], area[3] - area[1]) == size)


def _read(file: BinaryIO, order: str, pointer: int) -> list[Entry]:
    """The directory whose offset is stored at ``pointer``."""
    (start,) = _unpack(file, order + "I", pointer)
    (count,) = _unpack(file, order + "H", start)
    entries, left = [], file.seek(0, SEEK_END)
    for place in range(start + 2, start + 2 + 12 * count, 12):
        code, dtype, values = _unpack(file, order + "HHI", place)
        if code in _POINTERS or not 0 < dtype < len(_SIZES):
            continue
        size = _SIZES[dtype] * values
        left -= size
        if left < 0:
            raise ValueError(f"values of tag {code} and others are larger than the file")
        file.seek(place + 8 if size <= 4 else _unpack(file, order + "I", place + 8)[0])
        entries.append(Entry(code, dtype, values, file.read(size)))
    return entries


def _unpack(file: BinaryIO, form: str, place: int) -> tuple[Any, ...]:
    file.seek(place)
    return struct.unpack(form, file.read(struct.calcsize(form)))


def append_directory(path: Path, name: str, entries: list[Entry]) -> None:
    """Write a sub-directory behind a TIFF, in whose first directory the tag ``name`` comes to point at it."""
    with path.open("r+b") as file:
        order = "<" if file.read(2) == b"II" else ">"
        end = file.seek(0, SEEK_END)
        start = end + end % 2
        beyond = start + 2 + 12 * len(entries) + 4
        table, values = struct.pack(order + "H", len(entries)), b""
        for entry in sorted(entries, key=lambda entry: entry.code):
            inside = len(entry.data) <= 4
            place = entry.data.ljust(4, b"\0") if inside else struct.pack(order + "I", beyond + len(values))
            table += struct.pack(order + "HHI", entry.code, entry.dtype, entry.count) + place
            values += b"" if inside else entry.data + bytes(len(entry.data) % 2)
        file.seek(start)
        file.write(table + bytes(4) + values)
        file.seek(_pointer(file, order, _SUB_DIRECTORIES[name]))
        file.write(struct.pack(order + "I", start))


def _pointer(file: BinaryIO, order: str, code: int) -> int:
    """Offset of the value of tag ``code`` in the first directory."""
    (first,) = _unpack(file, order + "I", 4)
    (count,) = _unpack(file, order + "H", first)
    places = range(first + 2, first + 2 + 12 * count, 12)
    return next(place + _VALUE for place in places if _unpack(file, order + "H", place) == (code,))
