"""What a DNG keeps of the RAW file that it was made from: tags, EXIF, GPS, XMP, and previews.

All tags of a DNG's first directory and of its mosaic's directory are copied, except those that describe the old pixels
(layout, levels, digests, noise profile). The private tags of other TIFFs (NEF, CR2, ARW) have other meanings, so only
their description, author, XMP, EXIF and GPS are copied. EXIF, GPS and interoperability directories are copied byte for
byte. A maker's note is copied if the file says that it is safe to move (MakerNoteSafety).

The previews of a DNG are copied with the tags that describe them. For other files, LibRaw extracts the preview.
Source: DNG specification 1.4, chapters 2 to 4; TIFF 6.0, section 2; EXIF 2.32, section 4.6.
"""

from __future__ import annotations

import struct
import warnings
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from rawaug.errors import extra
from rawaug.io.directories import EXIF, GPS, INTEROPERABILITY, Tag, TiffFile
from rawaug.io.opcodes import OPCODE_LIST_1, OPCODE_LISTS, move_opcodes
from rawaug.io.raw import read_preview
from rawaug.io.tiff import active_area, all_pages, is_dng, main_mosaic, opened_tiff

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
"""These are the numbers of TIFF's types."""

SUB_DIRECTORIES = {"ExifTag": EXIF, "GPSTag": GPS}
MAKER_NOTE, _MAKER_NOTE_SAFETY = 37500, 50741

_OF_ANY_TIFF = (270, 271, 272, 306, 315, 700, 33432)
_LAYOUT = (
    *(*range(254, 260), 262, 266, 273, 277, 278, 279, 282, 283, 284, 296, 297, 317),
    *(*range(320, 326), 330, 338, 339),
)
_OF_PREVIEWS = (*range(512, 522), *range(529, 533), *range(50966, 50972))
_LEVELS = (33421, 33422, 50711, 50712, *range(50713, 50718), 50829, 50830, 51041)
_DIGESTS = (50781, 50828, 50972, 50973, 51111, 51114)
_REPLACED = (274, 305, 347, MAKER_NOTE, *SUB_DIRECTORIES.values())
_CROP = (50719, 50720)
_DROPPED = frozenset((*_LAYOUT, *_OF_PREVIEWS, *_LEVELS, *_DIGESTS, *_REPLACED, *_CROP))

_PREVIEW_TAGS = frozenset((*_LAYOUT, *_OF_PREVIEWS, 34675)) - {320, 330}
"""These tags of a preview's directory are copied: its layout, the program that made it, its colour profile."""
_SEGMENTS = ((273, 279), (324, 325), (513, 514))
"""These tags have the places and the lengths of strips, of tiles, and of a JPEG."""
_PREVIEW_PHOTOMETRICS = (1, 2, 6)
"""Previews have these photometric interpretations: grey, RGB, YCbCr."""
_GREY, _YCBCR = 1, 6
_SUBFILE_TYPE, _REDUCED = 254, 1
_MOST_PREVIEW_BYTES = 2**26
"""All previews of a file together have at most this size."""

Tags = dict[int, tuple[int, int, Any]]
"""It maps codes to type, count and value, as tifffile writes them; tifffile counts characters of text itself."""


@dataclass(frozen=True)
class Preview:
    """A small picture in a RAW file.

    Attributes:
        entries: the tags of its directory, except those with the places and lengths of its data.
        segments: the data of each strip or tile.
        codes: the tags of the places and of the lengths of the segments.
    """

    entries: list[Tag]
    segments: list[bytes]
    codes: tuple[int, int]


@dataclass(frozen=True)
class Carried:
    """What a DNG keeps of its source.

    Attributes:
        byte_order: ``<`` or ``>``.
        tags: the tags of the picture.
        directories: the EXIF and GPS directories, by the names of their pointers.
        interoperability: the directory that EXIF points to.
        previews: sorted by size, the largest last.
    """

    byte_order: str = "<"
    tags: Tags = field(default_factory=dict)
    directories: dict[str, list[Tag]] = field(default_factory=dict)
    interoperability: list[Tag] = field(default_factory=list)
    previews: list[Preview] = field(default_factory=list)


def read_carried(path: Path, size: tuple[int, int], offset: tuple[int, int] | None = None) -> Carried:
    """Read what a DNG keeps of the file at ``path``.

    Args:
        path: the source.
        size: height and width of the mosaic that the DNG has.
        offset: rows and columns of the sensor above the mosaic and to its left; None for the origin of the active area.
    """
    with extra("raw"):
        import tifffile

    carried, source_is_dng = Carried(), False
    try:
        with opened_tiff(path) as opened, path.open("rb") as file:
            pages = all_pages(opened)
            source_is_dng = is_dng(pages)
            carried = _read_tiff(path, pages, TiffFile(file), size, offset)
    except tifffile.TiffFileError:
        source_is_dng = False

    if not source_is_dng:
        carried.previews.extend(_decoded_preview(path, carried.byte_order))
    return carried


def _read_tiff(
    path: Path, pages: list[Any], tiff: TiffFile, size: tuple[int, int], offset: tuple[int, int] | None
) -> Carried:
    # The tags of the first page and of the mosaic; text that is not ASCII is written as its bytes in UTF-8.
    source_is_dng = is_dng(pages)
    mosaic = main_mosaic(pages) if source_is_dng else None
    tags: Tags = {}
    for page in (pages[0], mosaic):
        for tag in () if page is None else page.tags:
            if tag.code in _DROPPED if source_is_dng else tag.code not in _OF_ANY_TIFF:
                continue
            value = tag.value
            if tag.dtype == ASCII and isinstance(value, str) and not value.isascii():
                value = value.encode() + b"\0"
            tags[tag.code] = (int(tag.dtype), tag.count, value)

    # The directories of EXIF and GPS, without the tags of EXIF that point into the old file.
    first = tiff.directory(tiff.first)
    directories = {}
    for name, code in SUB_DIRECTORIES.items():
        if code in first.entries:
            entries = tiff.directory(tiff.number(first, code)).entries
            directories[name] = tiff.tags(entries.values())

    is_note_safe = pages[0].tags.valueof(_MAKER_NOTE_SAFETY) == 1
    interoperability: list[Tag] = []
    exif = []
    for entry in directories.get("ExifTag", []):
        if entry.code == INTEROPERABILITY:
            (start,) = struct.unpack_from(tiff.order + "I", entry.data.ljust(4, b"\0"))
            interoperability = tiff.tags(tiff.directory(start).entries.values())
        elif entry.code != MAKER_NOTE or is_note_safe:
            exif.append(entry)
    if "ExifTag" in directories:
        directories["ExifTag"] = exif

    previews = _read_previews(pages, tiff) if source_is_dng else []
    if mosaic is not None:
        _move_opcodes(path, tags, mosaic, size, offset)
    return Carried(tiff.order, tags, directories, interoperability, previews)


def _move_opcodes(path: Path, tags: Tags, mosaic: Any, size: tuple[int, int], offset: tuple[int, int] | None) -> None:
    """Move the opcodes in ``tags`` from the stored mosaic and its active area to the one that is written."""
    top, left, bottom, right = active_area(mosaic)
    if offset is None:
        offset = (top, left)

    for code in OPCODE_LISTS:
        if code not in tags:
            continue
        dtype, _, opcodes = tags.pop(code)
        if code == OPCODE_LIST_1:
            moved, left_out = move_opcodes(bytes(opcodes), offset, (mosaic.imagelength, mosaic.imagewidth), size)
        else:
            shift = (offset[0] - top, offset[1] - left)
            moved, left_out = move_opcodes(bytes(opcodes), shift, (bottom - top, right - left), size)
        if moved:
            tags[code] = (dtype, len(moved), moved)
        for what in left_out:
            warnings.warn(f"{path}: its DNG is written without {what}", stacklevel=2)


# -- previews ----------------------------------------------------------------------------------------------------------


def _read_previews(pages: list[Any], tiff: TiffFile) -> list[Preview]:
    """Read the reduced pictures of a DNG with their data, sorted by size; those that are incomplete are left out."""
    previews = []
    remaining = _MOST_PREVIEW_BYTES
    for page in sorted(pages, key=lambda page: int(page.imagelength * page.imagewidth)):
        is_reduced = int(page.tags.valueof(_SUBFILE_TYPE) or 0) & _REDUCED
        if not is_reduced or int(page.photometric) not in _PREVIEW_PHOTOMETRICS:
            continue

        codes = next((codes for codes in _SEGMENTS if codes[0] in page.tags and codes[1] in page.tags), None)
        segments = None
        if codes is not None:
            segments = _read_segments(page, tiff, codes)
        if codes is None or segments is None:
            continue

        entries = []
        for code, entry in tiff.directory(page.offset).entries.items():
            if code in _PREVIEW_TAGS and code not in codes:
                entries.append(entry)
        preview = Preview(tiff.tags(entries), segments, codes)

        remaining -= sum(map(len, segments))
        if remaining >= 0:
            previews.append(preview)
    return previews


def _read_segments(page: Any, tiff: TiffFile, codes: tuple[int, int]) -> list[bytes] | None:
    """Read the strips or tiles of a page; return None if the file does not hold them all."""
    starts = np.ravel(page.tags.valueof(codes[0]))
    lengths = np.ravel(page.tags.valueof(codes[1]))
    segments = []
    for start, length in zip(starts.tolist(), lengths.tolist(), strict=True):
        if length > _MOST_PREVIEW_BYTES or start + length > tiff.end:
            return None
        segments.append(tiff.read(start, length))
    return segments


def _decoded_preview(path: Path, order: str) -> list[Preview]:
    """Let LibRaw extract the preview of a file, a JPEG or a bitmap; return an empty list if there is none."""
    try:
        preview = read_preview(path)
    except (OSError, ValueError):  # not a RAW file, such as a TIFF that supplies EXIF
        return []
    if preview is None:
        return []
    if isinstance(preview, np.ndarray):
        height, width = preview.shape[:2]
        data = np.ascontiguousarray(preview, np.uint8).tobytes()
        return [_one_strip(_layout(height, width, compression=1, photometric=2), data, order)]

    with extra("raw"):
        from PIL import Image

    try:
        picture: Any = Image.open(BytesIO(preview))
    except (OSError, SyntaxError, ValueError):  # the mosaic may be intact
        return []
    if picture.mode not in ("RGB", "L") or not hasattr(picture, "layer"):
        return []

    numbers = _layout(picture.height, picture.width, compression=7, photometric=_GREY)
    if picture.mode == "RGB":
        _, across, down, *_ = picture.layer[0]
        numbers = _layout(picture.height, picture.width, compression=7, photometric=_YCBCR)
        numbers[530] = (across, down)
    return [_one_strip(numbers, preview, order)]


def _layout(height: int, width: int, compression: int, photometric: int) -> dict[int, tuple[int, ...]]:
    """Give the numbers of the tags that describe a picture of 8 bits in one strip, by their codes."""
    channels = 1 if photometric == _GREY else 3
    return {
        _SUBFILE_TYPE: (_REDUCED,),
        256: (width,),
        257: (height,),
        258: (8,) * channels,
        259: (compression,),
        262: (photometric,),
        277: (channels,),
        278: (height,),
        284: (1,),
    }


def _one_strip(numbers: dict[int, tuple[int, ...]], data: bytes, order: str) -> Preview:
    entries = []
    for code, values in numbers.items():
        dtype, letter = SHORT, "H"
        if code in (_SUBFILE_TYPE, 256, 257, 278):
            dtype, letter = LONG, "I"
        entries.append(Tag(code, dtype, len(values), struct.pack(f"{order}{len(values)}{letter}", *values)))
    return Preview(entries, [data], (273, 279))
