"""Arrays from one process to another through memory that both have mapped.

The sender writes an array once, in C order whatever its strides are, into a memory that it uses again and again, so
that its pages are there already; the receiver copies it out once. The rest of a value is pickled.
"""

from __future__ import annotations

import mmap
import os
import pickle
import tempfile
from collections.abc import Iterator, Sequence
from io import BytesIO
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor

_LINE = 64
"""Bytes of the cache's lines, on which arrays begin."""

Kinds = Sequence[tuple[str, tuple[int, ...]]]
"""Types and shapes of arrays."""


class SharedMemory:
    """A file without a name, mapped: what one process puts there, another sees.

    Args:
        file: its descriptor, from another process; by default a new file.

    Example:
        >>> sender = SharedMemory()
        >>> kinds = sender.put([np.arange(3), np.eye(2)])
        >>> receiver = SharedMemory(os.dup(sender.file))
        >>> receiver.copies(kinds)[0]
        array([0, 1, 2])
    """

    def __init__(self, file: int | None = None) -> None:
        self.file = _new_file() if file is None else file
        self._view: mmap.mmap | None = None

    def put(self, arrays: Sequence[np.ndarray]) -> Kinds:
        """Write arrays over what is there; the file grows to hold them."""
        kinds = [(array.dtype.str, array.shape) for array in arrays]
        for array, stored in zip(arrays, self._stored(kinds, grow=True), strict=True):
            np.copyto(stored, array)
        return kinds

    def copies(self, kinds: Kinds) -> list[np.ndarray]:
        """The arrays that were put there."""
        return [stored.copy() for stored in self._stored(kinds)]

    def _stored(self, kinds: Kinds, grow: bool = False) -> Iterator[np.ndarray]:
        sizes = [np.dtype(kind).itemsize * int(np.prod(shape)) for kind, shape in kinds]
        *places, end = [0, *accumulate(-(-size // _LINE) * _LINE for size in sizes)]
        if end and (self._view is None or len(self._view) < end):
            self._view = None  # a mapping cannot grow
            if grow:
                os.ftruncate(self.file, end)
            self._view = mmap.mmap(self.file, os.fstat(self.file).st_size)
        for (kind, shape), size, place in zip(kinds, sizes, places, strict=True):
            content = memoryview(self._view)[place : place + size] if self._view is not None else bytearray()
            yield np.ndarray(shape, kind, content)


def _new_file() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rawaug")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def pickled(value: Any, arrays: list[np.ndarray]) -> bytes:
    """A value without its arrays and tensors, which are added to ``arrays``.

    Raises:
        pickle.PicklingError, TypeError, AttributeError: if it cannot be pickled; no array has been added.
    """
    file, before = BytesIO(), len(arrays)
    try:
        _Pickler(file, arrays).dump(value)
    except BaseException:
        del arrays[before:]
        raise
    return file.getvalue()


def unpickled(content: bytes, arrays: Sequence[np.ndarray]) -> Any:
    """The value that :func:`pickled` was given.

    Example:
        >>> arrays = []
        >>> unpickled(pickled({"a": torch.zeros(2)}, arrays), arrays)
        {'a': tensor([0., 0.])}
    """
    return _Unpickler(BytesIO(content), arrays).load()


class _Pickler(pickle.Pickler):
    def __init__(self, file: BytesIO, arrays: list[np.ndarray]) -> None:
        super().__init__(file, protocol=5)
        self.arrays = arrays
        self._known: dict[int, tuple[Any, int]] = {}  # by id: the value, which has to stay, and its place

    def persistent_id(self, value: Any) -> tuple[bool, int] | None:
        """Whether it is a tensor, and its place among the arrays; None for other values."""
        tensor = type(value) is Tensor and value.layout == torch.strided
        if not tensor and not (type(value) is np.ndarray and value.dtype.kind in "biufc"):
            return None
        if id(value) not in self._known:
            self._known[id(value)] = value, len(self.arrays)
            self.arrays.append(value.numpy() if tensor else value)
        return tensor, self._known[id(value)][1]


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: BytesIO, arrays: Sequence[np.ndarray]) -> None:
        super().__init__(file)
        self.arrays = arrays

    def persistent_load(self, known: tuple[bool, int]) -> Tensor | np.ndarray:
        tensor, place = known
        return torch.from_numpy(self.arrays[place]) if tensor else self.arrays[place]
