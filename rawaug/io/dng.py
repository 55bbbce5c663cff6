r"""Mosaics and linear RGB out, as DNG: ``d = round(y (white - black) + black)``, 16 bits a site or sample.

``AsShotNeutral`` is the colour of grey to the camera, ``1 / white_balance``. ``ColorMatrix1`` takes XYZ to the camera
under D65, ``X = diag(1 / daylight) M^-1 S^-1``, from the frame's ``color_matrix`` M (white-balanced camera to linear
sRGB) and S, which takes linear sRGB to XYZ: the inverse of what :func:`rawaug.io.read_raw` does.

A rewritten DNG keeps camera, colour, lens corrections, EXIF, GPS and XMP of its source. Left out is what describes the
old pixels (their layout, levels, digests, previews, noise profile) and what points into the old file (maker notes). The
EXIF and GPS directories are copied value by value in their binary form.

Pixels are compressed as lossless JPEG, the difference to the left neighbour of the same colour in Huffman's code, to
about half (14 bits) or a third (10 bits) of their size. (LibRaw reads no integers compressed by deflate.)
Source: DNG specification 1.4, chapters 3 to 6; TIFF 6.0, section 2; ITU-T T.81, annex H.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from itertools import product
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import pattern, plane_indices
from rawaug.errors import extra
from rawaug.files import replacing
from rawaug.io.gain_map import GainMap, of_planes, opcode_list
from rawaug.io.raw import XYZ_FROM_SRGB, RawFrame
from rawaug.io.tiff import (
    ACTIVE_AREA,
    CFA_PHOTOMETRIC,
    DNG_VERSION,
    LINEAR_PHOTOMETRIC,
    OPCODE_LIST_2,
    OPCODE_LIST_3,
    all_pages,
    main_mosaic,
    opened_tiff,
    tag_damage,
)
from rawaug.version import __version__

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
_BEYOND_16_BITS = 65535.5
LINEAR_WHITE = 65535
"""Digital number of white in a linear DNG, whose black is 0."""
_LARGEST = 2.0**31 - 2
_LARGEST_ISO = 65535
_UNIQUE_CAMERA_MODEL = 50708
_D65 = 21
_EXIF_ORIENTATIONS = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}
"""By LibRaw's flip."""


def write_dng(
    path: str | Path,
    frame: RawFrame,
    source: str | Path | None = None,
    baseline_exposure: float = 0.0,
    rgb: Tensor | None = None,
) -> None:
    """Write a frame as a DNG, whole or not at all; the inverse of :func:`rawaug.io.read_raw`.

    Args:
        path: the file, in a folder that exists.
        frame: its mosaic is rounded to digital numbers by its own levels; orientation, colour, noise profile, exposure
            and gain maps are written as tags; ``iso`` and ``exposure`` too, unless the source has EXIF.
        source: the RAW file that the frame was read from: its other metadata (a DNG's profiles, opcodes and crop;
            EXIF, GPS and XMP of any TIFF) is kept.
        baseline_exposure: stops by which a RAW developer should brighten; a DNG source's own value takes precedence.
        rgb: linear camera RGB ``(3, H, W)`` to write in place of the mosaic, as a linear DNG.

    Raises:
        ValueError: if a digital number or a level does not fit 16 bits, the mosaic's sides are not even, or a gain,
            the colour matrix or the orientation cannot be written.
        FileNotFoundError: if the source or the folder does not exist.
        OSError: if tags of the source are damaged.
    """
    path = Path(path)
    _require_colour(frame, path)
    numbers = digital_numbers(frame, path) if rgb is None else linear_numbers(frame, rgb, path)
    size = numbers.shape[0], numbers.shape[1]
    carried = read_carried_tags(Path(source), size) if source is not None else CarriedTags("<", {}, {})
    # write an Exif directory if the source has none
    directories = {"ExifTag": _exif(frame, carried.byte_order), **carried.directories}
    directories = {name: entries for name, entries in directories.items() if entries}
    own = _camera(frame) if DNG_VERSION in carried.tags else _camera(frame) | _color(frame, baseline_exposure)
    tags = own | carried.tags | {254: (LONG, 1, 0), 274: (SHORT, 1, _EXIF_ORIENTATIONS[frame.orientation])}
    if rgb is None:
        tags |= _tags_of_the_mosaic(frame)
    else:
        tags = {code: tag for code, tag in tags.items() if code not in _OF_MOSAICS} | _tags_of_full_colour(frame)
    extra_tags: list[tuple[Any, ...]] = [(code, *tag, True) for code, tag in sorted(tags.items())]
    extra_tags += [(name, LONG, 1, 0, True) for name in directories]
    with replacing(path) as partial:
        with tag_damage(Path(source)) if source is not None else nullcontext():
            _write(partial, numbers, carried.byte_order, extra_tags)
        for name, entries in directories.items():
            append_directory(partial, name, entries)


def _write(path: Path, numbers: np.ndarray, byte_order: str, tags: Sequence[tuple[Any, ...]]) -> None:
    with extra("raw"):
        import imagecodecs
        import tifffile

    height, width, *colours = numbers.shape
    # even and odd columns of a mosaic are components: their colours differ
    columns = np.ascontiguousarray(numbers) if colours else numbers.reshape(height, width // 2, 2)
    tifffile.imwrite(
        path,
        iter([imagecodecs.jpeg8_encode(columns, lossless=True, predictor=1, bitspersample=16)]),
        shape=numbers.shape,
        dtype=numbers.dtype,
        bitspersample=16,
        compression="jpeg",
        rowsperstrip=height,
        byteorder="<" if byte_order == "<" else ">",
        planarconfig="contig" if colours else None,
        photometric=LINEAR_PHOTOMETRIC if colours else CFA_PHOTOMETRIC,
        extratags=tags,
        software=f"rawaug {__version__}",
        metadata=None,
    )


def _require_colour(frame: RawFrame, path: Path) -> None:
    gains = (*frame.white_balance, *frame.daylight)
    if not all(math.isfinite(gain) and gain > 0 for gain in gains):
        raise ValueError(f"{path}: white balance and daylight gains must be positive, got {gains}")
    if not abs(float(torch.linalg.det(frame.color_matrix.double()))) > 1e-6:
        raise ValueError(f"{path}: the colour matrix is singular; a DNG needs its inverse")
    if frame.orientation not in _EXIF_ORIENTATIONS:
        raise ValueError(f"{path}: orientation must be a LibRaw flip from 0 to 7, got {frame.orientation}")


def digital_numbers(frame: RawFrame, path: Path) -> np.ndarray:
    """The mosaic as uint16 ``(H, W)``."""
    height, width = frame.mosaic.shape[-2:]
    if frame.mosaic.shape[0] != 1 or frame.mosaic.ndim != 3 or height % 2 or width % 2:
        raise ValueError(f"{path}: the mosaic must be (1, H, W) with even sides, got {tuple(frame.mosaic.shape)}")
    if not 0 <= min(frame.black) <= max(frame.black) < frame.white < _BEYOND_16_BITS:
        raise ValueError(f"{path}: levels must be 0 <= black < white <= 65535, got {frame.black} and {frame.white}")
    numbers = np.empty((height, width), np.uint16)
    cell = plane_indices(frame.cfa)
    for i, j in product(range(len(cell)), repeat=2):
        black, site = frame.black[cell[i, j]], (slice(i, None, len(cell)), slice(j, None, len(cell)))
        plane = frame.mosaic[0][site].double().mul_(frame.white - black).add_(black).round_()
        low, high = (extreme.item() for extreme in torch.aminmax(plane))
        if not (low >= 0 and high < _BEYOND_16_BITS):
            need = f"digital numbers from {low:g} to {high:g} at black {black:g}, white {frame.white:g}"
            raise ValueError(f"{path}: 16 bits cannot hold {need}; raise the black level, or clip the mosaic")
        numbers[site] = plane.numpy().astype(np.uint16)
    return numbers


def linear_numbers(frame: RawFrame, rgb: Tensor, path: Path) -> np.ndarray:
    """Linear RGB as uint16 ``(H, W, 3)``, black at 0 and white at 65535, clipped at both."""
    size = frame.mosaic.shape[-2:]
    if rgb.shape != (3, *size):
        raise ValueError(f"{path}: full colour of this frame is (3, {size[0]}, {size[1]}), got {tuple(rgb.shape)}")
    return (rgb.permute(1, 2, 0).clamp(0, 1) * LINEAR_WHITE).round().numpy().astype(np.uint16)


def _camera(frame: RawFrame) -> Tags:
    make, _, model = frame.camera.partition(" ")
    names = {271: make, 272: model or make, _UNIQUE_CAMERA_MODEL: frame.camera}
    # tifffile takes text of 7 bits; DNG has UTF-8 in its place
    return {code: (ASCII, 0, name if name.isascii() else name.encode()) for code, name in names.items()}


def _color(frame: RawFrame, baseline_exposure: float) -> Tags:
    """Tags that are only written if the source is not a DNG."""
    tags: Tags = {
        DNG_VERSION: (BYTE, 4, bytes((1, 4, 0, 0))),
        50707: (BYTE, 4, bytes((1, 3 if frame.gain_maps else 1, 0, 0))),
        50721: (SRATIONAL, 9, _rationals(xyz_to_camera(frame).ravel())),
        50728: (RATIONAL, 3, _rationals([1 / gain for gain in frame.white_balance])),
        50730: (SRATIONAL, 1, _rationals([baseline_exposure])),
        50778: (SHORT, 1, _D65),
        **_opcodes(OPCODE_LIST_2, [m for m in frame.gain_maps if m.on_mosaic]),
        **_opcodes(OPCODE_LIST_3, [m for m in frame.gain_maps if not m.on_mosaic]),
    }
    return tags | {306: (ASCII, 0, frame.exposure.date)} if frame.exposure.date else tags


def _opcodes(code: int, maps: Sequence[GainMap]) -> Tags:
    opcodes = opcode_list(maps)
    return {code: (UNDEFINED, len(opcodes), opcodes)} if maps else {}


def _tags_of_the_mosaic(frame: RawFrame) -> Tags:
    known, kinds = pattern(frame.cfa), plane_indices(frame.cfa).flatten().tolist()
    size = known.period
    repeats = size if size == 2 or len(set(frame.black)) > 1 else 1  # LibRaw states one level of X-Trans, if it is one
    levels = [frame.black[kind] for kind in kinds[: repeats**2]]
    tags: Tags = {
        33421: (SHORT, 2, (size, size)),
        33422: (BYTE, size**2, bytes("RGB".index(colour) for colour in "".join(known.rows))),
        50710: (BYTE, 3, bytes((0, 1, 2))),
        50711: (SHORT, 1, 1),
        50713: (SHORT, 2, (repeats, repeats)),
        50714: (RATIONAL, repeats**2, _rationals(levels, 2**14)),
        50717: (LONG, 1, round(frame.white)),
    }
    return tags | {51041: (DOUBLE, 2, frame.noise_profile)} if frame.noise_profile is not None else tags


_OF_MOSAICS = (50710, 50733, 50734, 50737, 50738, 51008, OPCODE_LIST_2)
"""Green split, Bayer's sharpness, antialias strength, and opcodes of what is before demosaicing."""


def _tags_of_full_colour(frame: RawFrame) -> Tags:
    """Levels by colour; shading maps of the mosaic's sites become maps of the planes."""
    maps = [m for found in frame.gain_maps if found.on_mosaic for m in of_planes(found, frame.cfa)]
    # LibRaw takes a black level of three colours for that of four, the last one 0, and develops 3 % too dark
    return {
        50713: (SHORT, 2, (1, 1)),
        50714: (RATIONAL, 3, _rationals((0, 0, 0))),
        50717: (LONG, 3, (LINEAR_WHITE,) * 3),
        **_opcodes(OPCODE_LIST_2, maps),
    }


def xyz_to_camera(frame: RawFrame) -> np.ndarray:
    """The DNG's ColorMatrix for D65, ``(3, 3)``."""
    balanced = np.linalg.inv(frame.color_matrix.double().numpy()) @ np.linalg.inv(XYZ_FROM_SRGB)
    return np.asarray(balanced / np.array(frame.daylight)[:, None])


def _exif(frame: RawFrame, byte_order: str) -> list[Entry]:
    """ISO and exposure as an EXIF directory, with the version of EXIF that it follows; empty where nothing is known."""
    shot = frame.exposure
    numbers = {33434: shot.seconds, 33437: shot.f_number, 37386: shot.focal_length}
    entries = [
        Entry(code, RATIONAL, 1, struct.pack(byte_order + "2I", *_rationals([value])))
        for code, value in numbers.items()
        if value is not None
    ]
    if frame.iso is not None:
        entries.append(Entry(34855, SHORT, 1, struct.pack(byte_order + "H", min(round(frame.iso), _LARGEST_ISO))))
        if frame.iso > _LARGEST_ISO:  # EXIF 2.3: the sensitivity is then the recommended exposure index
            entries.append(Entry(34864, SHORT, 1, struct.pack(byte_order + "H", 2)))
            entries.append(Entry(34866, LONG, 1, struct.pack(byte_order + "I", round(frame.iso))))
    if shot.date is not None:
        entries.append(Entry(36867, ASCII, len(shot.date) + 1, shot.date.encode() + b"\0"))
    return [*entries, Entry(36864, UNDEFINED, 4, b"0230")] if entries else []


def _rationals(values: Iterable[float], denominator: int = 10**6) -> tuple[int, ...]:
    """Numerators and denominators of 32 bits; large values get smaller denominators."""
    numbers = []
    for value in values:
        if not abs(value) <= _LARGEST:
            raise ValueError(f"{value:g} does not fit a DNG rational; check the frame's gains, matrix and exposure")
        fits = min(denominator, int(_LARGEST / max(abs(value), 1)))
        numbers += [round(value * fits), fits]
    return tuple(numbers)


_SUB_DIRECTORIES = {"ExifTag": 34665, "GPSTag": 34853}
_POINTERS = (37500, 40965)  # maker note, interoperability directory
_SIZES = (0, 1, 1, 2, 4, 8, 1, 1, 2, 4, 8, 4, 8)
"""Bytes of a value of the TIFF types 0 to 12."""
_VALUE = 8
"""Offset within an entry of its value, or of the pointer to it."""

_OF_ANY_TIFF = (270, 271, 272, 306, 315, 700, 33432)
_LAYOUT = (
    *(*range(254, 260), 262, 266, 273, 277, 278, 279, 282, 283, 284, 296, 297, 317),
    *(*range(320, 326), 330, 338, 339),
)
_PREVIEW = (*range(512, 522), *range(529, 533), *range(50966, 50972))
_LEVELS = (33421, 33422, 50711, 50712, *range(50713, 50718), 50829, 50830, 51041)
_DIGESTS = (50781, 50828, 50972, 50973, 51111, 51114)
_REPLACED = (274, 305, 347, 37500, *_SUB_DIRECTORIES.values())
_DROPPED = frozenset((*_LAYOUT, *_PREVIEW, *_LEVELS, *_DIGESTS, *_REPLACED))
_CROP = (50718, 50719, 50720, 51125)

Tags = dict[int, tuple[int, int, Any]]
"""Type, count and value by code; tifffile counts text itself."""


class Entry(NamedTuple):
    """One value of a directory, its bytes in the file's order."""

    code: int
    dtype: int
    values: int
    data: bytes


class CarriedTags(NamedTuple):
    """Of a source: its byte order (``<`` or ``>``), the tags of the picture, and its sub-directories by name."""

    byte_order: str
    tags: Tags
    directories: dict[str, list[Entry]]


def read_carried_tags(path: Path, size: tuple[int, int]) -> CarriedTags:
    """What is kept of ``path`` for a mosaic of ``size`` (height, width); nothing if it is not a TIFF."""
    # a DNG gives all tags of its first directory and of the mosaic's; the private tags of other TIFFs (NEF, CR2, ARW)
    # mean something else, so that they give their description, author, XMP, EXIF and GPS
    with extra("raw"):
        import tifffile

    try:
        with opened_tiff(path) as tiff, path.open("rb") as file:
            pages = all_pages(tiff)
            first = pages[0].tags
            dng = any(DNG_VERSION in page.tags for page in pages)
            mosaics = [mosaic] if dng and (mosaic := main_mosaic(pages)) is not None else []
            tags: Tags = {}
            for page in (pages[0], *mosaics):
                kept = [tag for tag in page.tags if (tag.code not in _DROPPED if dng else tag.code in _OF_ANY_TIFF)]
                tags |= {tag.code: (int(tag.dtype), tag.count, _value(tag)) for tag in kept}
            if mosaics and not _fills_active_area(mosaics[0], size):
                tags = {code: tag for code, tag in tags.items() if code not in _CROP}
            order = tiff.byteorder
            pointers = {name: first[code].offset + _VALUE for name, code in _SUB_DIRECTORIES.items() if code in first}
            return CarriedTags(order, tags, {name: _read(file, order, at) for name, at in pointers.items()})
    except tifffile.TiffFileError:
        return CarriedTags("<", {}, {})


def _value(tag: Any) -> Any:
    """Text as tifffile writes it: 7 bits; other texts as the bytes that they are in UTF-8."""
    if tag.dtype == ASCII and isinstance(tag.value, str) and not tag.value.isascii():
        return tag.value.encode() + b"\0"
    return tag.value


def _fills_active_area(mosaic: Any, size: tuple[int, int]) -> bool:
    area = mosaic.tags.valueof(ACTIVE_AREA) or (0, 0, mosaic.imagelength, mosaic.imagewidth)
    return bool((area[2] - area[0], area[3] - area[1]) == size)


def _read(file: BinaryIO, order: str, pointer: int) -> list[Entry]:
    """The directory whose offset is stored at ``pointer``."""
    (start,) = _unpack(file, order + "I", pointer)
    (count,) = _unpack(file, order + "H", start)
    entries, left = [], file.seek(0, SEEK_END)
    for place in range(start + 2, start + 2 + 12 * count, 12):
        code, dtype, values = _unpack(file, order + "HHI", place)
        if code in _POINTERS or not 0 < dtype < len(_SIZES):
            continue
        size = _SIZES[dtype] * values
        left -= size
        if left < 0:
            raise ValueError(f"values of tag {code} and others are larger than the file")
        file.seek(place + 8 if size <= 4 else _unpack(file, order + "I", place + 8)[0])
        entries.append(Entry(code, dtype, values, file.read(size)))
    return entries


def _unpack(file: BinaryIO, form: str, place: int) -> tuple[Any, ...]:
    file.seek(place)
    return struct.unpack(form, file.read(struct.calcsize(form)))


def append_directory(path: Path, name: str, entries: list[Entry]) -> None:
    """Write a sub-directory behind a TIFF, in whose first directory the tag ``name`` comes to point at it."""
    with path.open("r+b") as file:
        order = "<" if file.read(2) == b"II" else ">"
        end = file.seek(0, SEEK_END)
        start = end + end % 2
        beyond = start + 2 + 12 * len(entries) + 4
        table, values = struct.pack(order + "H", len(entries)), b""
        for entry in sorted(entries, key=lambda entry: entry.code):
            inside = len(entry.data) <= 4
            place = entry.data.ljust(4, b"\0") if inside else struct.pack(order + "I", beyond + len(values))
            table += struct.pack(order + "HHI", entry.code, entry.dtype, entry.values) + place
            values += b"" if inside else entry.data + bytes(len(entry.data) % 2)
        file.seek(start)
        file.write(table + bytes(4) + values)
        file.seek(_pointer(file, order, _SUB_DIRECTORIES[name]))
        file.write(struct.pack(order + "I", start))


def _pointer(file: BinaryIO, order: str, code: int) -> int:
    """Offset of the value of tag ``code`` in the first directory."""
    (first,) = _unpack(file, order + "I", 4)
    (count,) = _unpack(file, order + "H", first)
    places = range(first + 2, first + 2 + 12 * count, 12)
    return next(place + _VALUE for place in places if _unpack(file, order + "H", place) == (code,))
