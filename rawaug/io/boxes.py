"""The boxes of HEIF and JPEG XL: a size, a name of four letters and contents, which may be boxes again.

Source: ISO/IEC 14496-12 (boxes), 23008-12 (the items of HEIF and their properties).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

_MOST_BOXES = 2**20
_MOST_BYTES = 2**26


class MediaBox(NamedTuple):
    """A box, with its name and the places where its contents begin and end."""

    name: bytes
    start: int
    end: int


def boxes(file: BinaryIO, start: int, end: int) -> Iterator[MediaBox]:
    """Yield the boxes between two places of a file."""
    offset = start
    for _ in range(_MOST_BOXES):
        file.seek(offset)
        head = file.read(16)
        if offset + 8 > end or len(head) < 8:
            return
        size, name = struct.unpack(">I4s", head[:8])
        inside = offset + 8
        if size == 1 and len(head) == 16:
            (size,) = struct.unpack(">Q", head[8:])
            inside = offset + 16
        beyond = offset + size if size else end
        if beyond < inside or beyond > end:
            return
        yield MediaBox(name, inside, beyond)
        offset = beyond


def inner_boxes(file: BinaryIO, outer: MediaBox) -> dict[bytes, MediaBox]:
    """Find the first box of each name within a box."""
    inner: dict[bytes, MediaBox] = {}
    for box in boxes(file, outer.start, outer.end):
        inner.setdefault(box.name, box)
    return inner


def primary_item(file: BinaryIO, box: MediaBox) -> int:
    """Read the number of the item that is the picture."""
    file.seek(box.start)
    data = file.read(min(8, box.end - box.start))
    return int.from_bytes(data[4:8] if data[0] else data[4:6], "big")


def read_properties(file: BinaryIO, box: MediaBox, item: int) -> list[int]:
    """Read the places of an item's properties in their list, the first being 0."""
    file.seek(box.start)
    data = file.read(min(box.end - box.start, _MOST_BYTES))
    wide_items, wide_indices = data[0] > 0, data[3] & 1
    (count,) = struct.unpack_from(">I", data, 4)
    offset = 8
    indices = []
    for _ in range(count):
        (number,) = struct.unpack_from(">I" if wide_items else ">H", data, offset)
        offset += 4 if wide_items else 2
        associations = data[offset]
        offset += 1
        for _ in range(associations):
            index = data[offset] & 0x7F
            if wide_indices:
                index = struct.unpack_from(">H", data, offset)[0] & 0x7FFF
            offset += 1 + wide_indices
            if number == item and index:
                indices.append(index - 1)
    return indices
