r"""Lens shading in DNG: the GainMap opcodes of its OpcodeList2 and OpcodeList3.

    corrected(i, j) = gain((i + 1/2) / H, (j + 1/2) / W) y(i, j)

where ``gain`` interpolates a coarse grid bilinearly and holds its border values outside. Several maps multiply. A map
of OpcodeList2 is made for the mosaic and reaches one site of the cell by its pitch of 2; a map of OpcodeList3 is made
for the demosaiced picture, whose planes are R, G, B. Source: DNG specification 1.4, chapter 7, "GainMap"; opcode lists
are big-endian in every file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA

_GAIN_MAP = 9
_OPCODE = struct.Struct(">4I")  # id, version, flags, bytes that follow
_GRID = struct.Struct(">10I4dI")
_DNG_1_3 = 0x01030000
_MAY_BE_SKIPPED = 1


@dataclass(frozen=True)
class GainMap:
    """One map of factors that correct the shading.

    Attributes:
        area: top, left, bottom, right in pixels of the visible frame.
        pitch: step in rows and columns within ``area``.
        planes: first colour plane, and how many.
        origin, spacing: of the grid, (vertical, horizontal), in parts of the frame's height and width.
        gains: float32 ``(P, V, H)``; further planes than P take the last one.
        on_mosaic: of OpcodeList2, whose only plane is the mosaic; else of OpcodeList3, planes R, G, B.
    """

    area: tuple[int, int, int, int]
    pitch: tuple[int, int]
    planes: tuple[int, int]
    origin: tuple[float, float]
    spacing: tuple[float, float]
    gains: Tensor
    on_mosaic: bool = True


def parse_gain_maps(opcodes: bytes, on_mosaic: bool) -> tuple[GainMap, ...]:
    """The gain maps of an opcode list; its other opcodes are skipped."""
    maps = []
    try:
        (count,), place = struct.unpack_from(">I", opcodes), 4
        for _ in range(count):
            code, _, _, size = _OPCODE.unpack_from(opcodes, place)
            place += _OPCODE.size
            if code == _GAIN_MAP:
                maps.append(_parse(opcodes[place : place + size], on_mosaic))
            place += size
    except struct.error as error:
        raise ValueError(f"the opcode list is truncated ({error})") from None
    return tuple(maps)


def _parse(body: bytes, on_mosaic: bool) -> GainMap:
    top, left, bottom, right, plane, planes, *rest = _GRID.unpack_from(body)
    rows, columns, points_v, points_h, *grid, map_planes = rest
    size = points_v * points_h * map_planes
    if size == 0 or min(rows, columns) == 0 or len(body) < _GRID.size + 4 * size:
        raise ValueError(f"a gain map of {points_v} x {points_h} points and pitch {rows} x {columns} is incomplete")
    gains = np.frombuffer(body, ">f4", size, _GRID.size).reshape(points_v, points_h, map_planes)
    spaced = all(spacing > 0 for spacing, points in zip(grid[:2], (points_v, points_h), strict=True) if points > 1)
    if not (spaced and np.isfinite(grid).all() and np.isfinite(gains).all() and gains.min() > 0):
        raise ValueError(f"a gain map of spacing {grid[0]:g} x {grid[1]:g} and least gain {gains.min():g} is invalid")
    return GainMap(
        area=(top, left, bottom, right),
        pitch=(rows, columns),
        planes=(plane, planes),
        spacing=(grid[0], grid[1]),
        origin=(grid[2], grid[3]),
        gains=torch.from_numpy(gains.astype(np.float32)).permute(2, 0, 1).contiguous(),
        on_mosaic=on_mosaic,
    )


def opcode_list(maps: Iterable[GainMap]) -> bytes:
    """The inverse of :func:`parse_gain_maps`, of maps for one list."""
    opcodes = []
    for m in maps:
        planes, points_v, points_h = m.gains.shape
        grid = (*m.pitch, points_v, points_h, *m.spacing, *m.origin, planes)
        body = _GRID.pack(*m.area, *m.planes, *grid) + m.gains.permute(1, 2, 0).numpy().astype(">f4").tobytes()
        opcodes.append(_OPCODE.pack(_GAIN_MAP, _DNG_1_3, _MAY_BE_SKIPPED, len(body)) + body)
    return struct.pack(">I", len(opcodes)) + b"".join(opcodes)


def of_planes(m: GainMap, cfa: CFA | str) -> list[GainMap]:
    """A map of a mosaic's sites as maps of the planes R, G, B of the demosaiced picture."""
    if m.pitch != (2, 2):
        return [replace(m, planes=(0, 3))]
    colour = CFA(cfa).channels[m.area[0] % 2][m.area[1] % 2]
    gains = m.gains.sqrt() if colour == 1 else m.gains  # both greens have a map, and the plane is multiplied by both
    return [replace(m, area=(0, 0, *m.area[2:]), pitch=(1, 1), planes=(colour, 1), gains=gains)]
