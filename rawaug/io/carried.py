"""What a DNG keeps of the RAW file that it was made from: tags, EXIF, GPS, XMP, and previews.

A DNG gives all tags of its first directory and of its mosaic's, but those that describe the old pixels (their layout,
levels, digests, noise profile). The private tags of other TIFFs (NEF, CR2, ARW) mean something else, so that they give
their description, author, XMP, EXIF and GPS. EXIF, GPS and interoperability directories are copied value by value in
their binary form; a maker's note too, where the file says that it is safe to move (MakerNoteSafety).

The previews of a DNG are copied with the tags that describe them. Those of other files are what LibRaw finds.
Source: DNG specification 1.4, chapters 2 to 4; TIFF 6.0, section 2; EXIF 2.32, section 4.6.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from io import BytesIO
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from rawaug.errors import extra
from rawaug.io.raw import read_preview
from rawaug.io.tiff import ACTIVE_AREA, DNG_VERSION, all_pages, main_mosaic, opened_tiff

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
_SIZES = (0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8)
"""Bytes of a value of the TIFF types 0 to 12."""

SUB_DIRECTORIES = {"ExifTag": 34665, "GPSTag": 34853}
MAKER_NOTE, INTEROPERABILITY, _MAKER_NOTE_SAFETY = 37500, 40965, 50741

_OF_ANY_TIFF = (270, 271, 272, 306, 315, 700, 33432)
_LAYOUT = (
    *(*range(254, 260), 262, 266, 273, 277, 278, 279, 282, 283, 284, 296, 297, 317),
    *(*range(320, 326), 330, 338, 339),
)
_OF_PREVIEWS = (*range(512, 522), *range(529, 533), *range(50966, 50972))
_LEVELS = (33421, 33422, 50711, 50712, *range(50713, 50718), 50829, 50830, 51041)
_DIGESTS = (50781, 50828, 50972, 50973, 51111, 51114)
_REPLACED = (274, 305, 347, MAKER_NOTE, *SUB_DIRECTORIES.values())
_DROPPED = frozenset((*_LAYOUT, *_OF_PREVIEWS, *_LEVELS, *_DIGESTS, *_REPLACED))
_CROP = (50718, 50719, 50720, 51125)

_PREVIEW_TAGS = frozenset((*_LAYOUT, *_OF_PREVIEWS, 34675)) - {320, 330}
"""Tags of a preview's directory that are copied: its layout, the program that made it, its colour profile."""
_SEGMENTS = ((273, 279), (324, 325), (513, 514))
"""Tags of the places and the lengths of strips, of tiles, and of a JPEG."""
_PREVIEW_PHOTOMETRICS = (1, 2, 6)
"""Grey, RGB, YCbCr."""
_SUBFILE_TYPE, _REDUCED = 254, 1
_MOST_PREVIEW_BYTES = 2**26
_VALUE = 8
"""Offset within an entry of its value, or of the pointer to it."""

Tags = dict[int, tuple[int, int, Any]]
"""Type, count and value by code, as tifffile writes them; it counts text itself."""


class Entry(NamedTuple):
    """One tag of a directory, its values as bytes in the file's order."""

    code: int
    dtype: int
    values: int
    data: bytes


@dataclass(frozen=True)
class Preview:
    """A small picture in a RAW file: the entries of its directory, but for the places of its data."""

    entries: list[Entry]
    segments: list[bytes]
    codes: tuple[int, int]


@dataclass(frozen=True)
class Carried:
    """What is kept of a source.

    Attributes:
        byte_order: ``<`` or ``>``.
        tags: of the picture.
        directories: EXIF and GPS, by the names of their pointers.
        interoperability: the directory that EXIF points to.
        previews: the largest last.
    """

    byte_order: str = "<"
    tags: Tags = field(default_factory=dict)
    directories: dict[str, list[Entry]] = field(default_factory=dict)
    interoperability: list[Entry] = field(default_factory=list)
    previews: list[Preview] = field(default_factory=list)


def read_carried(path: Path, size: tuple[int, int]) -> Carried:
    """What is kept of ``path`` for a mosaic of ``size`` (height, width)."""
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff, path.open("rb") as file:
            carried, is_dng = _read_tiff(tiff, file, size)
    except tifffile.TiffFileError:
        carried, is_dng = Carried(), False

    if not is_dng:
        carried.previews.extend(_decoded_preview(path, carried.byte_order))
    return carried


def _read_tiff(tiff: Any, file: BinaryIO, size: tuple[int, int]) -> tuple[Carried, bool]:
    pages = all_pages(tiff)
    order = tiff.byteorder
    is_dng = any(DNG_VERSION in page.tags for page in pages)
    mosaic = main_mosaic(pages) if is_dng else None

    tags: Tags = {}
    for page in (pages[0], mosaic):
        for tag in () if page is None else page.tags:
            kept = tag.code not in _DROPPED if is_dng else tag.code in _OF_ANY_TIFF
            if kept:
                tags[tag.code] = (int(tag.dtype), tag.count, _value(tag))
    if mosaic is not None and not _fills_active_area(mosaic, size):
        for code in _CROP:
            tags.pop(code, None)

    directories = {}
    for name, code in SUB_DIRECTORIES.items():
        if code in pages[0].tags:
            pointer = pages[0].tags[code].offset + _VALUE
            directories[name] = _read_directory(file, order, pointer, is_pointer=True)

    interoperability = _take_pointers(file, order, directories.get("ExifTag", []), _is_safe_to_move(pages[0]))
    previews = _previews(pages, file, order) if is_dng else []
    return Carried(order, tags, directories, interoperability, previews), is_dng


def _is_safe_to_move(page: Any) -> bool:
    return page.tags.valueof(_MAKER_NOTE_SAFETY) == 1


def _take_pointers(file: BinaryIO, order: str, exif: list[Entry], is_note_safe: bool) -> list[Entry]:
    """Take out of EXIF what points into the old file; the interoperability directory is returned."""
    interoperability: list[Entry] = []
    for entry in list(exif):
        if entry.code == INTEROPERABILITY:
            exif.remove(entry)
            (place,) = struct.unpack_from(order + "I", entry.data.ljust(4, b"\0"))
            interoperability = _read_directory(file, order, place)
        elif entry.code == MAKER_NOTE and not is_note_safe:
            exif.remove(entry)
    return interoperability


def _value(tag: Any) -> Any:
    """Text as tifffile writes it: 7 bits; other texts as the bytes that they are in UTF-8."""
    if tag.dtype == ASCII and isinstance(tag.value, str) and not tag.value.isascii():
        return tag.value.encode() + b"\0"
    return tag.value


def _fills_active_area(mosaic: Any, size: tuple[int, int]) -> bool:
    area = mosaic.tags.valueof(ACTIVE_AREA) or (0, 0, mosaic.imagelength, mosaic.imagewidth)
    return bool((area[2] - area[0], area[3] - area[1]) == size)


def _read_directory(file: BinaryIO, order: str, place: int, is_pointer: bool = False) -> list[Entry]:
    """The entries of the directory at ``place``, or of that which stands where ``place`` points to."""
    if is_pointer:
        (place,) = _unpack(file, order + "I", place)
    (count,) = _unpack(file, order + "H", place)

    left = file.seek(0, SEEK_END)
    entries = []
    for start in range(place + 2, place + 2 + 12 * count, 12):
        code, dtype, values = _unpack(file, order + "HHI", start)
        if not 0 < dtype < len(_SIZES):
            continue

        size = _SIZES[dtype] * values
        left -= size
        if left < 0:
            raise ValueError(f"values of tag {code} and others are larger than the file")
        at = start + _VALUE
        if size > 4:
            (at,) = _unpack(file, order + "I", start + _VALUE)
        file.seek(at)
        entries.append(Entry(code, dtype, values, file.read(size)))
    return entries


def _unpack(file: BinaryIO, form: str, place: int) -> tuple[Any, ...]:
    file.seek(place)
    return struct.unpack(form, file.read(struct.calcsize(form)))


# -- previews ----------------------------------------------------------------------------------------------------------


def _previews(pages: list[Any], file: BinaryIO, order: str) -> list[Preview]:
    """The reduced pictures of a DNG, the largest last."""
    previews = []
    left = _MOST_PREVIEW_BYTES
    for page in sorted(pages, key=lambda page: page.imagelength * page.imagewidth):
        is_reduced = int(page.tags.valueof(_SUBFILE_TYPE) or 0) & _REDUCED
        if not is_reduced or int(page.photometric) not in _PREVIEW_PHOTOMETRICS:
            continue
        preview = _preview(page, file, order)
        if preview is None:
            continue
        left -= sum(map(len, preview.segments))
        if left >= 0:
            previews.append(preview)
    return previews


def _preview(page: Any, file: BinaryIO, order: str) -> Preview | None:
    """A page with its data; None if it has none, or they are not in the file."""
    entries = _read_directory(file, order, page.offset)
    for places, lengths in _SEGMENTS:
        if places not in page.tags or lengths not in page.tags:
            continue
        segments = []
        for place, length in zip(
            np.ravel(page.tags.valueof(places)), np.ravel(page.tags.valueof(lengths)), strict=True
        ):
            if length > _MOST_PREVIEW_BYTES:
                return None
            file.seek(int(place))
            segments.append(file.read(int(length)))
            if len(segments[-1]) < length:
                return None

        kept = [entry for entry in entries if entry.code in _PREVIEW_TAGS and entry.code not in (places, lengths)]
        return Preview(kept, segments, (places, lengths))
    return None


def _decoded_preview(path: Path, order: str) -> list[Preview]:
    """What LibRaw gives as the preview of a file: a JPEG, or a bitmap."""
    try:
        preview = read_preview(path)
    except (OSError, ValueError):  # no RAW file, such as a TIFF that lends its EXIF
        return []
    if preview is None:
        return []
    if isinstance(preview, np.ndarray):
        height, width = preview.shape[:2]
        return [_made_preview(order, height, width, np.ascontiguousarray(preview, np.uint8).tobytes(), 1, 2, None)]

    with extra("raw"):
        from PIL import Image

    try:
        picture: Any = Image.open(BytesIO(preview))
    except (OSError, SyntaxError, ValueError):  # the mosaic may be whole
        return []
    if picture.mode not in ("RGB", "L") or not hasattr(picture, "layer"):
        return []
    _, across, down, *_ = picture.layer[0]
    photometric = 6 if picture.mode == "RGB" else 1
    return [_made_preview(order, picture.height, picture.width, preview, 7, photometric, (across, down))]


def _made_preview(
    order: str,
    height: int,
    width: int,
    data: bytes,
    compression: int,
    photometric: int,
    subsampling: tuple[int, int] | None,
) -> Preview:
    """A preview in one strip, of 8 bits."""
    colours = 1 if photometric == 1 else 3
    numbers: dict[int, tuple[int, ...]] = {
        _SUBFILE_TYPE: (_REDUCED,),
        256: (width,),
        257: (height,),
        258: (8,) * colours,
        259: (compression,),
        262: (photometric,),
        277: (colours,),
        278: (height,),
        284: (1,),
    }
    if photometric == 6 and subsampling is not None:
        numbers[530] = subsampling

    entries = []
    for code, values in numbers.items():
        dtype, letter = (LONG, "I") if code in (_SUBFILE_TYPE, 256, 257, 278) else (SHORT, "H")
        entries.append(Entry(code, dtype, len(values), struct.pack(f"{order}{len(values)}{letter}", *values)))
    return Preview(entries, [data], (273, 279))
