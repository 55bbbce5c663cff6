"""MATLAB files: version 5 through SciPy, version 7.3 (HDF5) through h5py, distinguished by the header.

A 7.3 file holds a matrix with its axes in reverse, since MATLAB counts down the columns and HDF5 along the rows: read
naively, a picture comes transposed, and a GRBG mosaic looks like GBRG. Here all axes are MATLAB's. Source: MathWorks,
"MAT-File Format", for version 5; 7.3 is HDF5 behind 512 bytes of header.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.errors import extra
from rawaug.files import require_file
from rawaug.io.isolated import damage_as_os_error, isolated

_HDF5 = b"\x89HDF\r\n\x1a\n"
_TEXT = b"MATLAB 5.0"
_UNREADABLE = "cannot be read as a MATLAB file"
MAX_BYTES = 2**30
"""Larger variables are refused before they are read: those of the published datasets have at most 0.5 GiB."""


def mat_version(path: str | Path) -> str:
    """``"5"`` or ``"7.3"``, by the header."""
    require_file(path, "MATLAB file")
    with Path(path).open("rb") as file:
        header = file.read(512 + len(_HDF5))
    if header.startswith(_HDF5) or header[512:] == _HDF5:
        return "7.3"
    if header.startswith(_TEXT) and header[126:128] in (b"IM", b"MI"):
        return "5"
    raise ValueError(f"{path}: is not a MATLAB file of version 5 or 7.3; copy it again, or save it with -v7.3")


def variables(path: str | Path) -> list[str]:
    return list(isolated(_shapes, Path(path)))


def read_array(path: str | Path, name: str) -> np.ndarray:
    """The numeric array ``name``, axes and type as in MATLAB."""
    value = isolated(_read, Path(path), name, False)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        raise ValueError(f"{path}: {name} is not a numeric array but {type(value).__name__}")
    return value


def read_value(path: str | Path, name: str) -> Any:
    """The variable ``name`` as plain values: structs are dicts, struct arrays lists of dicts, cells lists, characters
    strings, numbers arrays without axes of length 1. A matrix of cells or structs is listed row by row.
    """
    return isolated(_read, Path(path), name, True)


def normalised(values: np.ndarray, axes: int, file: Path) -> Tensor:
    """RAW of two or more ``axes`` and white 1 as float32, with a channel axis before the last two."""
    if values.ndim != axes or values.dtype.kind != "f" or not values.size:
        raise ValueError(f"{file}: holds {values.dtype} {values.shape}; normalised RAW is floats with {axes} axes")
    low, high = float(values.min()), float(values.max())
    if not (low > -1 and high <= 1):
        raise ValueError(f"{file}: has values from {low:.4g} to {high:.4g}; normalised RAW has black at 0, white at 1")
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).unsqueeze(-3)


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The variables by name; HDF5 states their shapes with their values."""
    version = mat_version(path)
    with damage_as_os_error(path, _UNREADABLE):
        if version == "5":
            from scipy.io import whosmat

            return {name: shape for name, shape, _ in whosmat(path)}
        with _hdf5(path) as file:
            return {name: () for name in file if not name.startswith("#")}


def _hdf5(path: Path) -> Any:
    with extra("data"):
        import h5py

    return h5py.File(path, "r")


def _read(path: Path, name: str, plain: bool) -> Any:
    shapes, version = _shapes(path), mat_version(path)
    if name not in shapes:
        raise ValueError(f"{path}: has no variable {name}; its variables are: {', '.join(shapes) or 'none'}")
    with damage_as_os_error(path, _UNREADABLE):
        if version == "5":
            from scipy.io import loadmat

            _require_size(8 * math.prod(shapes[name]), name)
            return loadmat(path, variable_names=[name], simplify_cells=plain)[name]
        with _hdf5(path) as file:
            node = _member(file, name)
            return _plain(node, file) if plain else np.ascontiguousarray(_values(node).T)


def _require_size(size: int, name: str) -> None:
    if not 0 <= size <= MAX_BYTES:
        raise ValueError(f"{name} declares {size} bytes, above the limit of {MAX_BYTES}")


def _member(group: Any, name: str) -> Any:
    """A member of a group; HDF5 links are refused, since they can point to any file on this machine."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link, not a variable")
    return group[name]


def _values(node: Any) -> Any:
    """The values of an HDF5 dataset; refuses external storage and datasets above the size limit."""
    if node.external or node.is_virtual:
        raise ValueError(f"{node.name} is stored in another file")
    _require_size(node.size * node.dtype.itemsize, node.name)
    return node[()]


def _plain(node: Any, file: Any) -> Any:
    import h5py

    if isinstance(node, h5py.Group):
        fields = {key: _plain(_member(node, key), file) for key in node}
        # the fields of a struct array refer to their values, and unlike cells they have no class of their own
        if fields and all(_refers(node[key]) and "MATLAB_class" not in node[key].attrs for key in node):
            return [dict(zip(fields, values, strict=True)) for values in zip(*fields.values(), strict=True)]
        return fields
    value = _values(node)
    if _refers(node):
        return [_plain(file[reference], file) for reference in np.ravel(value, order="F")]
    if node.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, np.ravel(value)))
    if node.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    return np.array(np.asarray(value).T.squeeze(), order="C")


def _refers(node: Any) -> bool:
    """Whether a node holds references: a cell, or a field of a struct array."""
    import h5py

    return isinstance(node, h5py.Dataset) and h5py.check_ref_dtype(node.dtype) is not None
