"""BMP of 4 bits in run lengths (RLE4), unpacked here, since Pillow before 13 misreads literal runs of odd length.

A pair (n, c) with n > 0 is n pixels of the two halves of c in turn. (0, 0) ends a row, (0, 1) the picture, (0, 2)
moves right and up by the next two bytes, and (0, n) with n > 2 is followed by n literal pixels of half a byte, filled
up to an even number of bytes. Rows come from the bottom. Source: Microsoft, Windows GDI, "Bitmap Compression".
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np

_RLE4 = 2
_BITS_AND_COMPRESSION = struct.Struct("<HI")


def is_rle4(path: Path) -> bool:
    """Tell whether a BMP is in run lengths of 4 bits."""
    with path.open("rb") as file:
        head = file.read(34)
    return len(head) == 34 and _BITS_AND_COMPRESSION.unpack_from(head, 28) == (4, _RLE4)


def unpack_rle4(path: Path) -> bytes:
    """Return the file of the same BMP without compression; raise ValueError if its data end before its picture."""
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 10)
    width, height = struct.unpack_from("<ii", data, 18)
    pixels = np.zeros((height, width), np.uint8)
    x, y, offset = 0, 0, start
    while y < height:
        if offset + 2 > len(data):
            raise ValueError(f"BMP: its run lengths end at row {y} of {height}")
        count, code = data[offset], data[offset + 1]
        offset += 2

        if count:
            run = np.resize(np.array([code >> 4, code & 15], np.uint8), count)
        elif code == 0:
            x, y = 0, y + 1
            continue
        elif code == 1:
            break
        elif code == 2:
            x, y = x + data[offset], y + data[offset + 1]
            offset += 2
            continue
        else:
            size = (code + 1) // 2
            halves = np.frombuffer(data, np.uint8, size, offset)
            run = np.stack([halves >> 4, halves & 15], -1).ravel()[:code]
            offset += size + size % 2

        run = run[: max(0, width - x)]  # as decoders do, pixels beyond the end of a row are dropped
        pixels[y, x : x + len(run)] = run
        x += len(run)

    padded = np.zeros((height, math.ceil(width / 8) * 8), np.uint8)
    padded[:, :width] = pixels
    packed = (padded[:, 0::2] << 4 | padded[:, 1::2]).tobytes()
    head = bytearray(data[:start])
    struct.pack_into("<I", head, 2, start + len(packed))
    struct.pack_into("<II", head, 30, 0, len(packed))
    return bytes(head) + packed
