"""A check that the mosaic of a DNG is whole, for damage that its decoder does not notice.

A hole in the middle of a file (a download that stopped, a failing card) decodes to numbers of some kind. Two things
reveal it. The first is the MD5 of the mosaic, as Adobe's programs and this project write it (tags RawImageDigest and
NewRawImageDigest). The second is lossless JPEG itself: its code words have many lengths, so the data of a damaged
stream end before its pixels do, or after them. To check this, the last bytes of a stream are changed, others are
appended, and it is decoded again: in a sound stream the last samples change, and no others do.

DNG's compression 7 is JPEG of any process. Cinema cameras write the lossy one (DCT of 12 bits), to which the second
check does not apply; such a stream must have its end.

A RAW file of which only the header is there decodes to zeros in some formats. Its table of strips says how long it
should be, and rows of one number below black are no picture.

Source: DNG specification 1.4, chapter 4; ITU-T T.81, annexes B and H.
"""

from __future__ import annotations

from hashlib import md5
from io import BytesIO
from pathlib import Path

import numpy as np

from rawaug.errors import extra
from rawaug.io.directories import STRIP_BYTES, TILE_BYTES, DamagedTags, TiffFile
from rawaug.io.headers import jpeg_segments
from rawaug.io.tiff import JPEG, StoredMosaic

_TILE = 256
"""The tiles of NewRawImageDigest have this side."""
_END = b"\xff\xd9"
"""This marker ends a JPEG stream."""
_CHANGED_BYTES = (2, 16)
"""This many bytes are changed at the end of the data, the larger number if the last two are padding."""
_MORE = b"\x5a\x33" * 32
"""This is appended to the data, for a decoder that reads on."""
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""These markers start a frame of JPEG; the others of the range are tables."""
_LOSSLESS_FRAME = 0xC3
_LEAST_SHARE = 0.5
"""A file holds at least this share of its strips; Panasonic's tables state 7/4 of the bytes that are there."""
_VERSIONS = (42, 43, 0x55, 0x4F52, 0x5352)
"""These are the second numbers of TIFF, of BigTIFF, of RW2 and of two kinds of ORF."""
_EMPTY_ROWS = 16
"""This many rows of one number below black, at the end of a mosaic, were never decoded."""


def find_fault(path: Path, stored: StoredMosaic, numbers: np.ndarray | None) -> str:
    """Say what is wrong with the mosaic of a DNG; the text is empty if nothing is.

    Args:
        path: the file.
        stored: how the file stores the mosaic.
        numbers: all digital numbers ``(H, W)`` as decoded, margins included; None if they are not available.
    """
    if numbers is not None and stored.plain and numbers.shape == stored.size:
        if stored.tiled_digest is not None:
            if tiled_digest(numbers) != stored.tiled_digest:
                return "its pixels do not match NewRawImageDigest"
            return ""
        if stored.digest is not None:
            if md5(np.ascontiguousarray(numbers, "<u2").tobytes(), usedforsecurity=False).digest() != stored.digest:
                return "its pixels do not match RawImageDigest"
            return ""

    if stored.compression == JPEG:
        return _find_fault_in_streams(path, stored)
    return ""


def stated_bytes(path: Path) -> int:
    """Read how many bytes the largest picture of a file based on TIFF has; 0 if it is another kind of file."""
    largest = 0
    with path.open("rb") as file:
        try:
            tiff = TiffFile(file)
            if tiff.version not in _VERSIONS:
                return 0
            for directory in tiff.directories():
                for code in (STRIP_BYTES, TILE_BYTES):
                    largest = max(largest, sum(tiff.numbers(directory.entries.get(code))))
        except DamagedTags:  # Fuji, Canon's older files and others have no such tables
            pass
    return largest


def is_cut_short(path: Path) -> bool:
    """Tell whether a file is much shorter than its largest picture."""
    return path.stat().st_size < _LEAST_SHARE * stated_bytes(path)


def count_empty_rows(numbers: np.ndarray, black: float) -> int:
    """Count the rows ``(H, W)`` at the end that hold one number below black; 0 if they are few."""
    last = numbers[-1, -1]
    if last >= black:
        return 0

    filled = np.flatnonzero((numbers != last).any(axis=1))
    rows = len(numbers)
    if filled.size:
        rows -= 1 + int(filled[-1])
    if rows < _EMPTY_ROWS:
        return 0
    return rows


def tiled_digest(numbers: np.ndarray) -> bytes:
    """Compute NewRawImageDigest of digital numbers ``(H, W)``, the MD5 of the MD5s of tiles of 256 x 256."""
    height, width = numbers.shape
    digests = md5(usedforsecurity=False)
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            tile = numbers[top : top + _TILE, left : left + _TILE]
            digests.update(md5(np.ascontiguousarray(tile, "<u2").tobytes(), usedforsecurity=False).digest())
    return digests.digest()


def _find_fault_in_streams(path: Path, stored: StoredMosaic) -> str:
    samples = 0
    count = len(stored.segments)
    with path.open("rb") as file:
        for number, (offset, length) in enumerate(stored.segments, 1):
            file.seek(offset)
            stream = file.read(length)

            height, width, components, is_lossless = _frame(stream)
            if not is_lossless:
                if _END not in stream:
                    return f"part {number} of {count} has no end"
                samples += height * width * components
                continue

            decoded = _decode(stream)
            if decoded is None:
                return f"part {number} of {count} cannot be decoded"
            if not _ends_with_its_data(stream, decoded):
                return f"the data of part {number} of {count} do not end with its pixels"
            samples += decoded.size

    height, width = stored.size
    if samples < height * width:
        return f"holds {samples} of {height * width} sites"
    return ""


def _frame(stream: bytes) -> tuple[int, int, int, bool]:
    """Read height, width and components of a JPEG, and whether it is lossless; one without a frame counts as such."""
    for segment in jpeg_segments(BytesIO(stream)):
        if segment.marker in _FRAMES and len(segment.data) >= 6:
            height, width = int.from_bytes(segment.data[1:3], "big"), int.from_bytes(segment.data[3:5], "big")
            return height, width, segment.data[5], segment.marker == _LOSSLESS_FRAME
    return 0, 0, 0, True


def _decode(stream: bytes) -> np.ndarray | None:
    """Decode the samples of a lossless JPEG; return None if no decoder takes it."""
    with extra("raw"):
        import imagecodecs

    for decode in (imagecodecs.jpeg8_decode, imagecodecs.ljpeg_decode):
        try:
            return np.asarray(decode(stream))
        except Exception:  # each codec has an error of its own
            continue
    return None


def _ends_with_its_data(stream: bytes, decoded: np.ndarray) -> bool:
    end = stream.rfind(_END)
    if end < 0:
        end = len(stream)

    for count in _CHANGED_BYTES:
        first = _first_change(stream, end, count, decoded)
        if first is not None:
            shortest_code_word = 1  # bit
            largest = 8 * (count + 1) // shortest_code_word
            return decoded.size - first <= largest
    return False


def _first_change(stream: bytes, end: int, count: int, decoded: np.ndarray) -> int | None:
    """Find the first sample that changes with the last ``count`` bytes before ``end``; return None if none does."""
    with extra("raw"):
        import imagecodecs

    start = max(1, end - count)
    if stream[start - 1] == 0xFF:  # what follows must not become a marker
        start -= 1

    changed = bytearray()
    for byte in stream[start:end]:
        changed.append(0x33 if byte == 0x5A else 0x5A)

    try:
        again = imagecodecs.jpeg8_decode(stream[:start] + bytes(changed) + _MORE + _END)
    except Exception:  # a kind of stream that only the other decoder takes
        return decoded.size

    changes = np.flatnonzero(again.ravel() != decoded.ravel())
    if not changes.size:
        return None
    return int(changes[0])
