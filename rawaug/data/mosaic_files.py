r"""One mosaic from a camera RAW, NPZ, TIFF, 16-bit PNG or MATLAB file, with what the file states about its sensor.

    y = (d - black) / (white - black)

for a digital number d, which may not exceed white (but in camera RAW, which :func:`rawaug.io.read_raw` reads). What a
file does not state (CFA, levels) must be given; what it states cannot be overridden. Floating point without levels
holds y itself.

======  =============================================  ===============================================================
file    numbers                                        statements
======  =============================================  ===============================================================
RAW     as LibRaw reads them                           all, by their tags
npz     the array ``noisy`` or ``clean``, or the only  arrays ``cfa``, ``black``, ``white``, ``white_balance``,
        one; packed ``(4, h, w)`` or ``(H, W)``        ``color_matrix``, ``shot_var``, ``read_var``
mat     the same, of version 5 or 7.3                  variables of these names
tiff    the first page                                 its description, as JSON with these keys
png     16 bits, one channel                           none
======  =============================================  ===============================================================
"""

from __future__ import annotations

import json
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.folders import RAW_EXTENSIONS
from rawaug.data.mat import MAX_BYTES, read_array, read_value, variables
from rawaug.data.mosaic_metadata import KINDS, Statements, levels, shown
from rawaug.errors import extra
from rawaug.io import read_raw
from rawaug.io.apart import apart
from rawaug.io.pictures import MAX_PIXELS, read_plane
from rawaug.io.tiff import opened_tiff

ARRAYS = (".npz", ".tif", ".tiff", ".png", ".mat")
READABLE = (*RAW_EXTENSIONS, *ARRAYS)
TWO_IN_ONE = (".npz", ".mat")
"""Files that may hold both mosaics of a pair."""

_UNREADABLE = (
    *(ArithmeticError, AttributeError, EOFError, LookupError, MemoryError, OSError, RuntimeError, TypeError),
    *(SyntaxError, ValueError, struct.error, tokenize.TokenError, zipfile.BadZipFile, zlib.error),
)


class Mosaic(NamedTuple):
    """A mosaic float32 ``(1, H, W)``, sides even (of an odd side the last line is left out), and its sensor.

    Args:
        white_balance, color_matrix: as in :class:`rawaug.data.Pair`; None where the file does not state them.
        levels: (shot_var, read_var), None if not stated.
    """

    raw: Tensor
    cfa: CFA
    white_balance: tuple[float, float, float] | None
    color_matrix: Tensor | None
    levels: tuple[float, float] | None
    camera: str = "unknown"
    iso: float | None = None


def read_mosaic(file: Path, which: str, given: Statements, alone: bool = False, max_pixels: int = MAX_PIXELS) -> Mosaic:
    """Read a mosaic.

    Args:
        which: ``"noisy"`` or ``"clean"``.
        given: CFA and levels for files that do not state them.
        alone: the file holds both mosaics of its pair, each by its name.
        max_pixels: a PNG with more is refused; other formats have limits of their own.

    Raises:
        FileNotFoundError, OSError: if it is missing or damaged.
        ValueError: if CFA or levels are unknown or contradict ``given``, or the numbers are not a mosaic within them.
    """
    suffix = file.suffix.lower()
    if suffix in RAW_EXTENSIONS:
        return _camera_file(file, given)
    if suffix in TWO_IN_ONE:
        numbers, values = apart(_npz, file, which, alone) if suffix == ".npz" else _mat(file, which, alone)
    elif suffix == ".png":
        numbers, values = _png(file, max_pixels), {}
    elif suffix in (".tif", ".tiff"):
        numbers, values = apart(_tiff, file)
    else:
        raise ValueError(f"{file}: cannot hold a mosaic; use {', '.join(ARRAYS)} or a RAW format")
    stated = Statements.parse(values, file).joined(given, file)
    if stated.cfa is None:
        raise ValueError(f"{file}: does not state its CFA; give cfa, such as RGGB")
    return Mosaic(
        raw=_normalised(file, numbers, stated.cfa, stated),
        cfa=stated.cfa,
        white_balance=stated.white_balance,
        color_matrix=stated.color_matrix,
        levels=None if stated.shot_var is None or stated.read_var is None else (stated.shot_var, stated.read_var),
    )


def _camera_file(file: Path, given: Statements) -> Mosaic:
    frame = apart(read_raw, file)
    Statements(frame.cfa, levels(frame.black), frame.white).joined(given, file)
    gains, matrix = (frame.white_balance, frame.color_matrix) if frame.color_known else (None, None)
    return Mosaic(frame.mosaic, frame.cfa, gains, matrix, frame.noise_profile, frame.camera, frame.iso)


def _npz(file: Path, which: str, alone: bool) -> tuple[np.ndarray, dict[str, Any]]:
    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such NPZ file")
    try:
        # opened here, since NumPy leaves the files of damaged archives open
        with file.open("rb") as opened, np.load(opened, allow_pickle=False) as arrays:
            names = list(arrays.files)
            name = _name_of(file, names, which, alone)
            stated = [known for known in names if known in KINDS]
            size = sum(arrays.zip.getinfo(f"{read}.npy").file_size for read in (name, *stated))
            if size > MAX_BYTES:
                raise ValueError(f"{name} declares {size} bytes, above the limit of {MAX_BYTES}")
            return arrays[name], {known: arrays[known] for known in stated}
    except _Unclear:
        raise
    except _UNREADABLE as error:
        raise OSError(f"{file}: cannot be read as NPZ ({' '.join(str(error).split())}); copy it again") from error


def _mat(file: Path, which: str, alone: bool) -> tuple[np.ndarray, dict[str, Any]]:
    names = variables(file)
    values = {name: read_value(file, name) for name in names if name in KINDS}
    return read_array(file, _name_of(file, names, which, alone)), values


def _png(file: Path, max_pixels: int) -> np.ndarray:
    numbers = apart(read_plane, file, max_pixels)
    if numbers.dtype != np.uint16:
        raise ValueError(f"{file}: has 8 bits; a mosaic needs a PNG of 16 bits")
    return numbers


def _tiff(file: Path) -> tuple[np.ndarray, dict[str, Any]]:
    with extra("raw"):
        import tifffile

    if not file.is_file():
        raise FileNotFoundError(f"{file}: no such TIFF file")
    try:
        with opened_tiff(file) as tiff:
            page = tiff.pages[0]
            if page.nbytes > MAX_BYTES:
                raise ValueError(f"its first page declares {page.nbytes} bytes, above the limit of {MAX_BYTES}")
            text = getattr(page, "description", "")
            numbers = page.asarray()
    except OSError as error:
        if "imagecodecs" in str(error):
            raise ValueError(f"{file}: has a compression that is not supported; save it without one") from error
        raise
    except (tifffile.TiffFileError, zlib.error) as error:
        raise OSError(f"{file}: cannot be read as TIFF ({error}); copy it again") from error
    try:
        stated = json.loads(text) if text.startswith("{") else {}
    except ValueError:  # a description of another program
        stated = {}
    return numbers, stated


class _Unclear(ValueError):
    """The file is whole, but which array is meant is not clear."""


def _name_of(file: Path, names: Iterable[str], which: str, alone: bool) -> str:
    """The array of a file that is the mosaic: the one of that name, or the only one."""
    arrays = [name for name in names if name not in KINDS]
    if which in arrays:
        return which
    if len(arrays) == 1 and not alone:
        return arrays[0]
    raise _Unclear(f"{file}: has no array {which}, but {', '.join(arrays) or 'none'}; name its mosaics noisy and clean")


def _normalised(file: Path, numbers: np.ndarray, cfa: CFA, stated: Statements) -> Tensor:
    """Numbers as RAW float32 ``(1, H, W)``, black 0, white 1."""
    if numbers.dtype.kind not in "fui" or not numbers.size:
        raise ValueError(f"{file}: holds {numbers.dtype} {numbers.shape}; a mosaic must hold numbers")
    black, white = _levels_of(file, numbers, stated)
    low, high = float(numbers.min()), float(numbers.max())
    if not (high <= white and low > 2 * min(black) - white):
        raise ValueError(
            f"{file}: has values from {low:.4g} to {high:.4g}, outside black {shown(black)} and white {white:g}; "
            "give the right black and white"
        )
    packed = _packed(file, torch.from_numpy(np.ascontiguousarray(numbers, np.float32)), cfa)
    sites = torch.tensor(black, dtype=torch.float32).reshape(-1, 1, 1)
    return bayer.unpack((packed - sites) / (white - sites), cfa)


def _levels_of(file: Path, numbers: np.ndarray, stated: Statements) -> tuple[tuple[float, ...], float]:
    black, white = stated.black, stated.white
    if black is None and white is None and numbers.dtype.kind == "f":
        return (0.0,), 1.0
    for key, level in (("black", black), ("white", white)):
        if level is None:
            raise ValueError(f"{file}: does not state its {key} level; give black and white")
    assert black is not None and white is not None
    if white <= max(black):
        raise ValueError(f"{file}: white level {white:g} is not above black level {shown(black)}")
    return black, white


def _packed(file: Path, numbers: Tensor, cfa: CFA) -> Tensor:
    """``(4, h, w)`` as it is; a mosaic ``(H, W)`` or ``(1, H, W)`` packed."""
    if numbers.ndim == 3 and numbers.shape[0] == 4:
        return numbers
    if numbers.ndim == 3 and numbers.shape[0] == 1:
        numbers = numbers[0]
    if numbers.ndim != 2 or min(numbers.shape) < 2:
        raise ValueError(f"{file}: has shape {tuple(numbers.shape)}; use a mosaic (H, W) or packed RAW (4, h, w)")
    height, width = (side // 2 * 2 for side in numbers.shape)
    return bayer.pack(numbers[None, :height, :width], cfa)
