"""Directories in a circle are refused in one line, by whatever reads tags."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rawaug.io import read_raw, write_dng
from rawaug.io.tiff import MOST_DIRECTORIES, require_no_circle

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
        with pytest.raises(OSError, match=r"bad\.dng: its TIFF tags are damaged \(.*in a circle, at byte 8\)"):
            read()


def test_long_chains_and_other_files(tmp_path: Path) -> None:
    path = tmp_path / "chain.tif"
    chain(path, MOST_DIRECTORIES, 0)
    require_no_circle(path)
    chain(path, MOST_DIRECTORIES + 1, 0)
    with pytest.raises(ValueError, match=f"more than {MOST_DIRECTORIES} directories"):
        require_no_circle(path)
    chain(path, 200, 8 + 6 * 150)  # a circle that does not hold the first
    with pytest.raises(ValueError, match="in a circle, at byte 908"):
        require_no_circle(path)
    for content in (b"", b"II", b"II*\0", b"MM\0*\xff\xff\xff\xff", b"\x89PNG" * 8):
        path.write_bytes(content)
        require_no_circle(path)
