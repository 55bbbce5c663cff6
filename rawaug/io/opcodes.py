r"""Opcode lists of DNG: the corrections that RAW developers apply, moved with a mosaic whose margins are cut.

    row' = row - rows,    column' = column - columns

for a picture that begins ``(rows, columns)`` later. OpcodeList1 counts from the first stored site, OpcodeList2 and
OpcodeList3 count from the active area. What addresses lines and sites is moved by whole sites, so that maps of one site
of the cell stay with their colour; what is stated in parts of the height and width is stated in parts of the new ones.
Opcodes of sites that were cut are left out. Source: DNG specification 1.6, chapter 7; opcode lists are big-endian in
every file.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

OPCODE_LIST_1, OPCODE_LIST_2, OPCODE_LIST_3 = 51008, 51009, 51022
OPCODE_LISTS = (OPCODE_LIST_1, OPCODE_LIST_2, OPCODE_LIST_3)

GAIN_MAP = 9
_HEAD = struct.Struct(">4I")  # id, version, flags, bytes that follow
_AREA = struct.Struct(">8I")  # top, left, bottom, right, plane, planes, pitch of rows and of columns
_GRID = struct.Struct(">2I4dI")  # points, spacing, origin, planes
_RECTANGLE = struct.Struct(">4I")

Extent = tuple[int, int]
"""A number of rows and of columns."""


class Opcode(NamedTuple):
    """One correction: its number, the version of DNG that it needs, its flags, and its parameters."""

    code: int
    version: int
    flags: int
    body: bytes


def unpack_opcodes(opcodes: bytes) -> Iterator[Opcode]:
    """Yield the opcodes of a list; raise ValueError if it is truncated."""
    try:
        (count,) = struct.unpack_from(">I", opcodes)
        offset = 4
        for _ in range(count):
            code, version, flags, size = _HEAD.unpack_from(opcodes, offset)
            offset += _HEAD.size
            yield Opcode(code, version, flags, opcodes[offset : offset + size])
            offset += size
    except struct.error as error:
        raise ValueError(f"the opcode list is truncated ({error})") from None


def pack_opcodes(opcodes: Iterable[Opcode]) -> bytes:
    """Pack a list; this is the inverse of :func:`unpack_opcodes`."""
    packed = []
    for opcode in opcodes:
        packed.append(_HEAD.pack(opcode.code, opcode.version, opcode.flags, len(opcode.body)) + opcode.body)
    return struct.pack(">I", len(packed)) + b"".join(packed)


def move_opcodes(opcodes: bytes, shift: Extent, size: Extent, new_size: Extent) -> tuple[bytes, list[str]]:
    """Move the opcodes of a list to a picture that is a part of the one that they were made for.

    Args:
        opcodes: the list.
        shift: rows and columns that are cut above and to the left.
        size: height and width of the picture that the list addresses.
        new_size: height and width of the part.

    Returns:
        the list of the part, which is empty if no opcode is left, and a clause for each opcode that cannot be moved and
        is left out.
    """
    if shift == (0, 0) and size == new_size:
        return opcodes, []

    moved: list[Opcode] = []
    left_out = []
    try:
        for opcode in unpack_opcodes(opcodes):
            move = _MOVES.get(opcode.code)
            if move is None:
                left_out.append(f"opcode {opcode.code}, which cannot be moved")
                continue
            try:
                body = move(opcode.body, shift, size, new_size)
            except (struct.error, ValueError, ArithmeticError):
                left_out.append(f"opcode {opcode.code}, which is damaged")
                continue
            if body is not None:
                moved.append(opcode._replace(body=body))
    except ValueError as error:
        left_out.append(str(error))

    if not moved:
        return b"", left_out
    return pack_opcodes(moved), left_out


# -- what addresses rows and columns -----------------------------------------------------------------------------------


def _move_start(start: int, shift: int, pitch: int) -> Extent:
    """Find where lines of a pitch begin in the part, and how many of them were cut."""
    start -= shift
    cut = max(0, math.ceil(-start / pitch))
    return start + cut * pitch, cut


def _move_lines(body: bytes, shift: Extent, new_size: Extent) -> tuple[bytes, Extent, Extent] | None:
    """Move an area; return it, its rows and columns that were cut, and those that are left; None if none are."""
    top, left, bottom, right, plane, planes, row_pitch, column_pitch = _AREA.unpack_from(body)
    top, cut_rows = _move_start(top, shift[0], row_pitch)
    left, cut_columns = _move_start(left, shift[1], column_pitch)
    bottom = min(bottom - shift[0], new_size[0])
    right = min(right - shift[1], new_size[1])
    if bottom <= top or right <= left:
        return None

    area = _AREA.pack(top, left, bottom, right, plane, planes, row_pitch, column_pitch)
    rows = math.ceil((bottom - top) / row_pitch)
    columns = math.ceil((right - left) / column_pitch)
    return area, (cut_rows, cut_columns), (rows, columns)


def _move_area(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes | None:
    """Move MapTable and MapPolynomial."""
    lines = _move_lines(body, shift, new_size)
    if lines is None:
        return None
    return lines[0] + body[_AREA.size :]


def _move_gain_map(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes | None:
    lines = _move_lines(body, shift, new_size)
    if lines is None:
        return None

    points_v, points_h, *grid, planes = _GRID.unpack_from(body, _AREA.size)
    spacing_v, spacing_h, origin_v, origin_h = grid
    taller, wider = size[0] / new_size[0], size[1] / new_size[1]
    spacing = (spacing_v * taller, spacing_h * wider)
    origin = (origin_v * taller - shift[0] / new_size[0], origin_h * wider - shift[1] / new_size[1])
    return lines[0] + _GRID.pack(points_v, points_h, *spacing, *origin, planes) + body[_AREA.size + _GRID.size :]


def _move_numbers(of_columns: bool) -> Callable[[bytes, Extent, Extent, Extent], bytes | None]:
    """Make the function that moves an area with a number for each of its rows or columns."""

    def move(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes | None:
        lines = _move_lines(body, shift, new_size)
        if lines is None:
            return None

        area, cut, kept = lines
        (count,) = struct.unpack_from(">I", body, _AREA.size)
        numbers = struct.unpack_from(f">{count}f", body, _AREA.size + 4)
        numbers = numbers[cut[of_columns] : cut[of_columns] + kept[of_columns]]
        if len(numbers) != kept[of_columns]:
            raise ValueError(f"{count} numbers")
        return area + struct.pack(f">I{len(numbers)}f", len(numbers), *numbers)

    return move


def _move_rectangle(
    rectangle: tuple[int, int, int, int], shift: Extent, new_size: Extent
) -> tuple[int, int, int, int] | None:
    top, left = max(0, rectangle[0] - shift[0]), max(0, rectangle[1] - shift[1])
    bottom, right = min(rectangle[2] - shift[0], new_size[0]), min(rectangle[3] - shift[1], new_size[1])
    if bottom <= top or right <= left:
        return None
    return top, left, bottom, right


def _move_bounds(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes | None:
    rectangle = _move_rectangle(_RECTANGLE.unpack_from(body), shift, new_size)
    if rectangle is None:
        return None
    return _RECTANGLE.pack(*rectangle)


def _move_phase(phase: int, shift: Extent) -> int:
    """Find Bayer's phase, whose bits are the row and the column of red."""
    return phase ^ ((shift[0] % 2) << 1 | shift[1] % 2)


def _move_constant(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes:
    """Move FixBadPixelsConstant, which names a number and the phase."""
    constant, phase = struct.unpack_from(">2I", body)
    return struct.pack(">2I", constant, _move_phase(phase, shift))


def _move_bad_sites(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes | None:
    """Move FixBadPixelsList: sites and rectangles."""
    phase, sites, rectangles = struct.unpack_from(">3I", body)
    numbers = struct.unpack_from(f">{2 * sites + 4 * rectangles}I", body, 12)

    moved_sites: list[int] = []
    for k in range(0, 2 * sites, 2):
        row, column = numbers[k] - shift[0], numbers[k + 1] - shift[1]
        if 0 <= row < new_size[0] and 0 <= column < new_size[1]:
            moved_sites += (row, column)

    moved_rectangles: list[int] = []
    for k in range(2 * sites, len(numbers), 4):
        top, left, bottom, right = numbers[k : k + 4]
        rectangle = _move_rectangle((top, left, bottom, right), shift, new_size)
        if rectangle is not None:
            moved_rectangles += rectangle

    moved = moved_sites + moved_rectangles
    if not moved:
        return None
    head = struct.pack(">3I", _move_phase(phase, shift), len(moved_sites) // 2, len(moved_rectangles) // 4)
    return head + struct.pack(f">{len(moved)}I", *moved)


# -- what is stated in parts of the picture ----------------------------------------------------------------------------


def _radius(size: Extent, centre: tuple[float, float]) -> float:
    """Compute the distance in sites from the centre to the corner that is furthest away."""
    across, down = centre
    width, height = max(across, 1 - across) * size[1], max(down, 1 - down) * size[0]
    return math.hypot(width, height)


def _move_centre(centre: tuple[float, float], shift: Extent, size: Extent, new_size: Extent) -> tuple[float, float]:
    return (centre[0] * size[1] - shift[1]) / new_size[1], (centre[1] * size[0] - shift[0]) / new_size[0]


def _move_warp(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes:
    """Move WarpRectilinear: four radial and two tangential numbers for each plane, in parts of the radius."""
    (planes,) = struct.unpack_from(">I", body)
    numbers = struct.unpack_from(f">{6 * planes + 2}d", body, 4)
    centre = (numbers[-2], numbers[-1])
    moved_centre = _move_centre(centre, shift, size, new_size)
    scale = _radius(new_size, moved_centre) / _radius(size, centre)

    moved: list[float] = []
    for k in range(0, 6 * planes, 6):
        for power, number in zip((0, 2, 4, 6, 1, 1), numbers[k : k + 6], strict=True):
            moved.append(number * scale**power)
    return struct.pack(f">I{len(numbers)}d", planes, *moved, *moved_centre)


def _move_vignette(body: bytes, shift: Extent, size: Extent, new_size: Extent) -> bytes:
    """Move FixVignetteRadial: the numbers of r^2, r^4, ... r^10."""
    numbers = struct.unpack_from(">7d", body)
    centre = (numbers[-2], numbers[-1])
    moved_centre = _move_centre(centre, shift, size, new_size)
    scale = _radius(new_size, moved_centre) / _radius(size, centre)

    moved = [number * scale**power for power, number in zip((2, 4, 6, 8, 10), numbers[:5], strict=True)]
    return struct.pack(">7d", *moved, *moved_centre)


_MOVES: dict[int, Callable[[bytes, Extent, Extent, Extent], bytes | None]] = {
    1: _move_warp,
    3: _move_vignette,
    4: _move_constant,
    5: _move_bad_sites,
    6: _move_bounds,
    7: _move_area,
    8: _move_area,
    GAIN_MAP: _move_gain_map,
    10: _move_numbers(of_columns=False),
    11: _move_numbers(of_columns=True),
    12: _move_numbers(of_columns=False),
    13: _move_numbers(of_columns=True),
}
"""These opcodes can be moved, by their numbers. WarpFisheye, whose angles depend on the radius, cannot."""
