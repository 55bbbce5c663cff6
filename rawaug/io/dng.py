r"""Writing of mosaics and linear RGB as DNG: ``d = round(y (white - black) + black)``, 16 bits a site or sample.

A frame of floating-point numbers is written as such: y itself, with black at 0 and white at 1, in 32 bits that are
neither rounded nor compressed.

``AsShotNeutral`` is the colour of grey to the camera, ``1 / white_balance``. ``ColorMatrix1`` takes XYZ to the camera
under D65, ``X = diag(1 / daylight) M^-1 S^-1``, from the frame's ``color_matrix`` M (white-balanced camera to linear
sRGB) and S, which takes linear sRGB to XYZ: the inverse of what :func:`rawaug.io.read_raw` does.

A rewritten DNG keeps camera, colour, lens corrections, EXIF, GPS, XMP and previews of its source
(:mod:`rawaug.io.carried`). The mosaic is in the first directory, and the previews are in its sub-directories.

Pixels are compressed as lossless JPEG, which stores the difference to the left neighbour of the same colour in
Huffman's code, to about half (14 bits) or a third (10 bits) of their size. (LibRaw reads no integers compressed by
deflate.) Their MD5 is also written, so that a damaged file can be recognised. Source: DNG specification 1.4, chapters 3
to 6; TIFF 6.0, section 2; ITU-T T.81, annex H.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from itertools import product
from os import SEEK_END
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import pattern, plane_indices
from rawaug.errors import extra
from rawaug.files import replacing
from rawaug.io.carried import (
    ASCII,
    BYTE,
    DOUBLE,
    LONG,
    RATIONAL,
    SHORT,
    SRATIONAL,
    SUB_DIRECTORIES,
    UNDEFINED,
    Carried,
    Preview,
    Tags,
    read_carried,
)
from rawaug.io.cells import MONOCHROME
from rawaug.io.damage import tiled_digest
from rawaug.io.directories import INTEROPERABILITY, Tag, TiffFile, pack_directory, pointer_tag
from rawaug.io.gain_map import GainMap, of_planes, opcode_list
from rawaug.io.opcodes import OPCODE_LIST_1, OPCODE_LIST_2, OPCODE_LIST_3
from rawaug.io.raw import XYZ_FROM_SRGB, RawFrame
from rawaug.io.tiff import CFA_PHOTOMETRIC, DNG_VERSION, LINEAR_PHOTOMETRIC, tag_damage
from rawaug.version import __version__

LINEAR_WHITE = 65535
"""White has this digital number in a linear DNG, whose black is 0."""

_BEYOND_16_BITS = 65535.5
_LARGEST = 2.0**31 - 2
_LARGEST_ISO = 65535
_D65 = 21
_GREY = 1
_EXIF_ORIENTATIONS = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}
"""This maps LibRaw's flip to an EXIF orientation."""

_SUBFILE_TYPE, _ORIENTATION, _PHOTOMETRIC, _SUB_IFDS = 254, 274, 262, 330
_BACKWARD_VERSION, _UNIQUE_CAMERA_MODEL = 50707, 50708
_CROP_ORIGIN, _CROP_SIZE = 50719, 50720
_COLOR_MATRIX, _AS_SHOT_NEUTRAL, _ILLUMINANT = 50721, 50728, 50778
_NOISE_PROFILE, _NEW_RAW_DIGEST = 51041, 51111
_OF_MOSAICS = (50710, 50733, 50734, 50737, 50738, OPCODE_LIST_1, OPCODE_LIST_2)
"""These are green split, Bayer's sharpness, antialias strength, and opcodes for before demosaicing."""

_PADDING = 2
"""Adobe's programs want this many sites around the default crop for demosaicing."""


def write_dng(
    path: str | Path,
    frame: RawFrame,
    source: str | Path | None = None,
    baseline_exposure: float = 0.0,
    rgb: Tensor | None = None,
) -> None:
    """Write a frame as a DNG, completely or not at all; this is the inverse of :func:`rawaug.io.read_raw`.

    Args:
        path: the file, in a folder that exists.
        frame: the frame. Its mosaic is rounded to digital numbers by its own levels; orientation, colour, noise
            profile, exposure and gain maps are written as tags, and so are ``iso`` and ``exposure`` unless the source
            has EXIF.
        source: the RAW file that the frame was read from. Its other metadata (a DNG's profiles, opcodes and crop; EXIF,
            GPS and XMP of any TIFF) and its previews are kept.
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

    # The pixels, and what they mean.
    photometric = _GREY if frame.cfa == MONOCHROME else CFA_PHOTOMETRIC
    if rgb is not None:
        photometric = LINEAR_PHOTOMETRIC
        numbers = linear_numbers(frame, rgb, path)
    elif frame.floating:
        numbers = floating_numbers(frame, path)
    else:
        numbers = digital_numbers(frame, path)

    # The tags and directories, those of the source first.
    carried = Carried()
    if source is not None:
        carried = read_carried(Path(source), (numbers.shape[0], numbers.shape[1]), frame.offset)

    directories = dict(carried.directories)
    if "ExifTag" not in directories:
        directories["ExifTag"] = _exif(frame, carried.byte_order)
    directories = {name: entries for name, entries in directories.items() if entries}

    tags = _tags(frame, photometric, numbers, carried, baseline_exposure)
    extra_tags: list[tuple[Any, ...]] = [(code, *tag, True) for code, tag in sorted(tags.items())]
    extra_tags += [(name, LONG, 1, 0, True) for name in directories]

    with replacing(path) as partial:
        with tag_damage(Path(source)) if source is not None else nullcontext():
            _write_pixels(partial, numbers, photometric, carried, extra_tags)
        _append_directories(partial, directories, carried)


def _tags(frame: RawFrame, photometric: int, numbers: np.ndarray, carried: Carried, baseline_exposure: float) -> Tags:
    make, _, model = frame.camera.partition(" ")
    tags: Tags = {}
    for code, name in ((271, make), (272, model or make), (_UNIQUE_CAMERA_MODEL, frame.camera)):
        # tifffile takes text of 7 bits, whereas DNG allows UTF-8
        tags[code] = (ASCII, 0, name if name.isascii() else name.encode())

    # What a source that is a DNG states itself.
    if DNG_VERSION not in carried.tags:
        needed = 3 if frame.gain_maps else 1
        tags[DNG_VERSION] = (BYTE, 4, bytes((1, 4, 0, 0)))
        tags[_BACKWARD_VERSION] = (BYTE, 4, bytes((1, needed, 0, 0)))
        tags[50730] = (SRATIONAL, 1, _rationals([baseline_exposure]))
        tags |= _opcodes(OPCODE_LIST_2, [m for m in frame.gain_maps if m.on_mosaic])
        tags |= _opcodes(OPCODE_LIST_3, [m for m in frame.gain_maps if not m.on_mosaic])
        if frame.exposure.date:
            tags[306] = (ASCII, 0, frame.exposure.date)
        if photometric != _GREY:
            tags[_COLOR_MATRIX] = (SRATIONAL, 9, _rationals(xyz_to_camera(frame).ravel()))
            tags[_AS_SHOT_NEUTRAL] = (RATIONAL, 3, _rationals([1 / gain for gain in frame.white_balance]))
            tags[_ILLUMINANT] = (SHORT, 1, _D65)

    # What describes the new pixels.
    tags |= carried.tags
    tags[_SUBFILE_TYPE] = (LONG, 1, 0)
    tags[_ORIENTATION] = (SHORT, 1, _EXIF_ORIENTATIONS[frame.orientation])
    tags |= _crop(frame, *numbers.shape[:2])
    if numbers.ndim == 2 and numbers.dtype == np.uint16:
        tags[_NEW_RAW_DIGEST] = (BYTE, 16, tiled_digest(numbers))
    if photometric == CFA_PHOTOMETRIC:
        return tags | _mosaic_levels(frame)

    for code in _OF_MOSAICS:
        tags.pop(code, None)
    if photometric == LINEAR_PHOTOMETRIC:
        return tags | _full_colour_levels(frame)
    return tags | _mosaic_levels(frame)


def _crop(frame: RawFrame, height: int, width: int) -> Tags:
    """Make the default crop: the frame's, or all but the sites that demosaicing needs around it."""
    if frame.crop is not None and frame.crop[0] + frame.crop[2] <= height and frame.crop[1] + frame.crop[3] <= width:
        top, left, rows, columns = frame.crop
    elif min(height, width) > 4 * _PADDING:
        top, left, rows, columns = _PADDING, _PADDING, height - 2 * _PADDING, width - 2 * _PADDING
    else:
        return {}

    crop = (left, top, columns, rows)
    if all(float(number).is_integer() for number in crop):
        left, top, columns, rows = map(int, crop)
        return {_CROP_ORIGIN: (LONG, 2, (left, top)), _CROP_SIZE: (LONG, 2, (columns, rows))}
    return {
        _CROP_ORIGIN: (RATIONAL, 2, _rationals((left, top), 10**4)),
        _CROP_SIZE: (RATIONAL, 2, _rationals((columns, rows), 10**4)),
    }


def _write_pixels(
    path: Path, numbers: np.ndarray, photometric: int, carried: Carried, tags: Sequence[tuple[Any, ...]]
) -> None:
    with extra("raw"):
        import imagecodecs
        import tifffile

    height, width, *colours = numbers.shape
    if colours:
        columns = np.ascontiguousarray(numbers)
        planes = "contig"
    else:
        # even and odd columns of a mosaic are components, as their colours differ
        columns = numbers.reshape(height, width // 2, 2)
        planes = None

    pixels: dict[str, Any] = {"data": np.ascontiguousarray(numbers)}
    if numbers.dtype == np.uint16:
        stream = imagecodecs.jpeg8_encode(columns, lossless=True, predictor=1, bitspersample=16)
        pixels = {"data": iter([stream]), "bitspersample": 16, "compression": "jpeg"}
        pixels |= {"shape": numbers.shape, "dtype": numbers.dtype}

    with tifffile.TiffWriter(path, byteorder="<" if carried.byte_order == "<" else ">") as tiff:
        tiff.write(
            **pixels,
            rowsperstrip=height,
            planarconfig=planes,
            photometric=photometric,
            extratags=tags,
            subifds=len(carried.previews) or None,
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


# -- digital numbers ---------------------------------------------------------------------------------------------------


def digital_numbers(frame: RawFrame, path: Path) -> np.ndarray:
    """Convert the mosaic to uint16 ``(H, W)``."""
    height, width = _require_mosaic(frame, path)
    if not 0 <= min(frame.black) <= max(frame.black) < frame.white < _BEYOND_16_BITS:
        raise ValueError(f"{path}: levels must be 0 <= black < white <= 65535, got {frame.black} and {frame.white}")

    numbers = np.empty((height, width), np.uint16)
    cell = cell_of_planes(frame.cfa)
    size = len(cell)
    for i, j in product(range(size), repeat=2):
        black = frame.black[cell[i, j]]
        site = (slice(i, None, size), slice(j, None, size))
        plane = frame.mosaic[0][site].double().mul_(frame.white - black).add_(black).round_()

        low, high = (extreme.item() for extreme in torch.aminmax(plane))
        if not (low >= 0 and high < _BEYOND_16_BITS):
            need = f"digital numbers from {low:g} to {high:g} at black {black:g}, white {frame.white:g}"
            raise ValueError(f"{path}: 16 bits cannot hold {need}; raise the black level, or clip the mosaic")
        numbers[site] = plane.numpy().astype(np.uint16)
    return numbers


def floating_numbers(frame: RawFrame, path: Path) -> np.ndarray:
    """Convert the mosaic to float32 ``(H, W)``, with black at 0 and white at 1."""
    _require_mosaic(frame, path)
    return np.ascontiguousarray(frame.mosaic[0].numpy(), np.float32)


def _require_mosaic(frame: RawFrame, path: Path) -> tuple[int, int]:
    height, width = frame.mosaic.shape[-2:]
    if frame.mosaic.shape[0] != 1 or frame.mosaic.ndim != 3 or height % 2 or width % 2:
        raise ValueError(f"{path}: the mosaic must be (1, H, W) with even sides, got {tuple(frame.mosaic.shape)}")
    return height, width


def cell_of_planes(cfa: str) -> Tensor:
    """Give, for the sites of a pattern's cell, the indices ``(n, n)`` into a frame's ``black``."""
    if cfa == MONOCHROME:
        return torch.zeros(1, 1, dtype=torch.long)
    return plane_indices(cfa)


def linear_numbers(frame: RawFrame, rgb: Tensor, path: Path) -> np.ndarray:
    """Convert linear RGB to uint16 ``(H, W, 3)``, with black at 0 and white at 65535, clipped at both.

    That of a floating-point frame becomes float32 with white at 1, clipped at white.
    """
    size = frame.mosaic.shape[-2:]
    if rgb.shape != (3, *size):
        raise ValueError(f"{path}: full colour of this frame is (3, {size[0]}, {size[1]}), got {tuple(rgb.shape)}")
    if frame.floating:
        return rgb.permute(1, 2, 0).clamp(max=1).contiguous().numpy()
    return (rgb.permute(1, 2, 0).clamp(0, 1) * LINEAR_WHITE).round().numpy().astype(np.uint16)


# -- tags --------------------------------------------------------------------------------------------------------------


def _opcodes(code: int, maps: Sequence[GainMap]) -> Tags:
    if not maps:
        return {}
    opcodes = opcode_list(maps)
    return {code: (UNDEFINED, len(opcodes), opcodes)}


def _mosaic_levels(frame: RawFrame) -> Tags:
    """Make the pattern, the levels and the noise of a mosaic, or of the one plane of a monochrome picture."""
    tags: Tags = {}
    repeats, black = 1, [frame.black[0]]
    if frame.cfa != MONOCHROME:
        cell = pattern(frame.cfa)
        size = cell.period
        colours = bytes("RGB".index(colour) for colour in "".join(cell.rows))
        tags[33421] = (SHORT, 2, (size, size))
        tags[33422] = (BYTE, size**2, colours)
        tags[50710] = (BYTE, 3, bytes((0, 1, 2)))
        tags[50711] = (SHORT, 1, 1)

        # LibRaw states one level of X-Trans if there is only one
        repeats = size if size == 2 or len(set(frame.black)) > 1 else 1
        sites = plane_indices(frame.cfa).flatten().tolist()
        black = [frame.black[site] for site in sites[: repeats**2]]

    white = round(frame.white)
    if frame.floating:
        black, white = [0.0] * len(black), 1
        tags[_BACKWARD_VERSION] = (BYTE, 4, bytes((1, 4, 0, 0)))

    tags[50713] = (SHORT, 2, (repeats, repeats))
    tags[50714] = (RATIONAL, len(black), _rationals(black, 10**6 if frame.floating else 2**14))
    tags[50717] = (LONG, 1, white)
    if frame.noise_profile is not None:
        tags[_NOISE_PROFILE] = (DOUBLE, 2, frame.noise_profile)
    return tags


def _full_colour_levels(frame: RawFrame) -> Tags:
    """Make the levels by colour; shading maps of the mosaic's sites become maps of the planes."""
    maps = []
    for gain_map in frame.gain_maps:
        if gain_map.on_mosaic:
            maps += of_planes(gain_map, frame.cfa)
    # LibRaw takes a black level of three colours for that of four, the last one 0, and develops 3 % too dark
    return {
        50713: (SHORT, 2, (1, 1)),
        50714: (RATIONAL, 3, _rationals((0, 0, 0))),
        50717: (LONG, 3, (1 if frame.floating else LINEAR_WHITE,) * 3),
        **_opcodes(OPCODE_LIST_2, maps),
    }


def xyz_to_camera(frame: RawFrame) -> np.ndarray:
    """Compute the DNG's ColorMatrix for D65, ``(3, 3)``."""
    balanced = np.linalg.inv(frame.color_matrix.double().numpy()) @ np.linalg.inv(XYZ_FROM_SRGB)
    return np.asarray(balanced / np.array(frame.daylight)[:, None])


def _exif(frame: RawFrame, byte_order: str) -> list[Tag]:
    """Make an EXIF directory of ISO, exposure and the version of EXIF; it is empty if nothing is known."""
    shot = frame.exposure
    entries = []
    for code, value in ((33434, shot.seconds), (33437, shot.f_number), (37386, shot.focal_length)):
        if value is not None:
            entries.append(Tag(code, RATIONAL, 1, struct.pack(byte_order + "2I", *_rationals([value]))))

    if frame.iso is not None:
        entries.append(Tag(34855, SHORT, 1, struct.pack(byte_order + "H", min(round(frame.iso), _LARGEST_ISO))))
        if frame.iso > _LARGEST_ISO:  # EXIF 2.3: the sensitivity is then the recommended exposure index
            entries.append(Tag(34864, SHORT, 1, struct.pack(byte_order + "H", 2)))
            entries.append(Tag(34866, LONG, 1, struct.pack(byte_order + "I", round(frame.iso))))

    if shot.date is not None:
        entries.append(Tag(36867, ASCII, len(shot.date) + 1, shot.date.encode() + b"\0"))
    if entries:
        entries.append(Tag(36864, UNDEFINED, 4, b"0230"))
    return entries


def _rationals(values: Iterable[float], denominator: int = 10**6) -> tuple[int, ...]:
    """Convert to numerators and denominators of 32 bits; large values get smaller denominators."""
    numbers = []
    for value in values:
        if not abs(value) <= _LARGEST:
            raise ValueError(f"{value:g} does not fit a DNG rational; check the frame's gains, matrix and exposure")
        fits = min(denominator, int(_LARGEST / max(abs(value), 1)))
        numbers += [round(value * fits), fits]
    return tuple(numbers)


# -- directories -------------------------------------------------------------------------------------------------------


def _append_directories(path: Path, directories: dict[str, list[Tag]], carried: Carried) -> None:
    """Write sub-directories and previews after the pixels, and let the first directory point at them."""
    with path.open("r+b") as file:
        tiff = TiffFile(file)
        first = tiff.directory(tiff.first).entries
        pointers: dict[int, list[int]] = {}
        for name, entries in directories.items():
            if name == "ExifTag" and carried.interoperability:
                offset = _append_directory(file, tiff.order, carried.interoperability)
                entries = [*entries, pointer_tag(tiff.order, INTEROPERABILITY, offset)]
            pointers[SUB_DIRECTORIES[name]] = [_append_directory(file, tiff.order, entries)]
        if carried.previews:
            pointers[_SUB_IFDS] = [_append_preview(file, tiff.order, preview) for preview in carried.previews]

        # The first directory has room for the places.
        for code, places in pointers.items():
            file.seek(first[code].offset)
            file.write(struct.pack(f"{tiff.order}{len(places)}I", *places))
        if tiff.numbers(first[_PHOTOMETRIC]) == (_GREY,):  # tifffile writes linear RAW only of three planes
            file.seek(first[_PHOTOMETRIC].offset)
            file.write(struct.pack(tiff.order + "H", LINEAR_PHOTOMETRIC))


def _append_directory(file: BinaryIO, order: str, entries: Sequence[Tag]) -> int:
    """Write a directory at the end of a file and return its place."""
    offset = _even_end(file)
    file.write(pack_directory(order, entries, offset))
    return offset


def _append_preview(file: BinaryIO, order: str, preview: Preview) -> int:
    places = []
    for segment in preview.segments:
        places.append(_even_end(file))
        file.write(segment)

    entries = [entry for entry in preview.entries if entry.code != _SUBFILE_TYPE]
    entries.append(Tag(_SUBFILE_TYPE, LONG, 1, struct.pack(order + "I", 1)))
    lengths = [len(segment) for segment in preview.segments]
    for code, numbers in zip(preview.codes, (places, lengths), strict=True):
        entries.append(Tag(code, LONG, len(numbers), struct.pack(f"{order}{len(numbers)}I", *numbers)))
    return _append_directory(file, order, entries)


def _even_end(file: BinaryIO) -> int:
    """Go to the end of a file, which is made even, and return its place."""
    end = file.seek(0, SEEK_END)
    if end % 2:
        end += file.write(b"\0")
    return end
