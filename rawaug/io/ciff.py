"""CRW files, Canon's RAW of 1998 to 2004: the camera's record of the exposure, which LibRaw does not give.

A CRW is a heap of records in heaps. A heap ends with the place of its directory, whose entries of ten bytes are a tag,
a size and a place. ShotInfo (tag 0x102a) has the exposure in steps of 1/32, with thirds rounded: the f-number is ``2^(v
/ 2)``, and the exposure time is ``2^-v``. Source: P. Harvey, "The Canon RAW (CRW) File Format".
"""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import BinaryIO

_SIGNATURE = b"HEAPCCDR"
_SHOT_INFO = 0x102A
_HEAPS = (0x300A, 0x300B)
"""These are the heap of the picture's properties, and the heap of the exposure in it."""
_F_NUMBER, _SECONDS = 21, 22
_MOST_ENTRIES, _DEEPEST = 1000, 4


def read_crw_exposure(path: Path) -> tuple[float | None, float | None]:
    """Read seconds and f-number of the exposure in a CRW file; None for those that the file does not state.

    A file of another kind states neither.
    """
    with path.open("rb") as file:
        header = file.read(14)
        if header[6:] != _SIGNATURE or header[:2] not in (b"II", b"MM"):
            return None, None

        order = "<" if header[:2] == b"II" else ">"
        (start,) = struct.unpack_from(order + "I", header, 2)
        try:
            values = _find_shot_info(file, order, start, path.stat().st_size, 0)
        except struct.error:  # a damaged heap; only the mosaic matters
            return None, None

    if values is None or len(values) <= _SECONDS:
        return None, None

    seconds, f_number = None, None
    if values[_SECONDS]:
        seconds = 2.0 ** -_stops(values[_SECONDS])
    if values[_F_NUMBER]:
        f_number = 2.0 ** (_stops(values[_F_NUMBER]) / 2)
    return seconds, f_number


def _find_shot_info(file: BinaryIO, order: str, start: int, end: int, depth: int) -> tuple[int, ...] | None:
    """Find the numbers of ShotInfo in the heap from ``start`` to ``end``; return None if it is not there."""
    file.seek(max(0, end - 4))
    (directory,) = struct.unpack(order + "I", file.read(4))
    file.seek(start + directory)
    (count,) = struct.unpack(order + "H", file.read(2))
    entries = file.read(10 * min(count, _MOST_ENTRIES))

    for tag, size, offset in struct.iter_unpack(order + "HII", entries):
        if tag == _SHOT_INFO:
            file.seek(start + offset)
            data = file.read(min(size, 2 * _MOST_ENTRIES))
            return struct.unpack(f"{order}{len(data) // 2}h", data[: len(data) // 2 * 2])
        if tag in _HEAPS and depth < _DEEPEST:
            values = _find_shot_info(file, order, start + offset, start + offset + size, depth + 1)
            if values is not None:
                return values
    return None


def _stops(value: int) -> float:
    """Convert Canon's steps of 1/32 to stops; 12 and 20 stand for thirds."""
    stops, part = divmod(abs(value), 32)
    part_of_stop = {12: 32 / 3, 20: 64 / 3}.get(part, float(part)) / 32
    return math.copysign(stops + part_of_stop, value)
