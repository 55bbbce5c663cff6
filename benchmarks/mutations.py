"""Damage that knows the structure of a file: what a reader believes is changed, and the rest is left whole.

A mutation takes the bytes of a whole file and a generator, and gives the bytes of a hostile one: directories in a
circle, sizes and counts beyond reason, types exchanged, parts twice or missing, checksums that are right all the same.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import yaml

from benchmarks.damage import NUMBERS

Mutation = Callable[[bytes, np.random.Generator], bytes]


def _number(rng: np.random.Generator, size: int, near: int = 0) -> bytes:
    """A seldom number of ``size`` bytes, or one near ``near``, little-endian."""
    value = near + int(rng.integers(-8, 9)) if rng.random() < 0.3 else NUMBERS[int(rng.integers(len(NUMBERS)))]
    return (value % 256**size).to_bytes(size, "little")


def _pick(rng: np.random.Generator, items: list[Any]) -> Any:
    return items[int(rng.integers(len(items)))]


# -- TIFF and DNG -----------------------------------------------------------------------------------------------------

_SUB_IFDS, _POINTERS = 330, (330, 34665, 34853)


def _directories(data: bytes, order: str) -> Iterator[tuple[int, int]]:
    """Place and number of entries of each directory, those that pointers name too."""
    todo, seen = [struct.unpack_from(order + "I", data, 4)[0]], set[int]()
    while todo:
        place = todo.pop()
        if place in seen or not 0 < place < len(data) - 6:
            continue
        seen.add(place)
        (count,) = struct.unpack_from(order + "H", data, place)
        if place + 6 + 12 * count > len(data):
            continue
        yield place, count
        todo.append(struct.unpack_from(order + "I", data, place + 2 + 12 * count)[0])
        for entry in range(place + 2, place + 2 + 12 * count, 12):
            code, _, values, value = struct.unpack_from(order + "HHII", data, entry)
            todo += [value] if code in _POINTERS and values == 1 else []


def tiff(whole: bytes, rng: np.random.Generator) -> bytes:
    """An entry's code, type, count or value; a pointer into a circle."""
    data, order = bytearray(whole), "<" if whole[:2] == b"II" else ">"
    found = list(_directories(whole, order))
    place, count = _pick(rng, found)
    entry = place + 2 + 12 * int(rng.integers(count))
    what, other = rng.random(), _pick(rng, found)[0]
    if what < 0.15:  # the successor
        struct.pack_into(order + "I", data, place + 2 + 12 * count, other)
    elif what < 0.3:  # children, of which each is its own parent
        struct.pack_into(order + "HHII", data, entry, _SUB_IFDS, 4, 1 if rng.random() < 0.5 else 2**20, other)
    else:
        offset, size = _pick(rng, [(0, 2), (2, 2), (4, 4), (8, 4)])
        number = _number(rng, size, int.from_bytes(data[entry + offset : entry + offset + size], "little"))
        data[entry + offset : entry + offset + size] = number if order == "<" else number[::-1]
    return bytes(data)


# -- CRW --------------------------------------------------------------------------------------------------------------


def crw(whole: bytes, rng: np.random.Generator) -> bytes:
    """A record of the heap's directory, which is at the end of the file: its tag, length or offset."""
    data = bytearray(whole)
    start = struct.unpack_from("<I", data, 2)[0]
    directory = start + struct.unpack_from("<I", data, len(data) - 4)[0]
    (count,) = struct.unpack_from("<H", data, directory)
    record = directory + 2 + 10 * int(rng.integers(max(count, 1)))
    offset, size = _pick(rng, [(0, 2), (2, 4), (6, 4)])
    near = int.from_bytes(data[record + offset : record + offset + size], "little")
    data[record + offset : record + offset + size] = _number(rng, size, near)
    if rng.random() < 0.2:  # a heap that holds itself
        struct.pack_into("<HII", data, record, 0x300A, len(data) - start, 0)
    return bytes(data)


# -- MATLAB -----------------------------------------------------------------------------------------------------------

_HDF5_BLOCKS = (b"TREE", b"HEAP", b"SNOD", b"GCOL", b"OHDR", b"\x89HDF")


def hdf5(whole: bytes, rng: np.random.Generator) -> bytes:
    """A number in the head of a block, or the address of another block in its place."""
    data = bytearray(whole)
    places = [k for name in _HDF5_BLOCKS for k in range(0, len(data) - 64, 8) if data[k : k + 4] == name]
    block = _pick(rng, places)
    if rng.random() < 0.3:
        address = _pick(rng, places) - whole.index(b"\x89HDF")  # MATLAB's header comes before
        at = block + 8 * int(rng.integers(1, 8))
        data[at : at + 8] = (address % 2**64).to_bytes(8, "little")
    else:
        size = _pick(rng, [1, 2, 4, 8])
        at = block + 4 + int(rng.integers(60 // size)) * size
        data[at : at + size] = _number(rng, size)
    return bytes(data)


_COMPRESSED, _MATRIX = 15, 14


def _elements(data: bytes, start: int, end: int) -> Iterator[int]:
    """Places of the tags of a file of version 5, inside matrices too."""
    while start + 8 <= end:
        kind, size = struct.unpack_from("<II", data, start)
        yield start
        small = kind >> 16
        if kind == _MATRIX:
            yield from _elements(data, start + 8, min(start + 8 + size, end))
        start += 8 if small else 8 + size + -size % 8


def mat5(whole: bytes, rng: np.random.Generator) -> bytes:
    """An element's type, size or first number; inside compressed ones too."""
    head, body = whole[:128], whole[128:]
    tags = [k for k in _elements(body, 0, len(body)) if struct.unpack_from("<I", body, k)[0] == _COMPRESSED]
    if tags and rng.random() < 0.9:
        tag = _pick(rng, tags)
        (size,) = struct.unpack_from("<I", body, tag + 4)
        inner = zlib.compress(_changed_element(zlib.decompress(body[tag + 8 : tag + 8 + size]), rng))
        body = body[:tag] + struct.pack("<II", _COMPRESSED, len(inner)) + inner + body[tag + 8 + size :]
        return head + body
    return head + _changed_element(body, rng)


def _changed_element(body: bytes, rng: np.random.Generator) -> bytes:
    data, tag = bytearray(body), _pick(rng, list(_elements(body, 0, len(body))))
    at = tag + 4 * int(rng.integers(4))
    data[at : at + 4] = _number(rng, 4, int.from_bytes(data[at : at + 4], "little"))
    return bytes(data[: len(body)])


# -- safetensors ------------------------------------------------------------------------------------------------------

_VALUES: list[Any] = [
    None,
    -1,
    0,
    10**6,
    10**9,
    10**30,
    1e29,
    True,
    "x",
    "",
    [],
    {},
    [1] * 10**5,
    "NaN",
    "Infinity",
    "1e999",
]


def safetensors(whole: bytes, rng: np.random.Generator) -> bytes:
    """Of the header a text, a number of its JSON, a type, shape or range; or values that are no numbers."""
    end = 8 + int.from_bytes(whole[:8], "little")
    header, content = json.loads(whole[8:end]), bytearray(whole[end:])
    texts, names = header.setdefault("__metadata__", {}), [name for name in header if name != "__metadata__"]
    what = rng.random()
    if what < 0.6 and texts:
        key = _pick(rng, sorted(texts))
        texts[key] = _changed_text(texts[key], rng)
        if rng.random() < 0.15:
            del texts[key]
    elif what < 0.8 and names:
        entry = header[_pick(rng, names)]
        field = _pick(rng, ["dtype", "shape", "data_offsets"])
        entry[field] = _pick(rng, ["F64", "I8", "BOOL", "F8_E4M3"]) if field == "dtype" else _pick(rng, _VALUES)
    elif len(content) >= 4:
        at = 4 * int(rng.integers(len(content) // 4))
        content[at : at + 4] = struct.pack("<f", _pick(rng, [np.nan, np.inf, -np.inf, 3e38]))
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + bytes(content)


def _changed_text(text: str, rng: np.random.Generator) -> str:
    """A value of a JSON object exchanged, or the text made one that no reader expects."""
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = None
    if not isinstance(value, dict) or not value or rng.random() < 0.2:
        return _pick(rng, ["", "null", "[]", '{"a":' * 10_000, "9" * 5000, text[: len(text) // 2]])
    value[_pick(rng, sorted(value))] = "@"
    new = _pick(rng, _VALUES)
    return json.dumps(value).replace('"@"', new if new in ("NaN", "Infinity", "1e999") else json.dumps(new))


# -- pictures ---------------------------------------------------------------------------------------------------------


def png(whole: bytes, rng: np.random.Generator) -> bytes:
    """A chunk changed, twice or missing; checksums are right."""
    chunks, at = list[tuple[bytes, bytes]](), 8
    while at + 12 <= len(whole):
        (size,) = struct.unpack_from(">I", whole, at)
        chunks.append((whole[at + 4 : at + 8], whole[at + 8 : at + 8 + size]))
        at += 12 + size
    k = 0 if rng.random() < 0.5 else int(rng.integers(len(chunks)))
    kind, content = chunks[k]
    what = rng.random()
    if kind == b"IHDR" and what < 0.8:
        field, size = _pick(rng, [(0, 4), (4, 4), (8, 1), (9, 1), (12, 1)])
        changed = bytearray(content)
        changed[field : field + size] = _number(rng, size)[::-1]
        chunks[k] = kind, bytes(changed)
    elif what < 0.5:
        chunks.insert(int(rng.integers(len(chunks))), chunks[k])
    elif what < 0.7:
        del chunks[k]
    else:
        chunks[k] = kind, content[: len(content) // 2]
    parts = [struct.pack(">I", len(c)) + kind + c + struct.pack(">I", zlib.crc32(kind + c)) for kind, c in chunks]
    return whole[:8] + b"".join(parts)


def jpeg(whole: bytes, rng: np.random.Generator) -> bytes:
    """A byte or two of a segment before the scan, a segment twice or missing, or a wrong length."""
    segments, at = list[bytes](), 2
    while at + 4 <= len(whole) and whole[at] == 0xFF and whole[at + 1] != 0xDA:
        size = 2 + struct.unpack_from(">H", whole, at + 2)[0]
        segments.append(whole[at : at + size])
        at += size
    k = int(rng.integers(len(segments)))
    what = rng.random()
    if what < 0.2:
        del segments[k]
    elif what < 0.4:
        segments.insert(int(rng.integers(len(segments))), segments[k])
    else:
        changed = bytearray(segments[k])
        place = int(rng.integers(2, min(len(changed), 24)))
        size = min(1 + int(rng.integers(2)), len(changed) - place)
        changed[place : place + size] = _number(rng, size)
        segments[k] = bytes(changed)
    return whole[:2] + b"".join(segments) + whole[at:]


# -- recipes ----------------------------------------------------------------------------------------------------------

_LAUGHS = "laugh0: &l0 [ha, ha]\n" + "".join(f"laugh{k}: &l{k} [*l{k - 1}, *l{k - 1}]\n" for k in range(1, 60))


def recipe(whole: bytes, rng: np.random.Generator) -> bytes:
    """A value of a recipe exchanged, at any depth; or aliases of aliases."""
    content = yaml.safe_load(whole)
    node, depth = content, 0
    while True:
        key = _pick(rng, sorted(node) if isinstance(node, dict) else list(range(len(node))))
        inner = node[key]
        if not isinstance(inner, (dict, list)) or not inner or rng.random() < 0.2 or depth > 20:
            break
        node, depth = inner, depth + 1
    node[key] = _pick(rng, [*_VALUES, 1e25, float("nan"), float("inf"), "@"])
    text = yaml.safe_dump(content)
    if rng.random() < 0.15:
        return (text + _LAUGHS).encode()
    return text.replace("'@'", "[" * 3000 + "]" * 3000).encode()


MUTATIONS: dict[str, Mutation] = {
    ".crw": crw,
    ".dng": tiff,
    ".tif": tiff,
    ".jpg": jpeg,
    ".png": png,
    ".mat5.mat": mat5,
    ".mat73.mat": hdf5,
    ".safetensors": safetensors,
    ".yaml": recipe,
}
"""By the end of a file's name."""
