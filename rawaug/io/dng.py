r"""Bayer mosaics out, as DNG: ``d = round(y (white - black) + black)``, 16 bits a site, uncompressed.

``AsShotNeutral`` is the colour of grey to the camera, ``1 / white_balance``. ``ColorMatrix1`` takes XYZ to the camera
under D65, ``X = diag(1 / daylight) M^-1 S^-1``, from the frame's ``color_matrix`` M (white-balanced camera to linear
sRGB) and S, which takes linear sRGB to XYZ: what :func:`rawaug.io.read_raw` makes M of, the other way round.
Source: DNG specification 1.4, chapters 4 to 6. Any program that reads DNG takes it from there.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import torch

from rawaug._version import __version__
from rawaug.bayer import CFA
from rawaug.extras import extra
from rawaug.files import replacing
from rawaug.io.carried_tags import CarriedTags, Entry, Tag, append_directory, read_carried_tags
from rawaug.io.gain_map import opcode_list
from rawaug.io.raw import XYZ_FROM_SRGB, RawFrame
from rawaug.io.tiff_tags import damage_as_os_error

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
_BEYOND_16_BITS = 65535.5
_LARGEST = 2.0**31 - 2
_LARGEST_ISO = 65535
_CFA_PHOTOMETRIC = 32803
_DNG_VERSION, _UNIQUE_CAMERA_MODEL = 50706, 50708
_D65 = 21
_EXIF_ORIENTATIONS = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}
"""By LibRaw's flip."""


def write_dng(
    path: str | Path, frame: RawFrame, source: str | Path | None = None, baseline_exposure: float = 0.0
) -> None:
    """Write a frame as a DNG, whole or not at all; the inverse of :func:`rawaug.io.read_raw`.

    Args:
        path: the file, in a folder that exists.
        frame: its mosaic is rounded to digital numbers by its own levels; orientation, colour, noise profile, exposure
            and gain maps are written as tags; ``iso`` and ``exposure`` too, unless the source has EXIF.
        source: the RAW file that the frame was read from: its other metadata (a DNG's profiles, opcodes and crop;
            EXIF, GPS and XMP of any TIFF) is kept.
        baseline_exposure: stops by which a RAW developer should brighten; a DNG source's own value takes precedence.

    Raises:
        ValueError: if a digital number or a level does not fit 16 bits, the mosaic's sides are not even, or a gain,
            the colour matrix or the orientation cannot be written.
        FileNotFoundError: if the source or the folder does not exist.
        OSError: if tags of the source are damaged.

    Example:
        >>> frame = read_raw("shot.cr2")  # doctest: +SKIP
        >>> write_dng("shot.dng", frame, source="shot.cr2")  # doctest: +SKIP
    """
    path = Path(path)
    _require_colour(frame, path)
    numbers = digital_numbers(frame, path)
    size = numbers.shape[0], numbers.shape[1]
    carried = read_carried_tags(Path(source), size) if source is not None else CarriedTags("<", {}, {})
    # write an Exif directory if the source has none
    directories = {"ExifTag": _exif(frame, carried.byte_order), **carried.directories}
    directories = {name: entries for name, entries in directories.items() if entries}
    own = _camera(frame) if _DNG_VERSION in carried.tags else _camera(frame) | _color(frame, baseline_exposure)
    tags = own | carried.tags | _tags_of_the_pixels(frame)
    pointers: list[Tag] = [(name, LONG, 1, 0, True) for name in directories]
    with replacing(path) as partial:
        with damage_as_os_error(Path(source)) if source is not None else nullcontext():
            _write(partial, numbers, carried.byte_order, [*(tags[code] for code in sorted(tags)), *pointers])
        for name, entries in directories.items():
            append_directory(partial, name, entries)


def _write(path: Path, numbers: np.ndarray, byte_order: str, tags: Sequence[Tag]) -> None:
    with extra("raw"):
        import tifffile

    software = f"rawaug {__version__}"
    tifffile.imwrite(
        path,
        numbers,
        byteorder="<" if byte_order == "<" else ">",
        photometric=_CFA_PHOTOMETRIC,
        extratags=tags,
        software=software,
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
    """The mosaic as uint16 ``(H, W)``.

    Raises:
        ValueError: see :func:`write_dng`.
    """
    height, width = frame.mosaic.shape[-2:]
    if frame.mosaic.shape[0] != 1 or frame.mosaic.ndim != 3 or height % 2 or width % 2:
        raise ValueError(f"{path}: the mosaic must be (1, H, W) with even sides, got {tuple(frame.mosaic.shape)}")
    if not 0 <= min(frame.black) <= max(frame.black) < frame.white < _BEYOND_16_BITS:
        raise ValueError(
            f"{path}: levels must satisfy 0 <= black < white <= 65535, got {frame.black} and {frame.white}"
        )
    numbers = np.empty((height, width), np.uint16)
    for (i, j), black in zip(CFA(frame.cfa).sites, frame.black, strict=True):
        plane = frame.mosaic[0, i::2, j::2].double().mul_(frame.white - black).add_(black).round_()
        low, high = (extreme.item() for extreme in torch.aminmax(plane))
        if not (low >= 0 and high < _BEYOND_16_BITS):
            need = f"digital numbers from {low:g} to {high:g} at black {black:g}, white {frame.white:g}"
            raise ValueError(f"{path}: 16 bits cannot hold {need}; raise the black level, or clip the mosaic")
        numbers[i::2, j::2] = plane.numpy().astype(np.uint16)
    return numbers


def _camera(frame: RawFrame) -> dict[int, Tag]:
    make, _, model = frame.camera.partition(" ")
    names = {271: make, 272: model or make, _UNIQUE_CAMERA_MODEL: frame.camera}
    # tifffile takes text of 7 bits; DNG has UTF-8 in its place
    return {code: (code, ASCII, 0, name if name.isascii() else name.encode(), True) for code, name in names.items()}


def _color(frame: RawFrame, baseline_exposure: float) -> dict[int, Tag]:
    """Tags that a DNG source has itself, or lacks on purpose."""
    tags: list[Tag] = [
        (_DNG_VERSION, BYTE, 4, bytes((1, 4, 0, 0)), True),
        (50707, BYTE, 4, bytes((1, 3 if frame.gain_maps else 1, 0, 0)), True),
        (50721, SRATIONAL, 9, _rationals(xyz_to_camera(frame).ravel()), True),
        (50728, RATIONAL, 3, _rationals([1 / gain for gain in frame.white_balance]), True),
        (50730, SRATIONAL, 1, _rationals([baseline_exposure]), True),
        (50778, SHORT, 1, _D65, True),
    ]
    for code, on_mosaic in ((51009, True), (51022, False)):
        maps = [m for m in frame.gain_maps if m.on_mosaic == on_mosaic]
        if maps:
            opcodes = opcode_list(maps)
            tags.append((code, UNDEFINED, len(opcodes), opcodes, True))
    if frame.exposure.date:
        tags.append((306, ASCII, 0, frame.exposure.date, True))
    return _by_code(tags)


def _tags_of_the_pixels(frame: RawFrame) -> dict[int, Tag]:
    levels = [frame.black[CFA(frame.cfa).sites.index((i, j))] for i in (0, 1) for j in (0, 1)]
    tags: list[Tag] = [
        (254, LONG, 1, 0, True),
        (274, SHORT, 1, _EXIF_ORIENTATIONS[frame.orientation], True),
        (33421, SHORT, 2, (2, 2), True),
        (33422, BYTE, 4, bytes("RGB".index(colour) for colour in CFA(frame.cfa).value), True),
        (50710, BYTE, 3, bytes((0, 1, 2)), True),
        (50711, SHORT, 1, 1, True),
        (50713, SHORT, 2, (2, 2), True),
        (50714, RATIONAL, 4, _rationals(levels, 2**14), True),
        (50717, LONG, 1, round(frame.white), True),
    ]
    if frame.noise_profile is not None:
        tags.append((51041, DOUBLE, 2, frame.noise_profile, True))
    return _by_code(tags)


def _by_code(tags: Iterable[Tag]) -> dict[int, Tag]:
    return {tag[0]: tag for tag in tags}


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
    """Numerators and denominators of 32 bits: what is large has a smaller denominator."""
    numbers = []
    for value in values:
        if not abs(value) <= _LARGEST:
            raise ValueError(f"{value:g} does not fit a DNG rational; check the frame's gains, matrix and exposure")
        fits = min(denominator, int(_LARGEST / max(abs(value), 1)))
        numbers += [round(value * fits), fits]
    return tuple(numbers)
