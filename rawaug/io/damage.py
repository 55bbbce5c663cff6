"""A check that the mosaic of a DNG is whole, for damage that its decoder does not notice.

A hole in the middle of a file (a download that stopped, a failing card) decodes to numbers of some kind. Two things
reveal it. The first is the MD5 of the mosaic, as Adobe's programs and this project write it (tags RawImageDigest and
NewRawImageDigest). The second is lossless JPEG itself: its code words have many lengths, so the data of a damaged
stream end before its pixels do, or after them. To check this, the last bytes of a stream are changed, others are
appended, and it is decoded again: in a sound stream the last samples change, and no others do.

Source: DNG specification 1.4, chapter 4; ITU-T T.81, annex H.
"""

from __future__ import annotations

from hashlib import md5
from pathlib import Path

import numpy as np

from rawaug.errors import extra
from rawaug.io.tiff import LOSSLESS_JPEG, StoredMosaic

_TILE = 256
"""The tiles of NewRawImageDigest have this side."""
_END = b"\xff\xd9"
"""This marker ends a JPEG stream."""
_CHANGED_BYTES = (2, 16)
"""This many bytes are changed at the end of the data, the larger number if the last two are padding."""
_MORE = b"\x5a\x33" * 32
"""This is appended to the data, for a decoder that reads on."""


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
            if md5(_bytes(numbers), usedforsecurity=False).digest() != stored.digest:
                return "its pixels do not match RawImageDigest"
            return ""

    if stored.compression == LOSSLESS_JPEG:
        return _find_fault_in_streams(path, stored)
    return ""


def tiled_digest(numbers: np.ndarray) -> bytes:
    """Compute NewRawImageDigest of digital numbers ``(H, W)``, the MD5 of the MD5s of tiles of 256 x 256."""
    height, width = numbers.shape
    digests = md5(usedforsecurity=False)
    for top in range(0, height, _TILE):
        for left in range(0, width, _TILE):
            tile = numbers[top : top + _TILE, left : left + _TILE]
            digests.update(md5(_bytes(tile), usedforsecurity=False).digest())
    return digests.digest()


def _bytes(numbers: np.ndarray) -> bytes:
    return np.ascontiguousarray(numbers, "<u2").tobytes()


def _find_fault_in_streams(path: Path, stored: StoredMosaic) -> str:
    samples = 0
    count = len(stored.segments)
    with path.open("rb") as file:
        for number, (offset, length) in enumerate(stored.segments, 1):
            file.seek(offset)
            stream = file.read(length)

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
            most = 8 * (count + 1) // shortest_code_word
            return decoded.size - first <= most
    return False


def _first_change(stream: bytes, end: int, count: int, decoded: np.ndarray) -> int | None:
    """Find the first sample that changes with the last ``count`` bytes before ``end``; return None if none does."""
    with extra("raw"):
        import imagecodecs

    start = max(1, end - count)
    if stream[start - 1] == 0xFF:  # what follows must not become a marker
        start -= 1

    others = bytearray()
    for byte in stream[start:end]:
        others.append(0x33 if byte == 0x5A else 0x5A)

    try:
        again = imagecodecs.jpeg8_decode(stream[:start] + bytes(others) + _MORE + _END)
    except Exception:  # a kind of stream that only the other decoder takes
        return decoded.size

    changes = np.flatnonzero(again.ravel() != decoded.ravel())
    if not changes.size:
        return None
    return int(changes[0])
