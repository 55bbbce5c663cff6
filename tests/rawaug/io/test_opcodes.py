"""Opcodes move with the mosaic: to correct and then to cut is to cut and then to correct."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
import torch

from rawaug.io import GainMap, read_raw, write_dng
from rawaug.io.gain_map import opcode_list, parse_gain_maps
from rawaug.io.opcodes import Opcode, move_opcodes, pack_opcodes, unpack_opcodes

Dng = Callable[..., Path]
SIZE = (20, 31)
SHIFTS = [(0, 0), (1, 0), (0, 1), (3, 5), (4, 6)]
UNDEFINED, LONG = 7, 4


def area_of(pitch: tuple[int, int], top: int = 1, left: int = 2, bottom: int = 17, right: int = 31) -> bytes:
    return struct.pack(">8I", top, left, bottom, right, 0, 1, *pitch)


def one(code: int, body: bytes) -> bytes:
    return pack_opcodes([Opcode(code, 0x01030000, 0, body)])


def lines(opcodes: bytes, size: tuple[int, int]) -> np.ndarray:
    """What the only opcode, a number for each row or column of an area, adds to every site."""
    added = np.zeros(size, np.float32)
    for opcode in unpack_opcodes(opcodes):
        top, left, bottom, right, _, _, rows, columns = struct.unpack_from(">8I", opcode.body)
        (count,) = struct.unpack_from(">I", opcode.body, 32)
        numbers = np.array(struct.unpack_from(f">{count}f", opcode.body, 36), np.float32)
        part = added[top : min(bottom, size[0]) : rows, left : min(right, size[1]) : columns]
        part += numbers[: part.shape[0], None] if opcode.code in (10, 12) else numbers[None, : part.shape[1]]
    return added


@pytest.mark.parametrize("shift", SHIFTS)
@pytest.mark.parametrize("pitch", [(1, 1), (2, 2), (3, 2)])
@pytest.mark.parametrize("code", [10, 11, 12, 13])
def test_numbers_of_rows_and_columns_stay_with_them(code: int, pitch: tuple[int, int], shift: tuple[int, int]) -> None:
    sides = (16 / pitch[0], 29 / pitch[1])
    count = math.ceil(sides[code in (11, 13)])
    opcodes = one(code, area_of(pitch) + struct.pack(f">I{count}f", count, *range(1, count + 1)))
    part = (12, 24)
    moved, left_out = move_opcodes(opcodes, shift, SIZE, part)
    expected = lines(opcodes, SIZE)[shift[0] :, shift[1] :][: part[0], : part[1]]
    assert left_out == [] and np.array_equal(lines(moved, part), expected)


def gains_at(opcodes: bytes, size: tuple[int, int]) -> np.ndarray:
    gains = np.ones(size)
    for gain_map in parse_gain_maps(opcodes, on_mosaic=True):
        rows, columns = np.arange(size[0]), np.arange(size[1])
        grid = gain_map.gains[0].numpy().astype(float)
        v = ((rows + 0.5) / size[0] - gain_map.origin[0]) / gain_map.spacing[0]
        h = ((columns + 0.5) / size[1] - gain_map.origin[1]) / gain_map.spacing[1]
        along = np.stack([np.interp(h, np.arange(grid.shape[1]), line) for line in grid])
        whole = np.stack([np.interp(v, np.arange(grid.shape[0]), line) for line in along.T], axis=1)
        top, left, bottom, right = gain_map.area
        part = np.s_[top : bottom : gain_map.pitch[0], left : right : gain_map.pitch[1]]
        gains[part] *= whole[part]
    return gains


@pytest.mark.parametrize("shift", SHIFTS)
def test_gain_maps_stay_with_their_sites(shift: tuple[int, int]) -> None:
    grids = torch.rand(4, 1, 3, 5, generator=torch.Generator().manual_seed(0)) + 1
    maps = [
        GainMap((i, j, *SIZE), (2, 2), (0, 1), (0.1, 0.05), (0.4, 0.2), grids[2 * i + j])
        for i in (0, 1)
        for j in (0, 1)
    ]
    opcodes = opcode_list(maps)
    part = (14, 24)
    moved, left_out = move_opcodes(opcodes, shift, SIZE, part)
    expected = gains_at(opcodes, SIZE)[shift[0] :, shift[1] :][: part[0], : part[1]]
    assert left_out == [] and np.abs(gains_at(moved, part) - expected).max() < 1e-6


@pytest.mark.parametrize("shift", SHIFTS)
def test_bad_sites_and_their_phase_stay_where_they_are(shift: tuple[int, int]) -> None:
    sites, rectangles = [(0, 0), (7, 9), (12, 30)], [(2, 3, 6, 8), (0, 0, 2, 2)]
    numbers = [n for site in sites for n in site] + [n for rectangle in rectangles for n in rectangle]
    moved, _ = move_opcodes(one(5, struct.pack(">3I14I", 1, 3, 2, *numbers)), shift, SIZE, (14, 24))
    bad = np.zeros(SIZE, bool)
    for row, column in sites:
        bad[row, column] = True
    for top, left, bottom, right in rectangles:
        bad[top:bottom, left:right] = True

    (opcode,) = unpack_opcodes(moved)
    phase, count, count_of_rectangles, *rest = struct.unpack(f">{len(opcode.body) // 4}I", opcode.body)
    found = np.zeros((14, 24), bool)
    for k in range(0, 2 * count, 2):
        found[rest[k], rest[k + 1]] = True
    for k in range(2 * count, 2 * count + 4 * count_of_rectangles, 4):
        found[rest[k] : rest[k + 2], rest[k + 1] : rest[k + 3]] = True
    assert np.array_equal(found, bad[shift[0] :, shift[1] :][:14, :24])
    red = (0, 1)
    assert (phase >> 1, phase & 1) == ((red[0] - shift[0]) % 2, (red[1] - shift[1]) % 2)


def test_a_vignette_and_a_warp_keep_their_centre_and_their_strength() -> None:
    numbers = (0.3, -0.1, 0.05, 0.01, 0.02, 0.45, 0.55)

    def gains(body: bytes, size: tuple[int, int]) -> np.ndarray:
        *k, across, down = struct.unpack(">7d", body)
        rows, columns = np.arange(size[0])[:, None] - down * size[0], np.arange(size[1]) - across * size[1]
        corner = np.hypot(max(down, 1 - down) * size[0], max(across, 1 - across) * size[1])
        square = (rows**2 + columns**2) / corner**2
        return np.asarray(1 + sum(number * square ** (power + 1) for power, number in enumerate(k)))

    body = struct.pack(">7d", *numbers)
    moved, _ = move_opcodes(one(3, body), (1, 4), SIZE, (18, 26))
    (vignette,) = unpack_opcodes(moved)
    assert np.allclose(gains(vignette.body, (18, 26)), gains(body, SIZE)[1:19, 4:30])

    warp = struct.pack(">I8d", 1, 1.0, 0.1, 0.01, 0.001, 0.02, 0.03, 0.45, 0.55)
    moved, _ = move_opcodes(one(1, warp), (1, 4), SIZE, (18, 26))
    (opcode,) = unpack_opcodes(moved)
    planes, *all_numbers = struct.unpack(">I8d", opcode.body)
    assert planes == 1 and all_numbers[0] == 1.0 and 0 < all_numbers[1] < 0.1
    assert all_numbers[6] * 26 + 4 == pytest.approx(0.45 * 31) and all_numbers[7] * 18 + 1 == pytest.approx(0.55 * 20)


def test_what_cannot_be_moved_is_left_out_and_said() -> None:
    sound = Opcode(6, 1, 0, struct.pack(">4I", 2, 2, 10, 10))
    unknown, damaged = Opcode(99, 1, 0, b"abcd"), Opcode(10, 1, 0, area_of((0, 1)) + bytes(4))
    opcodes = pack_opcodes([unknown, sound, damaged])
    moved, left_out = move_opcodes(opcodes, (2, 2), SIZE, (10, 10))
    (opcode,) = unpack_opcodes(moved)
    assert struct.unpack(">4I", opcode.body) == (0, 0, 8, 8)
    assert len(left_out) == 2 and "99" in left_out[0] and "damaged" in left_out[1]
    assert move_opcodes(opcodes, (0, 0), SIZE, SIZE) == (opcodes, []), "kept byte for byte where nothing moves"
    assert move_opcodes(opcodes[:-8] + b"", (2, 2), SIZE, (10, 10))[1], "a truncated list"
    assert move_opcodes(b"", (2, 2), SIZE, (10, 10))[0] == b""


def test_a_dng_s_lists_move_from_the_sensor_and_from_its_active_area(tmp_path: Path, bayer_dng: Dng) -> None:
    """The defect of list 1 counts from the first stored site, the red map of list 2 from an odd active area."""
    numbers = np.full((44, 70), 1000, np.uint16)
    defects = one(5, struct.pack(">5I", 2, 1, 0, 20, 30))  # the cell of the active area is G B / R G
    grid = torch.full((1, 2, 2), 2.0)
    red = opcode_list([GainMap((1, 0, 40, 64), (2, 2), (0, 1), (0.0, 0.0), (1.0, 1.0), grid)])
    extra = [
        (50829, LONG, 4, (3, 4, 43, 68), True),
        (50719, LONG, 2, (8, 8), True),
        (50720, LONG, 2, (48, 24), True),
        (51008, UNDEFINED, len(defects), defects, True),
        (51009, UNDEFINED, len(red), red, True),
    ]
    source = bayer_dng(tmp_path / "a.dng", numbers, "GBRG", extra=extra)
    frame = read_raw(source)
    assert frame.offset == (4, 4) and frame.cfa == "RGGB" and frame.mosaic.shape == (1, 38, 64)
    assert frame.gain_maps[0].area == (0, 0, 38, 64), "red, as the mosaic counts"
    assert frame.crop == (7, 8, 24, 48)
    write_dng(tmp_path / "b.dng", frame, source)
    with tifffile.TiffFile(tmp_path / "b.dng") as file:
        tags = file.pages.first.tags
        (defect,) = unpack_opcodes(tags[51008].value)
        assert struct.unpack(">5I", defect.body)[-2:] == (16, 26)
        (moved,) = parse_gain_maps(tags[51009].value, on_mosaic=True)
        assert moved.area == (0, 0, 38, 64) and tags[50719].value == (8, 7) and tags[50720].value == (48, 24)

    rgb = torch.full((3, 38, 64), 0.5)
    write_dng(tmp_path / "c.dng", frame, source, rgb=rgb)
    with tifffile.TiffFile(tmp_path / "c.dng") as file:
        (linear,) = parse_gain_maps(file.pages.first.tags[51009].value, on_mosaic=True)
        assert linear.planes == (0, 1) and linear.gains.unique().tolist() == [2.0]


def test_an_opcode_that_cannot_be_moved_is_remarked(tmp_path: Path, bayer_dng: Dng) -> None:
    fisheye = one(2, struct.pack(">I6d", 1, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5))
    extra = [(50829, LONG, 4, (2, 2, 42, 66), True), (51008, UNDEFINED, len(fisheye), fisheye, True)]
    source = bayer_dng(tmp_path / "a.dng", np.full((44, 70), 1000, np.uint16), extra=extra)
    with pytest.warns(UserWarning, match=r"a\.dng: .*opcode 2"):
        write_dng(tmp_path / "b.dng", read_raw(source), source)
    with tifffile.TiffFile(tmp_path / "b.dng") as file:
        assert 51008 not in file.pages.first.tags
