"""Pairs that are read when they are asked for."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import overload

from rawaug.data.pair import Pair
from rawaug.io.apart import prepare


class LazyPairs(Sequence[Pair], ABC):
    """A sequence of pairs that reads one at a time; the last one stays in memory.

    Args:
        names: of the pairs, known without reading any.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = list(names)
        self._last: tuple[int, Pair] | None = None
        prepare()

    @abstractmethod
    def read(self, index: int) -> Pair:
        """The pair at ``index`` in [0, len)."""

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
