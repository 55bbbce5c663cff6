"""EXIF, XMP and ICC profiles, carried from one picture file to another byte for byte.

Between two files of one format, everything is copied as it is: the segments of a JPEG and what follows its picture
(gain maps, short films), the chunks of a PNG before and after its pixels, the tags of a TIFF. To another format, EXIF,
XMP and the ICC profile are copied. Data that describe the coding of the pixels are the new file's own. Three things are
corrected because new pixels make them untrue: a thumbnail in EXIF is rendered again into the bytes that it has; an
orientation becomes 1 if the decoder has turned the picture (HEIC, JPEG XL); and the list of pictures in a JPEG of
several (MPF) gets their new places. Source: Exif 2.32; CIPA DC-007 (MPF); PNG 3; TIFF 6.0.
"""

from __future__ import annotations

import re
import struct
import warnings
import zlib
from collections.abc import Iterable
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from rawaug.io.directories import (
    EXIF,
    GPS,
    POINTERS,
    DamagedTags,
    Tag,
    TiffFile,
    pack_directory,
)
from rawaug.io.exif import LAYOUT, NOT_IN_EXIF, Thumbnail, leave_out, mend_exif, tiff_head
from rawaug.io.headers import (
    EXIF_PREFIX,
    ICC_PREFIX,
    ICC_TAG,
    PNG_SIGNATURE,
    XMP_KEYWORD,
    XMP_PREFIX,
    XMP_TAG,
    Segment,
    chunk_data,
    jpeg_segments,
    png_chunks,
)

_STRIP_OFFSETS, _STRIP_BYTES = 273, 279
_MPF_PREFIX = b"MPF\0"
_JFXX_PREFIX = b"JFXX\0"
_APP0, _APP1, _APP2, _APP14, _APP15, _COMMENT = 0xE0, 0xE1, 0xE2, 0xEE, 0xEF, 0xFE
_MOST_IN_SEGMENT = 65533
_MP_ENTRIES = 45058

_OF_PNG_CODING = (
    *(b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"hIST", b"sPLT", b"bKGD", b"sBIT"),
    *(b"acTL", b"fcTL", b"fdAT"),
)
_KEPT_OF_PNG = (b"iCCP", b"sRGB", b"gAMA", b"cHRM", b"cICP", b"mDCV", b"cLLI", b"mDCv", b"cLLi", b"tIME")
"""These chunks may only be copied to other pixels because they are known."""


class Metadata(NamedTuple):
    """The metadata of a file, besides its pixels.

    Args:
        source: the file.
        format: of its content, such as ``"JPEG"``.
        exif: a block that begins with a TIFF's header; for a TIFF, one that is made of its tags.
        xmp: a packet of XMP.
        profile: the ICC profile.
    """

    source: Path
    format: str
    exif: bytes | None
    xmp: bytes | None
    profile: bytes | None


# -- JPEG --------------------------------------------------------------------------------------------------------------


def dress_jpeg(plain: bytes, metadata: Metadata, thumbnail: Thumbnail | None, upright: bool) -> bytes:
    """Give a JPEG, as an encoder writes it, the metadata of the source in place of the encoder's."""
    coding = _without_application_segments(plain)
    if metadata.format != "JPEG":
        return b"\xff\xd8" + _new_segments(metadata, thumbnail, upright) + coding

    with metadata.source.open("rb") as file:
        segments = [segment for segment in jpeg_segments(file) if _is_kept(segment)]
        file.seek(0)
        source = file.read()

    head = b"\xff\xd8"
    for segment in segments:
        head += _pack_segment(_mended(segment, thumbnail, upright))

    end = _end_of_picture(source)
    trailer = source[end:]
    if not trailer.strip(b"\0"):
        return head + coding + trailer
    return _with_places(head + coding, segments, source, end) + trailer


def _is_kept(segment: Segment) -> bool:
    """Tell whether a segment is metadata, and neither a table nor the encoder's data on its colours."""
    if segment.marker == _COMMENT:
        return True
    if segment.marker == _APP14 and segment.data.startswith(b"Adobe"):
        return False
    if segment.marker == _APP0 and segment.data.startswith(_JFXX_PREFIX):
        return False
    return _APP0 <= segment.marker <= _APP15


def _mended(segment: Segment, thumbnail: Thumbnail | None, upright: bool) -> Segment:
    if segment.marker != _APP1 or not segment.data.startswith(EXIF_PREFIX):
        return segment
    exif = mend_exif(segment.data[len(EXIF_PREFIX) :], thumbnail, upright)
    return segment._replace(data=EXIF_PREFIX + exif)


def _pack_segment(segment: Segment) -> bytes:
    return struct.pack(">BBH", 0xFF, segment.marker, len(segment.data) + 2) + segment.data


def _new_segments(metadata: Metadata, thumbnail: Thumbnail | None, upright: bool) -> bytes:
    """Pack EXIF, XMP and the profile of another kind of file; warn if one is too long for a segment."""
    packed = b""
    if metadata.exif is not None:
        exif = EXIF_PREFIX + mend_exif(metadata.exif, thumbnail, upright)
        packed += _pack_if_short("EXIF", exif, metadata.source)
    if metadata.xmp is not None:
        packed += _pack_if_short("XMP", XMP_PREFIX + metadata.xmp, metadata.source)
    if metadata.profile is not None:
        packed += _profile_segments(metadata.profile)
    return packed


def _pack_if_short(what: str, data: bytes, source: Path) -> bytes:
    """Pack a segment of metadata; return nothing, with a warning, if it does not fit into one."""
    if len(data) > _MOST_IN_SEGMENT:
        warnings.warn(f"{source}: its {what} of {len(data)} bytes is left out of a JPEG", stacklevel=2)
        return b""
    return _pack_segment(Segment(_APP1, data))


def _profile_segments(profile: bytes) -> bytes:
    """Pack an ICC profile into as many segments as it needs, each with its number and their count."""
    step = _MOST_IN_SEGMENT - len(ICC_PREFIX) - 2
    starts = range(0, len(profile), step)

    packed = b""
    for number, start in enumerate(starts, 1):
        head = ICC_PREFIX + bytes((number, len(starts)))
        packed += _pack_segment(Segment(_APP2, head + profile[start : start + step]))
    return packed


def _without_application_segments(plain: bytes) -> bytes:
    """Select the tables and the scans of a JPEG, which follow its start and its application segments."""
    offset = 2
    while plain[offset] == 0xFF and _APP0 <= plain[offset + 1] <= _APP15:
        (length,) = struct.unpack_from(">H", plain, offset + 2)
        offset += 2 + length
    return plain[offset:]


_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]", re.DOTALL)
"""This matches a marker within or after a scan, except for a stuffed byte or a restart."""


def _end_of_picture(source: bytes) -> int:
    """Find where the first picture of a JPEG ends, after its end-of-image marker or else at the file's end."""
    offset = 2
    while (match := _MARKER.search(source, offset)) is not None:
        marker = source[match.start() + 1]
        if marker == 0xD9:
            return match.end()
        if match.end() + 2 > len(source):
            break
        (length,) = struct.unpack_from(">H", source, match.end())
        offset = match.end() + length

    return len(source)


def _with_places(new: bytes, segments: list[Segment], source: bytes, end: int) -> bytes:
    """Update the list of pictures (MPF) of the new first picture, if it has one, with the others' new places."""
    listing = _pack_listing(segments)
    if listing is None:
        return new

    old_place = source.index(listing) + len(_MPF_PREFIX)
    new_place = new.index(listing) + len(_MPF_PREFIX)
    block = bytearray(listing[len(_MPF_PREFIX) :])
    try:
        tiff = TiffFile(BytesIO(block))
        entry = tiff.directory(tiff.first).entries.get(_MP_ENTRIES)
    except DamagedTags:
        return new
    if entry is None:
        return new

    for at in range(entry.offset, entry.offset + entry.size - 15, 16):
        size, offset = struct.unpack_from(tiff.order + "II", block, at + 4)
        if offset == 0:
            struct.pack_into(tiff.order + "I", block, at + 4, len(new))
        elif old_place + offset >= end:
            moved = old_place + offset - end + len(new) - new_place
            struct.pack_into(tiff.order + "II", block, at + 4, size, moved)

    return new[:new_place] + bytes(block) + new[new_place + len(block) :]


def _pack_listing(segments: Iterable[Segment]) -> bytes | None:
    """Find the list of pictures in a JPEG of several."""
    for segment in segments:
        if segment.marker == _APP2 and segment.data.startswith(_MPF_PREFIX):
            return segment.data
    return None


# -- PNG ---------------------------------------------------------------------------------------------------------------


def dress_png(plain: bytes, metadata: Metadata, thumbnail: Thumbnail | None, upright: bool) -> bytes:
    """Give a PNG, as an encoder writes it, the metadata of the source in their places."""
    before, behind = _png_parts(metadata, thumbnail, upright)
    header: list[bytes] = []
    pixels: list[bytes] = []
    file = BytesIO(plain)
    for chunk in png_chunks(file):
        if chunk.name == b"IHDR":
            header.append(pack_chunk(chunk.name, chunk_data(file, chunk)))
        elif chunk.name == b"IDAT":
            pixels.append(pack_chunk(chunk.name, chunk_data(file, chunk)))

    return b"".join((PNG_SIGNATURE, *header, *before, *pixels, *behind, pack_chunk(b"IEND", b"")))


def pack_chunk(name: bytes, data: bytes) -> bytes:
    """Pack a chunk of a PNG."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def _png_parts(metadata: Metadata, thumbnail: Thumbnail | None, upright: bool) -> tuple[list[bytes], list[bytes]]:
    """Collect the chunks of metadata before and after the pixels."""
    if metadata.format != "PNG":
        return _new_chunks(metadata, thumbnail, upright), []

    before: list[bytes] = []
    behind: list[bytes] = []
    side = before
    with metadata.source.open("rb") as file:
        for chunk in png_chunks(file):
            if chunk.name == b"IDAT":
                side = behind
            if not _is_copied(chunk.name):
                continue
            data = chunk_data(file, chunk)
            if chunk.name == b"eXIf":
                data = mend_exif(data, thumbnail, upright)
            side.append(pack_chunk(chunk.name, data))
    return before, behind


def _new_chunks(metadata: Metadata, thumbnail: Thumbnail | None, upright: bool) -> list[bytes]:
    """Make chunks of the profile, EXIF and XMP of another kind of file."""
    chunks = []
    if metadata.profile is not None:
        chunks.append(pack_chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(metadata.profile)))
    if metadata.exif is not None:
        chunks.append(pack_chunk(b"eXIf", mend_exif(metadata.exif, thumbnail, upright)))
    if metadata.xmp is not None:
        chunks.append(pack_chunk(b"iTXt", XMP_KEYWORD + b"\0\0\0\0\0" + metadata.xmp))
    return chunks


def _is_copied(name: bytes) -> bool:
    """Tell whether a chunk may go with other pixels: it is known to, or its name says so."""
    if name in _OF_PNG_CODING:
        return False
    return name in _KEPT_OF_PNG or bool(name[3:4].islower())


# -- TIFF --------------------------------------------------------------------------------------------------------------


def dress_tiff(plain: bytes, metadata: Metadata, upright: bool) -> bytes:
    """Give a TIFF, as an encoder writes it, the tags of the source, in the byte order of the block.

    The block of EXIF comes first and keeps its offsets, since makers' notes may hold such offsets. Its thumbnail is not
    linked, since readers would take it for a second page.
    """
    tiff = TiffFile(BytesIO(plain))
    order = tiff.order
    block = _pack_exif(metadata, order, upright)

    start = len(block) + len(block) % 2
    offset = start
    strips: list[bytes] = []
    places: list[int] = []
    for strip in _strips(tiff):
        even = strip + bytes(len(strip) % 2)
        places.append(offset)
        strips.append(even)
        offset += len(even)

    tags: dict[int, Tag] = {}
    for tag in (*_tags_of_parts(metadata, order), *_tags_of_block(block)):
        tags.setdefault(tag.code, tag)
    for entry in tiff.directory(tiff.first).entries.values():
        if entry.code in LAYOUT:
            tags[entry.code] = tiff.tag(entry)
    tags[_STRIP_OFFSETS] = Tag(_STRIP_OFFSETS, 4, len(places), struct.pack(f"{order}{len(places)}I", *places))

    directory = pack_directory(order, tags.values(), offset)
    head = block[:4] + struct.pack(order + "I", offset)
    return b"".join((head, block[8:].ljust(start - 8, b"\0"), *strips, directory))


def byte_order(metadata: Metadata) -> str:
    """Find the byte order of the metadata, ``<`` or ``>``, which a TIFF that holds them must have."""
    if metadata.exif is not None and metadata.exif.startswith(b"MM"):
        return ">"
    return "<"


def _tags_of_block(block: bytes) -> list[Tag]:
    """Select the tags of a block's first directory that a picture's can have, with the pointers to EXIF and GPS."""
    tiff = TiffFile(BytesIO(block))
    entries = tiff.directory(tiff.first).entries
    pointers = [entries[code] for code in (EXIF, GPS) if code in entries]
    return tiff.tags(leave_out(entries.values(), LAYOUT, POINTERS) + pointers)


def _pack_exif(metadata: Metadata, order: str, upright: bool) -> bytes:
    """Return the EXIF block, or an empty one if there is none or it is damaged."""
    if metadata.exif is not None:
        try:
            _tags_of_block(metadata.exif)
            return mend_exif(metadata.exif, None, upright)
        except DamagedTags as error:
            warnings.warn(f"{metadata.source}: its EXIF is damaged ({error}) and left out", stacklevel=2)

    return tiff_head(order) + pack_directory(order, [], 8)


def _tags_of_parts(metadata: Metadata, order: str) -> list[Tag]:
    """Make tags of XMP and the profile, and for a TIFF also of its IPTC and Photoshop's resources."""
    if metadata.format == "TIFF":
        with metadata.source.open("rb") as file:
            tiff = TiffFile(file)
            entries = tiff.directory(tiff.first).entries
            return tiff.tags([entries[code] for code in NOT_IN_EXIF if code in entries])

    tags = []
    if metadata.xmp is not None:
        tags.append(Tag(XMP_TAG, 1, len(metadata.xmp), metadata.xmp))
    if metadata.profile is not None:
        tags.append(Tag(ICC_TAG, 7, len(metadata.profile), metadata.profile))
    return tags


def _strips(tiff: TiffFile) -> list[bytes]:
    first = tiff.directory(tiff.first)
    places = tiff.numbers(first.entries.get(_STRIP_OFFSETS))
    sizes = tiff.numbers(first.entries.get(_STRIP_BYTES))
    return [tiff.read(offset, size) for offset, size in zip(places, sizes, strict=True)]
