"""The directories of a TIFF file, followed once before anything else follows them.

A directory (IFD) names its successor and its children (SubIFDs, tag 330) by their offset. Damaged offsets make circles,
in which a reader that trusts them never ends. Source: TIFF 6.0, section 2; BigTIFF; TIFF Technical Note 1 (SubIFDs).
"""

from __future__ import annotations

import struct
from graphlib import CycleError, TopologicalSorter
from os import SEEK_END
from pathlib import Path
from typing import BinaryIO, NamedTuple

MOST_DIRECTORIES = 512
_SUB_DIRECTORIES = 330
_OFFSETS = {4: "I", 13: "I", 16: "Q", 18: "Q"}
"""TIFF types that hold offsets (LONG, IFD, LONG8, IFD8), as struct names them."""


class _Layout(NamedTuple):
    """Formats of struct: of an offset, of the number of entries, of an entry up to its value."""

    offset: str
    number: str
    entry: str


_LAYOUTS = {42: _Layout("I", "H", "HHI"), 43: _Layout("Q", "Q", "HHQ")}
"""By the number after the byte order: TIFF and BigTIFF."""


def require_no_circle(path: Path) -> None:
    """Refuse a TIFF in which a directory leads back to itself; other files are left to whoever reads them.

    A directory that two others name is none: some writers chain the children that a parent lists as well.

    Raises:
        ValueError: naming the directory's offset, or if there are more than :data:`MOST_DIRECTORIES`.
    """
    with path.open("rb") as file:
        start = file.read(4)
        order = {b"II": "<", b"MM": ">"}.get(start[:2])
        if order is None or len(start) < 4:
            return
        layout = _LAYOUTS.get(struct.unpack(order + "H", start[2:])[0])
        if layout is None:
            return
        end = file.seek(0, SEEK_END)
        todo = [_number(file, order + layout.offset, 8 if layout.offset == "Q" else 4)]
        named: dict[int, list[int]] = {}
        while todo:
            place = todo.pop()
            if place in named or not 0 < place < end:
                continue
            if len(named) == MOST_DIRECTORIES:
                raise ValueError(f"it has more than {MOST_DIRECTORIES} directories")
            named[place] = _followed(file, order, layout, place, end)
            todo += named[place]
    try:
        TopologicalSorter(named).prepare()
    except CycleError as error:
        place = error.args[1][0]
        raise ValueError(f"its directories point at one another in a circle, at byte {place}") from None


def _followed(file: BinaryIO, order: str, layout: _Layout, place: int, end: int) -> list[int]:
    """Offsets that a directory names: of its successor and of its children."""
    place += struct.calcsize(order + layout.number)
    count = _number(file, order + layout.number, place - struct.calcsize(order + layout.number))
    size, wide = struct.calcsize(order + layout.entry), struct.calcsize(order + layout.offset)
    if place + count * (size + wide) > end:
        return []  # what is cut off is left to whoever reads it
    file.seek(place)
    table = file.read(count * (size + wide))
    followed = [_number(file, order + layout.offset, place + count * (size + wide))]
    for at in range(0, len(table), size + wide):
        code, kind, values = struct.unpack_from(order + layout.entry, table, at)
        if code == _SUB_DIRECTORIES and kind in _OFFSETS:
            each = struct.calcsize(order + _OFFSETS[kind])
            inside = values * each <= wide
            where = place + at + size if inside else struct.unpack_from(order + layout.offset, table, at + size)[0]
            values = min(values, MOST_DIRECTORIES + 1)
            followed += [_number(file, order + _OFFSETS[kind], where + k * each) for k in range(values)]
    return followed


def _number(file: BinaryIO, form: str, place: int) -> int:
    """The number at ``place``; 0 behind the end of the file."""
    file.seek(place)
    data = file.read(struct.calcsize(form))
    return int(struct.unpack(form, data)[0]) if len(data) == struct.calcsize(form) else 0
