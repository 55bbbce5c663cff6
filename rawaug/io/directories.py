"""TIFF directories, as in TIFF files, RAW files and EXIF, with tags that are read and written byte for byte.

A directory is a list of entries: a code, a type, the number of values, and the values or their place. An EXIF block is
a small TIFF without pixels, whose first directory points at those of the exposure, of GPS and of a thumbnail. Nothing
is converted here, so copied data stay as they were, makers' notes included. Source: TIFF 6.0; Exif 2.32.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import BinaryIO, NamedTuple

ORIENTATION, COMPRESSION, PHOTOMETRIC, SUB_DIRECTORIES = 274, 259, 262, 330
EXIF, GPS, INTEROPERABILITY = 34665, 34853, 40965
STRIP_BYTES, TILE_BYTES = 279, 325
THUMBNAIL, THUMBNAIL_BYTES = 513, 514
POINTERS = (EXIF, GPS, INTEROPERABILITY)
"""The value of these tags is the place of another directory."""

MOST_ENTRIES, MOST_BYTES, MOST_NUMBERS = 4096, 2**26, 2**20
"""These are the limits of a directory and of its values; larger ones count as damaged."""
_MOST_DIRECTORIES = 32

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
"""A value has this many bytes, by type."""


class DamagedTags(ValueError):
    """A directory that cannot be right."""


class Entry(NamedTuple):
    """One tag of a file: its type, the number of its values, and the place and size of their bytes."""

    code: int
    dtype: int
    values: int
    offset: int
    size: int


class Tag(NamedTuple):
    """One tag to be written: its values are bytes in the file's order."""

    code: int
    dtype: int
    values: int
    data: bytes


class Directory(NamedTuple):
    """The tags of a directory by their codes, and the place of the next one, or 0."""

    entries: dict[int, Entry]
    following: int


class TiffFile:
    """The directories of a TIFF or of an EXIF block.

    Args:
        file: the bytes, which begin with those of a TIFF's header.

    Raises:
        DamagedTags: if this is not a TIFF.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.end = file.seek(0, 2)

        head = self.read(0, max(8, min(16, self.end))).ljust(16, b"\0")
        orders = {b"II": "<", b"MM": ">"}
        if head[:2] not in orders:
            raise DamagedTags("no TIFF header")
        self.order = orders[head[:2]]

        (self.version,) = struct.unpack_from(self.order + "H", head, 2)
        self.big = self.version == 43
        self.first: int
        if self.big:
            (self.first,) = struct.unpack_from(self.order + "Q", head, 8)
        else:
            (self.first,) = struct.unpack_from(self.order + "I", head, 4)

    def directory(self, offset: int) -> Directory:
        """Read the directory that begins at ``place``."""
        counter, pointer = ("Q", "Q") if self.big else ("H", "I")
        head = struct.calcsize(self.order + counter)
        (count,) = struct.unpack(self.order + counter, self.read(offset, head))
        if count > MOST_ENTRIES:
            raise DamagedTags(f"a directory of {count} tags")

        inside = struct.calcsize(self.order + pointer)
        step = 4 + 2 * inside
        table = self.read(offset + head, count * step)

        entries: dict[int, Entry] = {}
        for start in range(0, count * step, step):
            code, dtype = struct.unpack_from(self.order + "HH", table, start)
            (values,) = struct.unpack_from(self.order + pointer, table, start + 4)
            size = _SIZES.get(dtype, 0) * values
            if not size:
                continue

            at = offset + head + start + 4 + inside
            if size > inside:
                (at,) = struct.unpack_from(self.order + pointer, table, start + 4 + inside)
            entries[code] = Entry(code, dtype, values, at, size)

        # Some programs leave out where the next directory begins after the last one.
        following = 0
        end = offset + head + count * step
        if end + inside <= self.end:
            (following,) = struct.unpack(self.order + pointer, self.read(end, inside))
        return Directory(entries, following)

    def directories(self) -> Iterator[Directory]:
        """Yield the first directories of a file and those that they point at, each once."""
        waiting = [self.first]
        places: set[int] = set()
        while waiting and len(places) < _MOST_DIRECTORIES:
            offset = waiting.pop(0)
            if not offset or offset in places:
                continue
            places.add(offset)

            directory = self.directory(offset)
            yield directory
            waiting.extend(self.numbers(directory.entries.get(SUB_DIRECTORIES)))
            waiting.append(directory.following)

    def tag(self, entry: Entry) -> Tag:
        """Read a tag with its values."""
        if entry.size > MOST_BYTES:
            raise DamagedTags(f"tag {entry.code} of {entry.size} bytes")
        return Tag(entry.code, entry.dtype, entry.values, self.read(entry.offset, entry.size))

    def tags(self, entries: Iterable[Entry]) -> list[Tag]:
        """Read tags with their values. Their total size is limited, since values may overlap in a hostile file."""
        tags = []
        size = 0
        for entry in entries:
            size += entry.size
            if size > MOST_BYTES:
                raise DamagedTags(f"tags of {size} bytes")
            tags.append(self.tag(entry))
        return tags

    def numbers(self, entry: Entry | None) -> tuple[int, ...]:
        """Read the whole numbers of a tag; there are none if it is missing or holds something else."""
        letters = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
        if entry is None or entry.dtype not in letters:
            return ()
        if entry.values > MOST_NUMBERS:
            raise DamagedTags(f"tag {entry.code} of {entry.values} numbers")
        return struct.unpack(f"{self.order}{entry.values}{letters[entry.dtype]}", self.tag(entry).data)

    def number(self, directory: Directory, code: int, default: int = 0) -> int:
        """Read the first whole number of a tag."""
        numbers = self.numbers(directory.entries.get(code))
        if not numbers:
            return default
        return numbers[0]

    def rational(self, entry: Entry | None) -> float:
        """Read the first number of a tag of fractions; return 0 if it is missing, holds others, or divides by zero."""
        numbers = self.rationals(entry)
        if not numbers:
            return 0.0
        return numbers[0]

    def rationals(self, entry: Entry | None) -> list[float]:
        """Read a tag of fractions, with 0 for one that divides by zero; there are none if it is missing."""
        if entry is None or entry.dtype not in (5, 10):
            return []
        letter = "I" if entry.dtype == 5 else "i"
        numbers = struct.unpack(f"{self.order}{2 * entry.values}{letter}", self.tag(entry).data)
        fractions = []
        for numerator, denominator in zip(numbers[0::2], numbers[1::2], strict=True):
            fractions.append(numerator / denominator if denominator else 0.0)
        return fractions

    def read(self, offset: int, size: int) -> bytes:
        """Read bytes of the file; raise DamagedTags if it has fewer."""
        if offset + size > self.end:
            raise DamagedTags(f"{size} bytes at {offset} of {self.end}")
        self._file.seek(offset)
        return self._file.read(size)


def pack_directory(order: str, tags: Iterable[Tag], offset: int, following: int = 0) -> bytes:
    """Pack a directory for ``place``, followed by the values that do not fit into it."""
    ordered = sorted(tags, key=lambda tag: tag.code)
    beyond = offset + 2 + 12 * len(ordered) + 4

    table, values = struct.pack(order + "H", len(ordered)), b""
    for tag in ordered:
        table += struct.pack(order + "HHI", tag.code, tag.dtype, tag.values)
        if len(tag.data) <= 4:
            table += tag.data.ljust(4, b"\0")
        else:
            table += struct.pack(order + "I", beyond + len(values))
            values += tag.data + bytes(len(tag.data) % 2)
    return table + struct.pack(order + "I", following) + values


def pointer_tag(order: str, code: int, offset: int) -> Tag:
    """Make the tag that says where a directory is."""
    return Tag(code, 4, 1, struct.pack(order + "I", offset))
