"""TIFF directories in a circle, and gain maps."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.io import read_raw, write_dng
from rawaug.io.gain_map import GainMap, opcode_list, parse_gain_maps
from rawaug.io.tiff import all_pages, opened_tiff

LONG = 4


def first_directory(path: Path) -> tuple[int, int]:
    """Place of the first directory, and of its pointer to the next."""
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 4)
    (count,) = struct.unpack_from("<H", data, start)
    return start, start + 2 + 12 * count


def changed(path: Path, place: int, number: int) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, place, number)
    path.write_bytes(data)


def chain(path: Path, count: int, last: int) -> None:
    """A TIFF of empty directories, each naming the next, the last one naming ``last``."""
    places = [8 + 6 * k for k in range(count)]
    nexts = [*places[1:], last]
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + b"".join(struct.pack("<HI", 0, at) for at in nexts))


@pytest.mark.parametrize("children", [False, True])
def test_a_dng_whose_directories_point_in_a_circle(
    children: bool, tmp_path: Path, bayer_dng: Callable[..., Path]
) -> None:
    numbers = np.full((32, 48), 1000, np.uint16)
    good = read_raw(bayer_dng(tmp_path / "good.dng", numbers))
    bad = bayer_dng(tmp_path / "bad.dng", numbers, extra=[(65000, LONG, 2, (8, 8), True)] if children else ())
    entry = struct.pack("<HHI", 65000, LONG, 2)
    bad.write_bytes(bad.read_bytes().replace(entry, struct.pack("<HHI", 330, LONG, 2)))  # SubIFDs
    start, successor = first_directory(bad)
    assert start == 8
    if not children:
        changed(bad, successor, start)
    for read in (lambda: read_raw(bad), lambda: write_dng(tmp_path / "out.dng", good, source=bad)):
        with pytest.raises(OSError, match=r"bad\.dng: .*TIFF"):
            read()


@pytest.mark.parametrize("last", [8, 8 + 6 * 150])  # to the first one, and a circle that does not hold it
def test_chains_without_an_end(last: int, tmp_path: Path) -> None:
    chain(tmp_path / "a.tif", 200, last)
    with pytest.raises(OSError, match="in a circle"), opened_tiff(tmp_path / "a.tif") as tiff:
        all_pages(tiff)


def a_map(**changes: object) -> GainMap:
    defaults = {
        "area": (0, 0, 8, 12),
        "pitch": (1, 1),
        "planes": (0, 1),
        "origin": (0.0, 0.0),
        "spacing": (0.5, 0.25),
        "gains": torch.rand(1, 3, 5, generator=torch.Generator().manual_seed(0)) + 1,
    }
    return GainMap(**{**defaults, **changes})  # type: ignore[arg-type]


def test_opcode_lists_go_there_and_back() -> None:
    maps = a_map(), a_map(area=(1, 1, 8, 12), pitch=(2, 2), gains=torch.rand(2, 4, 3))
    opcodes = opcode_list(maps)
    for written, read in zip(maps, parse_gain_maps(opcodes, on_mosaic=True), strict=True):
        assert torch.equal(written.gains, read.gains)
        assert (written.area, written.pitch, written.planes, written.spacing) == (
            read.area,
            read.pitch,
            read.planes,
            read.spacing,
        )
    other = struct.pack(">4I", 1, 0x01030000, 0, 8) + bytes(8)  # another opcode in front
    assert len(parse_gain_maps(struct.pack(">I", 3) + other + opcodes[4:], on_mosaic=True)) == 2


def test_what_is_cut_short_is_refused() -> None:
    opcodes = opcode_list([a_map()])
    with pytest.raises(ValueError, match="is incomplete"):
        parse_gain_maps(opcodes[:-4], on_mosaic=True)
    with pytest.raises(ValueError, match="truncated"):
        parse_gain_maps(opcodes[:10], on_mosaic=True)
    for nonsense in (a_map(spacing=(0.0, 0.25)), a_map(gains=torch.full((1, 3, 5), torch.nan))):
        with pytest.raises(ValueError, match="is invalid"):
            parse_gain_maps(opcode_list([nonsense]), on_mosaic=True)
