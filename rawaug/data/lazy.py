"""Pairs that are read when they are asked for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import overload

from rawaug.data.pair import Pair
from rawaug.io.apart import prepare
from rawaug.io.picture_files import MAX_PIXELS


class LazyPairs(Sequence[Pair], ABC):
    """A sequence of pairs that reads one at a time; the last one stays in memory.

    Args:
        names: of the pairs, known without reading any.

    Attributes:
        max_pixels: sRGB pictures, and mosaics in PNG files, with more are refused before they are decoded.
    """

    max_pixels: int = MAX_PIXELS

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._last: tuple[int, Pair] | None = None
        prepare()

    @abstractmethod
    def read(self, index: int) -> Pair:
        """The pair at ``index`` in [0, len)."""

    def files_of(self, index: int) -> Sequence[Path]:
        """The files that identify a pair; none where its name does."""
        return ()

    def stamp(self, index: int) -> str:
        """What a pair depends on, without reading it: path, size and modification time of its files, or its name."""
        files = [f"{f.resolve()} {f.stat().st_size} {f.stat().st_mtime_ns}" for f in self.files_of(index)]
        return " ".join(files) or self.names[index]

    def __len__(self) -> int:
        return len(self.names)

    @overload
    def __getitem__(self, index: int) -> Pair: ...

    @overload
    def __getitem__(self, index: slice) -> list[Pair]: ...

    def __getitem__(self, index: int | slice) -> Pair | list[Pair]:
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        index = range(len(self))[index]
        if self._last is None or self._last[0] != index:
            self._last = index, self.read(index)
        return self._last[1]


class SomePairs(LazyPairs):
    """Some pairs of a sequence, by index.

    Example:
        >>> from rawaug.data import demo_pairs
        >>> SomePairs(demo_pairs("train", count=3), [2, 0]).names
        ['train_02_astronaut', 'train_00_astronaut']
    """

    def __init__(self, pairs: Sequence[Pair], indices: Sequence[int]) -> None:
        self.pairs, self.indices = pairs, list(indices)
        known = names_of(pairs)
        super().__init__([known[index] for index in self.indices])

    def read(self, index: int) -> Pair:
        return self.pairs[self.indices[index]]

    def files_of(self, index: int) -> Sequence[Path]:
        return self.pairs.files_of(self.indices[index]) if isinstance(self.pairs, LazyPairs) else ()

    def stamp(self, index: int) -> str:
        return self.pairs.stamp(self.indices[index]) if isinstance(self.pairs, LazyPairs) else super().stamp(index)


def names_of(pairs: Sequence[Pair]) -> list[str]:
    """The names, without reading lazy pairs."""
    return list(pairs.names) if isinstance(pairs, LazyPairs) else [pair.name for pair in pairs]
