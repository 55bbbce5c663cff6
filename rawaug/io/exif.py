"""EXIF blocks: read as they are, made of the tags of a TIFF, and mended where new pixels make them untrue.

A block is a small TIFF without pixels. A thumbnail in it is rendered again into the bytes that it has, and an
orientation becomes 1 if the decoder has turned the picture. Source: Exif 2.32; TIFF 6.0.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterable
from io import BytesIO
from pathlib import Path

import numpy as np

from rawaug.io.directories import (
    EXIF,
    GPS,
    INTEROPERABILITY,
    ORIENTATION,
    POINTERS,
    THUMBNAIL,
    THUMBNAIL_BYTES,
    DamagedTags,
    Directory,
    Entry,
    Tag,
    TiffFile,
    pack_directory,
    pointer_tag,
)
from rawaug.io.headers import ICC_TAG, XMP_TAG, read_headers

IPTC_TAG, PHOTOSHOP_TAG = 33723, 34377
_LARGEST_THUMBNAIL = 2**20
"""A thumbnail is rendered up to this many pixels; a larger one is left as it is."""

LAYOUT = frozenset(
    (
        *(*range(254, 260), *range(262, 267), 273, *range(277, 282), 284, 285, *range(288, 294), 301, 317),
        *(*range(320, 331), *range(332, 348), *range(512, 522), *range(529, 533), 559, 37724),
    )
)
"""These tags of a TIFF describe how its pixels are stored; 37724 holds Photoshop's layers, which are other pixels."""
_DNG_TAGS = range(50706, 52600)
NOT_IN_EXIF = frozenset((XMP_TAG, IPTC_TAG, PHOTOSHOP_TAG, ICC_TAG, *_DNG_TAGS))
"""Other files have these tags of a TIFF in separate parts, or, being no DNG, must not have them."""

Thumbnail = Callable[[int, int], np.ndarray]
"""It renders the new picture, as it is stored, at a height and a width: uint8 ``(h, w, 3)``."""


def read_exif(path: Path, name: str) -> bytes | None:
    """Read the EXIF block of a file of the format ``name``.

    That of a TIFF is made of EXIF, GPS and the tags of its first directory that are no part of its coding.
    """
    if name != "TIFF":
        return read_headers(path, name).exif

    try:
        with path.open("rb") as file:
            tiff = TiffFile(file)
            first = tiff.directory(tiff.first)
            entries = leave_out(first.entries.values(), LAYOUT, POINTERS, NOT_IN_EXIF)
            return _pack_block(tiff, tiff.tags(entries), first)
    except (DamagedTags, struct.error):
        return None


def leave_out(entries: Iterable[Entry], *codes: Container[int]) -> list[Entry]:
    """Select the entries whose codes are in none of these."""
    return [entry for entry in entries if not any(entry.code in some for some in codes)]


def _pack_block(tiff: TiffFile, tags: list[Tag], first: Directory) -> bytes:
    """Pack a block of ``tags`` and of the directories that ``first`` points at."""
    codes = [code for code in (EXIF, GPS) if code in first.entries]
    placeholders = [pointer_tag(tiff.order, code, 0) for code in codes]
    size = len(pack_directory(tiff.order, tags + placeholders, 8))

    behind = b""
    pointers = []
    for code in codes:
        offset = 8 + size + len(behind)
        pointers.append(pointer_tag(tiff.order, code, offset))
        behind += _pack_pointed(tiff, tiff.number(first, code), offset)

    return tiff_head(tiff.order) + pack_directory(tiff.order, tags + pointers, 8) + behind


def tiff_head(order: str) -> bytes:
    """Make the first eight bytes of a TIFF whose first directory follows."""
    signature = b"II*\0" if order == "<" else b"MM\0*"
    return signature + struct.pack(order + "I", 8)


def _pack_pointed(tiff: TiffFile, source: int, offset: int) -> bytes:
    """Pack the directory at ``source`` of a file for ``offset`` of a block, followed by the interoperability one."""
    directory = tiff.directory(source)
    tags = tiff.tags(leave_out(directory.entries.values(), POINTERS))
    if INTEROPERABILITY not in directory.entries:
        return pack_directory(tiff.order, tags, offset)

    size = len(pack_directory(tiff.order, [*tags, pointer_tag(tiff.order, INTEROPERABILITY, 0)], offset))
    inner = tiff.directory(tiff.number(directory, INTEROPERABILITY))
    inner_tags = tiff.tags(inner.entries.values())
    pointed = [*tags, pointer_tag(tiff.order, INTEROPERABILITY, offset + size)]
    return pack_directory(tiff.order, pointed, offset) + pack_directory(tiff.order, inner_tags, offset + size)


def mend_exif(exif: bytes, thumbnail: Thumbnail | None, upright: bool) -> bytes:
    """Render a block's thumbnail again, and set its orientation to 1 if the picture was turned ``upright``.

    Every other byte stays where it is. A damaged block is left as it is.
    """
    block = bytearray(exif)
    try:
        tiff = TiffFile(BytesIO(exif))
        first = tiff.directory(tiff.first)
        entry = first.entries.get(ORIENTATION)
        if upright and entry is not None and entry.dtype == 3:
            struct.pack_into(tiff.order + "H", block, entry.offset, 1)

        if thumbnail is not None and first.following:
            _mend_thumbnail(block, tiff, tiff.directory(first.following), thumbnail)
    except (DamagedTags, struct.error):
        return exif
    return bytes(block)


def _mend_thumbnail(block: bytearray, tiff: TiffFile, second: Directory, render: Thumbnail) -> None:
    """Put a new JPEG of the same sides in place of the old one, at the best quality that fits."""
    from PIL import Image

    start, size = tiff.number(second, THUMBNAIL), tiff.number(second, THUMBNAIL_BYTES)
    if not size or start + size > len(block):
        return

    try:
        with Image.open(BytesIO(block[start : start + size]), formats=("JPEG",)) as old:
            width, height = old.size
    except (OSError, SyntaxError, ValueError):
        return
    if width * height > _LARGEST_THUMBNAIL:
        return

    jpeg = _small_jpeg(render(height, width), size)
    if jpeg is None:
        return

    block[start : start + size] = jpeg.ljust(size, b"\0")
    entry = second.entries[THUMBNAIL_BYTES]
    letter = "H" if entry.dtype == 3 else "I"
    struct.pack_into(tiff.order + letter, block, entry.offset, len(jpeg))


def _small_jpeg(pixels: np.ndarray, size: int) -> bytes | None:
    """Encode a JPEG at the best quality that takes at most ``size`` bytes; return None if none does."""
    from PIL import Image

    picture = Image.fromarray(pixels)
    for quality in (95, 90, 85, 80, 70, 60, 50, 40, 30, 20, 10):
        file = BytesIO()
        picture.save(file, "JPEG", quality=quality)
        if file.tell() <= size:
            return file.getvalue()
    return None
