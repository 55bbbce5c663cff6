"""MATLAB files as MATLAB writes them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest


def write_mat73(path: Path, variables: dict[str, Any]) -> Path:
    """Version 7.3: HDF5 behind 512 bytes, axes reversed, structs as groups, struct arrays and cells as references.

    Arrays are numeric, strings are char, dicts structs, lists of dicts struct arrays, other lists cells.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            _put(file, file, name, value)
    with path.open("r+b") as raw:
        text = b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan  1 00:00:00 2018 HDF5 schema 1.00 ."
        raw.write(text.ljust(124) + struct.pack("<H", 0x0200) + b"IM")
    return path


def _put(file: h5py.File, group: h5py.Group, name: str, value: Any) -> None:
    if isinstance(value, dict):
        node = group.create_group(name)
        node.attrs["MATLAB_class"] = np.bytes_("struct")
        for key, inner in value.items():
            _put(file, node, key, inner)
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        node = group.create_group(name)
        node.attrs["MATLAB_class"] = np.bytes_("struct")
        for key in value[0]:
            node.create_dataset(key, data=_references(file, [element[key] for element in value]))
    elif isinstance(value, list):
        cell = group.create_dataset(name, data=_references(file, value))
        cell.attrs["MATLAB_class"] = np.bytes_("cell")
    elif isinstance(value, str):
        text = group.create_dataset(name, data=np.array([[ord(letter)] for letter in value], np.uint16))
        text.attrs["MATLAB_class"] = np.bytes_("char")
    else:
        array = np.atleast_2d(np.asarray(value))
        data = group.create_dataset(name, data=array.T, compression="gzip")
        data.attrs["MATLAB_class"] = np.bytes_(
            {"float64": "double", "float32": "single"}.get(array.dtype.name, "uint8")
        )


def _references(file: h5py.File, values: list[Any]) -> np.ndarray:
    store = file.require_group("#refs#")
    references = np.empty((1, len(values)), h5py.ref_dtype)
    for k, value in enumerate(values):
        name = f"r{len(store)}"
        _put(file, store, name, value)
        references[0, k] = store[name].ref
    return references


@pytest.fixture(scope="session")
def mat73() -> Callable[[Path, dict[str, Any]], Path]:
    return write_mat73


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files are read in this process: a helper, which takes a second to start, is for tests of crashes and hangs."""
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")
