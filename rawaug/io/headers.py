"""Metadata in the header of a picture file: EXIF and XMP as bytes, and whether it is an animation.

Each container is walked through by its own lengths, without decoding: the segments of JPEG, the chunks of PNG (some
programs write EXIF after the pixels) and of WebP, the directories of TIFF, and the boxes of HEIF and JPEG XL. Damage
ends the walk, and the decoder says what is wrong. Source: ITU-T T.81; PNG 3; RIFF container of WebP; TIFF 6.0; ISO/IEC
14496-12 and 18181-1.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from rawaug.io.boxes import MediaBox, boxes, inner_boxes, primary_item, read_properties
from rawaug.io.colour import ADOBE_RGB, SRGB_COLOUR, Colour, colour_from_chromaticities, colour_from_code_points
from rawaug.io.directories import EXIF, INTEROPERABILITY, ORIENTATION, DamagedTags, Directory, TiffFile
from rawaug.io.jpeg_xl import CODESTREAM, MOST_OF_CODESTREAM, read_codestream

EXIF_PREFIX = b"Exif\0\0"
XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
XMP_KEYWORD = b"XML:com.adobe.xmp"
XMP_TAG, ICC_TAG = 700, 34675

_MOST_CHUNKS = 2**20
_MOST_BYTES = 2**26
_PIECE = 2**20
_MOST_STRAY_BYTES = 1024
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
ICC_PREFIX = b"ICC_PROFILE\0"
_COLOR_SPACE, _INTEROPERABILITY_INDEX = 40961, 1
_WHITE_POINT, _CHROMATICITIES = 318, 319
_XMP_ORIENTATION = re.compile(rb"""tiff:Orientation(?:>|=["'])([1-8])\b""")


class Headers(NamedTuple):
    """Metadata of a picture file.

    Args:
        exif: a block that begins with a TIFF's header.
        xmp: a packet of XMP.
        stated: the orientation of a TIFF, whose tags are not a block.
        animated: whether the file says that it has several frames.
        colour: the space that the container states by other means than an ICC profile, where that counts.
        unread: why the colours cannot be read; empty if they can.
    """

    exif: bytes | None = None
    xmp: bytes | None = None
    stated: int | None = None
    animated: bool = False
    colour: Colour | None = None
    unread: str = ""

    @property
    def orientation(self) -> int | None:
        """The orientation that EXIF states, else that of XMP; None if neither does, or it is none of 1 to 8."""
        orientation = self.stated or orientation_of_exif(self.exif)
        if orientation is not None or self.xmp is None:
            return orientation

        match = _XMP_ORIENTATION.search(self.xmp)
        if match is None:
            return None
        return int(match[1])


def read_headers(path: Path, name: str) -> Headers:
    """Read the metadata of a file of the format ``name``; damaged or unknown parts are left out."""
    with path.open("rb") as file:
        return headers_of_opened(file, name)


def headers_of_opened(file: BinaryIO, name: str) -> Headers:
    """Read the metadata of an open file, as :func:`read_headers` does."""
    reader = _READERS.get(name)
    if reader is None:
        return Headers()

    try:
        return reader(file)
    except (DamagedTags, struct.error, zlib.error, ValueError, IndexError):
        return Headers()


def orientation_of_exif(exif: bytes | None) -> int | None:
    """Read the orientation of an EXIF block, 1 to 8; return None if it states none."""
    if not exif:
        return None
    try:
        tiff = TiffFile(BytesIO(exif))
        orientation = tiff.number(tiff.directory(tiff.first), ORIENTATION)
    except DamagedTags:
        return None

    if not 1 <= orientation <= 8:
        return None
    return orientation


# -- JPEG --------------------------------------------------------------------------------------------------------------


class Segment(NamedTuple):
    """A part of a JPEG's header: its marker, and the data after marker and length."""

    marker: int
    data: bytes


def jpeg_segments(file: BinaryIO) -> Iterator[Segment]:
    """Yield the segments of a JPEG before its first scan."""
    file.seek(2)
    while True:
        head = file.read(4)
        for _ in range(_MOST_STRAY_BYTES):  # as every decoder does, whatever stands before a marker is passed over
            if len(head) < 4 or (head[0] == 0xFF and head[1] not in (0x00, 0xFF)):
                break
            head = head[1:] + file.read(1)
        if len(head) < 4 or head[0] != 0xFF or head[1] in (_START_OF_SCAN, _END_OF_IMAGE):
            return

        length = int.from_bytes(head[2:], "big") - 2
        data = file.read(length)
        if len(data) < length or length < 0:
            return
        yield Segment(head[1], data)


def mend_jpeg_header(path: Path) -> bytes:
    """Give a JPEG without stray bytes between the segments of its header, and with a version of JFIF that exists."""
    with path.open("rb") as file:
        header = b"\xff\xd8"
        for marker, data in jpeg_segments(file):
            if data.startswith(b"JFIF\0") and len(data) > 6:
                data = data[:5] + b"\1\2" + data[7:]
            header += struct.pack(">BBH", 0xFF, marker, len(data) + 2) + data
        file.seek(-4, 1)  # jpeg_segments has read the marker of the scan
        return header + file.read()


def _of_jpeg(file: BinaryIO) -> Headers:
    exif, xmp = None, None
    has_profile = False
    for segment in jpeg_segments(file):
        has_profile |= segment.marker == 0xE2 and segment.data.startswith(ICC_PREFIX)
        if segment.marker != 0xE1:
            continue
        if segment.data.startswith(EXIF_PREFIX) and exif is None:
            exif = segment.data[len(EXIF_PREFIX) :]
        elif segment.data.startswith(XMP_PREFIX) and xmp is None:
            xmp = segment.data[len(XMP_PREFIX) :]

    colour = None
    if exif is not None and not has_profile:
        colour = read_exif_colour(BytesIO(exif))
    return Headers(exif, xmp, colour=colour)


def read_exif_colour(file: BinaryIO) -> Colour | None:
    """Find the space that EXIF states: Adobe RGB by R03 (DCF's option file), or by ColorSpace 2 of older cameras."""
    try:
        tiff = TiffFile(file)
        exif_place = tiff.number(tiff.directory(tiff.first), EXIF)
        if not exif_place:
            return None

        exif = tiff.directory(exif_place)
        space = tiff.number(exif, _COLOR_SPACE)
        index = b""
        offset = tiff.number(exif, INTEROPERABILITY)
        if offset:
            entry = tiff.directory(offset).entries.get(_INTEROPERABILITY_INDEX)
            index = tiff.tag(entry).data if entry is not None else b""
    except DamagedTags:
        return None

    if space == 2 or (space != 1 and index.startswith(b"R03")):
        return ADOBE_RGB
    return None


# -- PNG ---------------------------------------------------------------------------------------------------------------


class Chunk(NamedTuple):
    """A part of a PNG or WebP: its name, where its data begin, and their length."""

    name: bytes
    offset: int
    length: int


def png_chunks(file: BinaryIO) -> Iterator[Chunk]:
    """Yield the chunks of a PNG in their order."""
    offset = len(PNG_SIGNATURE)
    end = file.seek(0, 2)
    for _ in range(_MOST_CHUNKS):
        file.seek(offset)
        head = file.read(8)
        if len(head) < 8:
            return
        length, name = struct.unpack(">I4s", head)
        if offset + 12 + length > end:
            return
        yield Chunk(name, offset + 8, length)
        offset += 12 + length


def png_fault(path: Path) -> str | None:
    """Say what is wrong with the chunks of a PNG that hold its pixels; return None if they are whole.

    libpng would write this to the standard error stream, in addition to the line that names the file.
    """
    name = b""
    with path.open("rb") as file:
        for chunk in png_chunks(file):
            name = chunk.name
            if name == b"IEND":
                return None
            if name[:1].isupper() and _checksum(file, chunk) != file.read(4):
                return f"chunk {name.decode('latin-1')} has a wrong checksum"
    return f"it ends behind chunk {name.decode('latin-1')}" if name else "it ends in its header"


def _checksum(file: BinaryIO, chunk: Chunk) -> bytes:
    """Compute the checksum that a chunk should have; the file is then positioned at the one that it has."""
    file.seek(chunk.offset)
    left, checksum = chunk.length, zlib.crc32(chunk.name)
    while left:
        data = file.read(min(left, _PIECE))
        checksum = zlib.crc32(data, checksum)
        left -= len(data)
    return struct.pack(">I", checksum)


def chunk_data(file: BinaryIO, chunk: Chunk) -> bytes:
    """Read the data of a chunk."""
    if chunk.length > _MOST_BYTES:
        raise ValueError(f"chunk {chunk.name!r} of {chunk.length} bytes")
    file.seek(chunk.offset)
    return file.read(chunk.length)


def _of_png(file: BinaryIO) -> Headers:
    exif, xmp, raw_profile = None, None, None
    animated = False
    spaces: dict[bytes, bytes] = {}
    for chunk in png_chunks(file):
        if chunk.name in _PNG_SPACES:
            spaces.setdefault(chunk.name, chunk_data(file, chunk))
        elif chunk.name == b"acTL":
            animated = True
        elif chunk.name == b"eXIf":
            exif = chunk_data(file, chunk).removeprefix(EXIF_PREFIX)
        elif chunk.name == b"iTXt":
            xmp = xmp_of_text(chunk_data(file, chunk)) or xmp
        elif chunk.name in (b"zTXt", b"tEXt"):
            raw_profile = _raw_profile(chunk.name, chunk_data(file, chunk)) or raw_profile

    colour, unread = None, ""
    try:
        colour = _find_png_colour(spaces)
    except ValueError as error:
        unread = str(error)
    return Headers(exif or raw_profile, xmp, animated=animated, colour=colour, unread=unread)


_PNG_SPACES = (b"cICP", b"iCCP", b"sRGB", b"gAMA", b"cHRM")


def _find_png_colour(chunks: dict[bytes, bytes]) -> Colour | None:
    """Find the space by the first of its chunks that counts; return None for that of the profile, or of none."""
    if len(chunks.get(b"cICP", b"")) == 4:
        primaries, transfer, matrix, is_full_range = chunks[b"cICP"]
        if matrix or not is_full_range:
            raise ValueError("its cICP states a matrix, or the range of video")
        return colour_from_code_points(primaries, transfer)
    if b"iCCP" in chunks:
        return None
    if b"sRGB" in chunks:
        return SRGB_COLOUR

    exponent, chromaticities = None, None
    if len(chunks.get(b"gAMA", b"")) == 4:
        (gamma,) = struct.unpack(">I", chunks[b"gAMA"])
        exponent = 1e5 / gamma if gamma else None
    if len(chunks.get(b"cHRM", b"")) == 32:
        numbers = [number / 1e5 for number in struct.unpack(">8I", chunks[b"cHRM"])]
        chromaticities = numbers[2:] + numbers[:2]  # white comes first
    return colour_from_chromaticities(chromaticities, exponent)


def xmp_of_text(data: bytes) -> bytes | None:
    """Find the packet in an iTXt chunk; return None if it holds another text."""
    keyword, _, text = data.partition(b"\0")
    if keyword != XMP_KEYWORD or len(text) < 2:
        return None
    packet = text[2:].split(b"\0", 2)[-1]
    return inflate(packet) if text[0] else packet


def inflate(data: bytes) -> bytes:
    """Decompress data of zlib, up to a limit."""
    inflater = zlib.decompressobj()
    plain = inflater.decompress(data, _MOST_BYTES)
    if inflater.unconsumed_tail:
        raise ValueError(f"more than {_MOST_BYTES} bytes")
    return plain


def _raw_profile(name: bytes, data: bytes) -> bytes | None:
    """Read EXIF as ImageMagick wrote it before PNG had a chunk for it, as a text of hexadecimal numbers."""
    keyword, _, text = data.partition(b"\0")
    if keyword not in (b"Raw profile type exif", b"Raw profile type APP1"):
        return None
    if name == b"zTXt":
        text = inflate(text[1:])
    words = text.split(None, 2)
    profile = bytes.fromhex(words[2].decode("ascii"))
    return profile.removeprefix(EXIF_PREFIX) if profile.startswith((EXIF_PREFIX, b"II", b"MM")) else None


# -- WebP and TIFF -----------------------------------------------------------------------------------------------------


def webp_chunks(file: BinaryIO) -> Iterator[Chunk]:
    """Yield the chunks of a WebP in their order."""
    offset = 12
    end = file.seek(0, 2)
    for _ in range(_MOST_CHUNKS):
        file.seek(offset)
        head = file.read(8)
        if len(head) < 8:
            return
        name, length = struct.unpack("<4sI", head)
        if offset + 8 + length > end:
            return
        yield Chunk(name, offset + 8, length)
        offset += 8 + length + length % 2


def _of_webp(file: BinaryIO) -> Headers:
    exif, xmp = None, None
    animated = False
    for chunk in webp_chunks(file):
        if chunk.name == b"EXIF":
            exif = chunk_data(file, chunk).removeprefix(EXIF_PREFIX)
        elif chunk.name == b"XMP ":
            xmp = chunk_data(file, chunk)
        elif chunk.name == b"ANIM":
            animated = True
    return Headers(exif, xmp, animated=animated)


def _of_tiff(file: BinaryIO) -> Headers:
    tiff = TiffFile(file)
    first = tiff.directory(tiff.first)
    stated = tiff.number(first, ORIENTATION)
    xmp = first.entries.get(XMP_TAG)
    colour = None
    if ICC_TAG not in first.entries:
        colour = read_exif_colour(file) or _read_tiff_colour(tiff, first)
    return Headers(xmp=tiff.tag(xmp).data if xmp else None, stated=stated if 1 <= stated <= 8 else None, colour=colour)


def _read_tiff_colour(tiff: TiffFile, first: Directory) -> Colour | None:
    """Find the space by WhitePoint and PrimaryChromaticities, if a TIFF states them."""
    white, primaries = (tiff.rationals(first.entries.get(code)) for code in (_WHITE_POINT, _CHROMATICITIES))
    if len(white) != 2 or len(primaries) != 6:
        return None
    return colour_from_chromaticities([*primaries, *white], None)


def _of_bmp(file: BinaryIO) -> Headers:
    """Read the profile that the fifth version of BMP may hold."""
    file.seek(0)
    head = file.read(138)
    if len(head) < 138 or head[70:74] != b"DEBM":  # "MBED", embedded
        return Headers()
    offset, size = struct.unpack_from("<II", head, 126)
    file.seek(14 + offset)
    profile = file.read(min(size, _MOST_BYTES))
    return Headers(colour=Colour(profile) if profile else None)


# -- boxes of HEIF and JPEG XL -----------------------------------------------------------------------------------------


def _of_heif(file: BinaryIO) -> Headers:
    """Read the colour of the primary item, whose profile counts before its code points; the decoder gives EXIF."""
    meta = inner_boxes(file, MediaBox(b"", 0, file.seek(0, 2))).get(b"meta")
    if meta is None:
        return Headers()
    in_meta = inner_boxes(file, meta._replace(start=meta.start + 4))
    properties = inner_boxes(file, in_meta[b"iprp"]) if b"iprp" in in_meta else {}
    if b"ipco" not in properties:
        return Headers()

    all_properties = list(boxes(file, properties[b"ipco"].start, properties[b"ipco"].end))
    indices = list(range(len(all_properties)))
    if b"pitm" in in_meta and b"ipma" in properties:
        indices = read_properties(file, properties[b"ipma"], primary_item(file, in_meta[b"pitm"])) or indices

    code_points = None
    for index in indices:
        box = all_properties[index] if index < len(all_properties) else None
        if box is None or box.name != b"colr":
            continue
        file.seek(box.start)
        data = file.read(8)
        if data.startswith((b"prof", b"rICC")):
            return Headers()
        if data.startswith(b"nclx") and code_points is None:
            code_points = struct.unpack(">HH", data[4:])

    if code_points is None:
        return Headers()
    try:
        return Headers(colour=colour_from_code_points(*code_points))
    except ValueError as error:
        return Headers(unread=str(error))


def _of_jpeg_xl(file: BinaryIO) -> Headers:
    """Read EXIF and XMP of a file of boxes, and whether the codestream is an animation or CMYK."""
    file.seek(0)
    codestream = file.read(MOST_OF_CODESTREAM)
    exif, xmp = None, None
    if not codestream.startswith(CODESTREAM):
        codestream = b""
        for box in boxes(file, 0, file.seek(0, 2)):
            file.seek(box.start)
            size = min(box.end - box.start, _MOST_BYTES)
            if box.name == b"Exif":
                exif = file.read(size)[4:]
            elif box.name == b"xml ":
                xmp = file.read(size)
            elif box.name in (b"jxlc", b"jxlp") and not codestream:
                codestream = file.read(MOST_OF_CODESTREAM)[4 if box.name == b"jxlp" else 0 :]

    animated, has_black = read_codestream(codestream)
    return Headers(exif, xmp, animated=animated, unread="is CMYK in JPEG XL" if has_black else "")


_READERS = {
    "JPEG": _of_jpeg,
    "PNG": _of_png,
    "WebP": _of_webp,
    "TIFF": _of_tiff,
    "BMP": _of_bmp,
    "HEIC": _of_heif,
    "AVIF": _of_heif,
    "JPEG XL": _of_jpeg_xl,
}
