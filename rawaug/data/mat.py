r"""MATLAB files: version 5, which SciPy reads, and 7.3, HDF5 after 512 bytes of header, which h5py reads.

A 7.3 file stores the axes of a matrix in reverse, since MATLAB stores column by column and HDF5 row by row. Without
correction a picture is transposed, and a GRBG mosaic looks like GBRG. All axes here are those of MATLAB. Source:
MathWorks, "MAT-File Format".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
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
"""Maximum size of a variable in a file. Variables of the published datasets have at most 0.5 GiB."""


def mat_version(path: str | Path) -> str:
    """Tell ``"5"`` or ``"7.3"`` by the header."""
    require_file(path, "MATLAB file")
    with Path(path).open("rb") as file:
        header = file.read(512 + len(_HDF5))

    if header.startswith(_HDF5) or header[512:] == _HDF5:
        return "7.3"
    if header.startswith(_TEXT) and header[126:128] in (b"IM", b"MI"):
        return "5"
    raise ValueError(f"{path}: is not a MATLAB file of version 5 or 7.3; copy it again, or save it with -v7.3")


def variables(path: str | Path) -> list[str]:
    """The names of the variables in a MATLAB file."""
    return list(isolated(_shapes, Path(path)))


def read_array(path: str | Path, name: str) -> np.ndarray:
    """Read the numeric array ``name``, with axes and type as in MATLAB."""
    value = isolated(_read, Path(path), name, False)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
        raise ValueError(f"{path}: {name} is not a numeric array but {type(value).__name__}")
    return value


def read_value(path: str | Path, name: str) -> Any:
    """Read the variable ``name`` as plain values.

    Structs become dicts, struct arrays lists of dicts, cells lists (row by row), characters strings, and numbers arrays
    without axes of length 1.
    """
    return isolated(_read, Path(path), name, True)


def to_raw(values: np.ndarray, axes: int, file: Path) -> Tensor:
    """Convert an array of normalised RAW with ``axes`` axes to float32, with a channel axis before the last two."""
    if values.ndim != axes or values.dtype.kind != "f" or not values.size:
        raise ValueError(f"{file}: holds {values.dtype} {values.shape}; normalised RAW is floats with {axes} axes")

    low, high = float(values.min()), float(values.max())
    if not (low > -1 and high <= 1):
        raise ValueError(f"{file}: has values from {low:.4g} to {high:.4g}; normalised RAW has black at 0, white at 1")
    return torch.from_numpy(np.ascontiguousarray(values, np.float32)).unsqueeze(-3)


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """The shape of each variable; empty in version 7.3, where HDF5 states the shapes with the values."""
    version = mat_version(path)
    shapes: dict[str, tuple[int, ...]] = {}
    with damage_as_os_error(path, _UNREADABLE):
        if version == "5":
            from scipy.io import whosmat

            for name, shape, _ in whosmat(path):
                shapes[name] = shape
        else:
            with _hdf5(path) as file:
                for name in file:
                    if not name.startswith("#"):  # MATLAB's own references
                        shapes[name] = ()
    return shapes


def _hdf5(path: Path) -> Any:
    with extra("data"):
        import h5py

    return h5py.File(path, "r")


def _read(path: Path, name: str, plain: bool) -> Any:
    shapes = _shapes(path)
    version = mat_version(path)
    if name not in shapes:
        raise ValueError(f"{path}: has no variable {name}; its variables are: {', '.join(shapes) or 'none'}")

    with damage_as_os_error(path, _UNREADABLE):
        if version == "5":
            from scipy.io import loadmat

            require_bytes(8 * math.prod(shapes[name]), name)
            return loadmat(path, variable_names=[name], simplify_cells=plain)[name]

        with _hdf5(path) as file:
            node = _member(file, name)
            if plain:
                return _plain(node, file)
            return np.ascontiguousarray(_values(node).T)


def require_bytes(size: int, name: str) -> None:
    """Raise ValueError if a variable declares more than :data:`MAX_BYTES`."""
    if not 0 <= size <= MAX_BYTES:
        raise ValueError(f"{name} declares {size} bytes, above the limit of {MAX_BYTES}")


def _member(group: Any, name: str) -> Any:
    """Get a member of a group. Links are refused, since they can point to any file on this machine."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is a link, not a variable")
    return group[name]


def _values(node: Any) -> Any:
    """Read the values of an HDF5 dataset. External storage and datasets above the size limit are refused."""
    if node.external or node.is_virtual:
        raise ValueError(f"{node.name} is stored in another file")
    require_bytes(node.size * node.dtype.itemsize, node.name)
    return node[()]


def _plain(node: Any, file: Any) -> Any:
    """Convert an HDF5 node to the value that :func:`read_value` returns."""
    import h5py

    if isinstance(node, h5py.Group):
        fields = {}
        for key in node:
            fields[key] = _plain(_member(node, key), file)
        if _is_struct_array(node):
            return _struct_array(fields)
        return fields

    value = _values(node)
    if h5py.check_ref_dtype(node.dtype) is not None:
        return [_plain(file[reference], file) for reference in np.ravel(value, order="F")]
    if node.attrs.get("MATLAB_class") == b"char":
        return "".join(map(chr, np.ravel(value)))
    if node.attrs.get("MATLAB_empty", 0):
        return np.zeros(0)
    return np.array(np.asarray(value).T.squeeze(), order="C")


def _is_struct_array(group: Any) -> bool:
    """Whether a struct has several elements. Its fields then hold references but, unlike cells, have no class."""
    import h5py

    for field in group.values():
        has_references = isinstance(field, h5py.Dataset) and h5py.check_ref_dtype(field.dtype) is not None
        if not has_references or "MATLAB_class" in field.attrs:
            return False
    return len(group) > 0


def _struct_array(fields: Mapping[str, list[Any]]) -> list[dict[str, Any]]:
    """Make the elements of a struct array from the values of each field."""
    elements = []
    for values in zip(*fields.values(), strict=True):
        elements.append(dict(zip(fields, values, strict=True)))
    return elements
