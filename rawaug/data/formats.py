r"""The file formats of mosaics and of noisy/clean pairs of mosaics, by extension.

    y = (d - black) / (white - black)

for a digital number d, which may not exceed white (except in camera RAW, which :func:`rawaug.io.read_raw` reads). The
caller must give the CFA and levels that a file does not state, and cannot override those that it states. Floating point
numbers without levels are y itself.

======  ==============================================  =============================================  ===============
file    numbers                                         metadata                                       written
======  ==============================================  =============================================  ===============
RAW     as LibRaw reads them                            all, by their tags                             dng, 16 bits
npz     the array ``noisy`` or ``clean``, or the only   arrays ``cfa``, ``black``, ``white``,          packed float32
        one; packed ``(4, h, w)`` or ``(h, w, 4)``,     ``white_balance``, ``color_matrix``,
        or ``(H, W)``                                   ``shot_var``, ``read_var``
npy     the same shapes                                 none                                           no
mat     the same, of version 5 or 7.3                   variables of these names                       no
tiff    the first page                                  its description, as JSON with these keys       mosaic, float32
png     16 bits, one channel                            none                                           no
======  ==============================================  =============================================  ===============

MATLAB files are read by :mod:`rawaug.data.mat`, metadata parsed by :mod:`rawaug.data.mosaic_metadata`.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.mat import MAX_BYTES, read_array, read_value, require_bytes, variables
from rawaug.data.mosaic_metadata import KINDS, Metadata, complete_metadata, format_value, levels, parse_metadata
from rawaug.errors import extra
from rawaug.files import replacing, require_file, write_bytes
from rawaug.io import RawFrame, read_raw
from rawaug.io.isolated import damage_as_os_error
from rawaug.io.pictures import MAX_PIXELS, read_plane
from rawaug.io.raw import RAW_EXTENSIONS
from rawaug.io.tiff import opened_tiff

Contents = tuple[np.ndarray, Mapping[str, Any]]
"""The numbers of a file, and its metadata."""


class _Unclear(ValueError):
    """The file is intact, but it does not say which array is the mosaic."""


def _read_npz(file: Path, which: str, alone: bool, max_pixels: int) -> Contents:
    def select(names: list[str]) -> list[str]:
        return [_choose_name(file, names, which, alone), *KINDS.keys() & set(names)]

    with damage_as_os_error(file, "cannot be read as NPZ", _Unclear):
        arrays = read_npz(file, select)

    stated = {}
    for name, array in arrays.items():
        if name in KINDS:
            stated[name] = array
        else:
            numbers = array
    return numbers, stated


def read_npz(file: Path, select: Callable[[list[str]], Iterable[str]]) -> dict[str, np.ndarray]:
    """Read the arrays that ``select`` chooses by their names; together they may have :data:`MAX_BYTES`."""
    # opened here, since NumPy does not close the files of damaged archives
    with file.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        names = list(select(list(archive.files)))
        size = 0
        for name in names:
            size += archive.zip.getinfo(f"{name}.npy").file_size
        if size > MAX_BYTES:
            raise ValueError(f"declares {size} bytes, above the limit of {MAX_BYTES}")

        arrays = {}
        for name in names:
            arrays[name] = archive[name]
        return arrays


def _read_npy(file: Path, which: str, alone: bool, max_pixels: int) -> Contents:
    """Read the array of a file. Its header states its size; NumPy refuses objects, which are pickles."""
    with damage_as_os_error(file, "cannot be read as NPY", _Unclear), file.open("rb") as stream:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
        else:
            raise ValueError(f"version {version[0]}.{version[1]} of the format")
        require_bytes(math.prod(shape) * dtype.itemsize, "its array")

        stream.seek(0)
        return np.load(stream, allow_pickle=False), {}


def write_npz(file: Path, clean: Tensor, noisy: Tensor, stated: Mapping[str, Any]) -> None:
    """Write a pair as packed RAW ``(4, h, w)`` (mosaics for other patterns), with its metadata (``stated``)."""
    arrays: dict[str, Any] = {}
    for key, value in stated.items():
        dtype = None if key == "cfa" else np.float32
        arrays[key] = np.array(value, dtype)

    with replacing(file) as partial, partial.open("wb") as stream:
        np.savez(stream, **arrays, clean=clean.numpy(), noisy=noisy.numpy())


def _read_mat(file: Path, which: str, alone: bool, max_pixels: int) -> Contents:
    names = variables(file)
    stated = {}
    for name in names:
        if name in KINDS:
            stated[name] = read_value(file, name)
    return read_array(file, _choose_name(file, names, which, alone)), stated


def _read_tiff(file: Path, which: str, alone: bool, max_pixels: int) -> Contents:
    with damage_as_os_error(file, "cannot be read as TIFF", OSError), opened_tiff(file) as tiff:
        page = tiff.pages[0]
        if page.nbytes > MAX_BYTES:
            raise ValueError(f"its first page declares {page.nbytes} bytes, above the limit of {MAX_BYTES}")
        return page.asarray(), _parse_description(getattr(page, "description", ""))


def _parse_description(text: str) -> Mapping[str, Any]:
    """Parse the metadata in the description of a TIFF; empty if another program wrote it."""
    if not text.startswith("{"):
        return {}
    try:
        stated: Mapping[str, Any] = json.loads(text)
    except ValueError:
        return {}
    return stated


def write_tiff(file: Path, image: Tensor, stated: Mapping[str, Any]) -> None:
    """Write a mosaic ``(1, H, W)`` or colour ``(3, H, W)`` in its own type; float32 has black 0 and white 1."""
    with extra("raw"):
        import tifffile

    pixels, photometric = image[0].numpy(), "minisblack"
    if len(image) == 3:
        pixels, photometric = image.permute(1, 2, 0).numpy(), "rgb"
    description = json.dumps(stated, sort_keys=True)
    content = io.BytesIO()
    tifffile.imwrite(content, pixels, photometric=photometric, description=description, metadata=None)
    write_bytes(content.getbuffer(), file)


def _read_png(file: Path, which: str, alone: bool, max_pixels: int) -> Contents:
    numbers = read_plane(file, max_pixels)
    if numbers.dtype != np.uint16:
        raise ValueError(f"{file}: has 8 bits; a mosaic needs a PNG of 16 bits")
    return numbers, {}


READERS: dict[str, Callable[[Path, str, bool, int], Contents]] = {
    ".npz": _read_npz,
    ".npy": _read_npy,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".png": _read_png,
    ".mat": _read_mat,
}
READABLE = (*RAW_EXTENSIONS, *READERS)
TWO_IN_ONE = (".npz", ".mat")
"""Extensions of files that can hold both mosaics of a pair."""


# -- one mosaic -------------------------------------------------------------------------------------------------------


def read_mosaic(
    file: Path, which: str, others: Metadata, alone: bool = False, max_pixels: int = MAX_PIXELS
) -> RawFrame:
    """Read a mosaic.

    Args:
        file: the file.
        which: ``noisy`` or ``clean``, the name of the array.
        others: metadata to use where the file states none.
        alone: whether the file holds both mosaics of a pair, so that its only array is not enough.
        max_pixels: the limit of a PNG.

    Raises:
        ValueError: if the extension is unknown, or the metadata are incomplete or contradict each other.
    """
    suffix = file.suffix.lower()
    if suffix in RAW_EXTENSIONS:
        frame = read_raw(file)
        complete_metadata({"cfa": frame.cfa, "black": levels(frame.black), "white": frame.white}, others, file)
        return frame
    if suffix not in READERS:
        raise ValueError(f"{file}: cannot hold a mosaic; use {', '.join(READERS)} or a RAW format")

    require_file(file)
    numbers, values = READERS[suffix](file, which, alone, max_pixels)
    metadata = complete_metadata(parse_metadata(values, file), others, file)
    if "cfa" not in metadata:
        raise ValueError(f"{file}: does not state its CFA; give cfa, such as RGGB")

    attributes: dict[str, Any] = {"color_known": False}
    if {"white_balance", "color_matrix"} <= metadata.keys():
        attributes["color_known"] = True
        attributes["white_balance"] = metadata["white_balance"]
        attributes["color_matrix"] = metadata["color_matrix"]
    if {"shot_var", "read_var"} <= metadata.keys():
        attributes["noise_profile"] = (metadata["shot_var"], metadata["read_var"])
    return RawFrame(_scale_to_raw(file, numbers, metadata), metadata["cfa"], **attributes)


def _choose_name(file: Path, names: Iterable[str], which: str, alone: bool) -> str:
    """Find the name of the array that is the mosaic: ``which``, or that of the only array."""
    arrays = [name for name in names if name not in KINDS]
    if which in arrays:
        return which
    if len(arrays) == 1 and not alone:
        return arrays[0]
    raise _Unclear(f"{file}: has no array {which}, but {', '.join(arrays) or 'none'}; name its mosaics noisy and clean")


def _scale_to_raw(file: Path, numbers: np.ndarray, metadata: Metadata) -> Tensor:
    """Scale numbers to RAW float32 ``(1, H, W)``, black 0, white 1."""
    if numbers.dtype.kind not in "fui" or not numbers.size:
        raise ValueError(f"{file}: holds {numbers.dtype} {numbers.shape}; a mosaic must hold numbers")

    states_levels = "black" in metadata or "white" in metadata
    if numbers.dtype.kind == "f" and not states_levels:
        metadata = metadata | {"black": (0.0,), "white": 1.0}
    for key in ("black", "white"):
        if key not in metadata:
            raise ValueError(f"{file}: does not state its {key} level; give black and white")

    black, white, cfa = metadata["black"], metadata["white"], metadata["cfa"]
    if white <= max(black):
        raise ValueError(f"{file}: white level {white:g} is not above black level {format_value(black)}")
    low, high = float(numbers.min()), float(numbers.max())
    if not (high <= white and low > 2 * min(black) - white):
        expected = f"black {format_value(black)} and white {white:g}; give the right black and white"
        raise ValueError(f"{file}: has values from {low:.4g} to {high:.4g}, outside {expected}")

    packed = _packed(file, torch.from_numpy(np.ascontiguousarray(numbers, np.float32)), cfa)
    black_of_planes = torch.tensor(black, dtype=torch.float32).reshape(-1, 1, 1)
    return bayer.unpack((packed - black_of_planes) / (white - black_of_planes), cfa)


_SHAPES = "a mosaic (H, W), or packed RAW (4, h, w) or (h, w, 4)"


def _packed(file: Path, numbers: Tensor, cfa: CFA) -> Tensor:
    """Pack a mosaic ``(H, W)``, ``(1, H, W)`` or ``(H, W, 1)``, or packed RAW of either order, as RAW ``(4, h, w)``.

    Planes are last if the last axis has 4 elements and the first does not.
    """
    if numbers.ndim == 3 and numbers.shape[0] == 4:
        return numbers
    if numbers.ndim == 3 and numbers.shape[-1] == 4:
        return numbers.permute(2, 0, 1)
    if numbers.ndim == 3 and numbers.shape[0] == 1:
        numbers = numbers[0]
    elif numbers.ndim == 3 and numbers.shape[-1] == 1:
        numbers = numbers[..., 0]
    if numbers.ndim != 2 or min(numbers.shape) < 2:
        raise ValueError(f"{file}: has shape {tuple(numbers.shape)}; use {_SHAPES}")

    height, width = numbers.shape[0] // 2 * 2, numbers.shape[1] // 2 * 2
    return bayer.pack(numbers[None, :height, :width], cfa)
