r"""Lens shading in DNG: the GainMap opcodes of its OpcodeList2 and OpcodeList3.

    corrected(i, j) = gain((i + 1/2) / H, (j + 1/2) / W) y(i, j)

where ``gain`` interpolates a coarse grid bilinearly and holds its border values outside. Several maps multiply. A map
of OpcodeList2 is made for the mosaic and selects one site of the cell by its pitch of 2; a map of OpcodeList3 is made
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
from rawaug.io.opcodes import GAIN_MAP, Opcode, pack_opcodes, unpack_opcodes

_GRID = struct.Struct(">10I4dI")
_DNG_1_3 = 0x01030000
_MAY_BE_SKIPPED = 1


@dataclass(frozen=True)
class GainMap:
    """One map of factors that correct the shading.

    Attributes:
        area: top, left, bottom, right in pixels of the visible frame.
        pitch: step in rows and columns within ``area``.
        planes: the first colour plane, and the number of planes.
        origin, spacing: origin and spacing of the grid, (vertical, horizontal), in parts of the frame's height and
            width.
        gains: float32 ``(P, V, H)``; further planes than P take the last one.
        on_mosaic: whether the map is of OpcodeList2, whose only plane is the mosaic; otherwise it is of OpcodeList3,
            whose planes are R, G, B.
    """

    area: tuple[int, int, int, int]
    pitch: tuple[int, int]
    planes: tuple[int, int]
    origin: tuple[float, float]
    spacing: tuple[float, float]
    gains: Tensor
    on_mosaic: bool = True


def parse_gain_maps(opcodes: bytes, on_mosaic: bool) -> tuple[GainMap, ...]:
    """Parse the gain maps of an opcode list; its other opcodes are skipped.

    Raises:
        ValueError: if the list is truncated, or a map is incomplete or has spacings or gains that are not positive.
    """
    maps = []
    for opcode in unpack_opcodes(opcodes):
        if opcode.code == GAIN_MAP:
            maps.append(_parse(opcode.body, on_mosaic))
    return tuple(maps)


def _parse(body: bytes, on_mosaic: bool) -> GainMap:
    if len(body) < _GRID.size:
        raise ValueError("the opcode list is truncated (a gain map)")
    top, left, bottom, right, plane, planes, *grid = _GRID.unpack_from(body)
    rows, columns, points_v, points_h, spacing_v, spacing_h, origin_v, origin_h, map_planes = grid
    size = points_v * points_h * map_planes
    if size == 0 or min(rows, columns) == 0 or len(body) < _GRID.size + 4 * size:
        raise ValueError(f"a gain map of {points_v} x {points_h} points and pitch {rows} x {columns} is incomplete")

    gains = np.frombuffer(body, ">f4", size, _GRID.size).reshape(points_v, points_h, map_planes)
    is_spaced = (spacing_v > 0 or points_v == 1) and (spacing_h > 0 or points_h == 1)
    is_finite = np.isfinite([spacing_v, spacing_h, origin_v, origin_h]).all() and np.isfinite(gains).all()
    if not (is_spaced and is_finite and gains.min() > 0):
        spacing = f"{spacing_v:g} x {spacing_h:g}"
        raise ValueError(f"a gain map of spacing {spacing} and least gain {gains.min():g} is invalid")

    return GainMap(
        area=(top, left, bottom, right),
        pitch=(rows, columns),
        planes=(plane, planes),
        spacing=(spacing_v, spacing_h),
        origin=(origin_v, origin_h),
        gains=torch.from_numpy(gains.astype(np.float32)).permute(2, 0, 1).contiguous(),
        on_mosaic=on_mosaic,
    )


def opcode_list(maps: Iterable[GainMap]) -> bytes:
    """Pack the maps for one list; this is the inverse of :func:`parse_gain_maps`."""
    opcodes = []
    for gain_map in maps:
        planes, points_v, points_h = gain_map.gains.shape
        grid = (*gain_map.pitch, points_v, points_h, *gain_map.spacing, *gain_map.origin, planes)
        gains = gain_map.gains.permute(1, 2, 0).numpy().astype(">f4")
        body = _GRID.pack(*gain_map.area, *gain_map.planes, *grid) + gains.tobytes()
        opcodes.append(Opcode(GAIN_MAP, _DNG_1_3, _MAY_BE_SKIPPED, body))
    return pack_opcodes(opcodes)


def of_planes(gain_map: GainMap, cfa: CFA | str) -> list[GainMap]:
    """Turn a map of a mosaic's sites into maps of the planes R, G, B of the demosaiced picture."""
    if gain_map.pitch != (2, 2):
        return [replace(gain_map, planes=(0, 3))]

    top, left, bottom, right = gain_map.area
    colour = CFA(cfa).channels[top % 2][left % 2]
    gains = gain_map.gains
    if colour == 1:  # both greens have a map, and the plane is multiplied by both
        gains = gains.sqrt()
    return [replace(gain_map, area=(0, 0, bottom, right), pitch=(1, 1), planes=(colour, 1), gains=gains)]
