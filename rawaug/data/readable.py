"""The pairs of a dataset that can be read; those that cannot are named."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

from rawaug.data.lazy import SomePairs
from rawaug.data.pair import Pair
from rawaug.printable import printable

T = TypeVar("T")


class Readable(Sequence[Pair]):
    """Goes over pairs one by one; one whose files are damaged is left out, its reason kept.

    To go over pairs of which none can be read ends in a ValueError with the first reason.

    Attributes:
        broken: by index, why a pair could not be read; a pair is tried once.

    Example:
        >>> class Damaged(list):
        ...     def __getitem__(self, index):
        ...         if index == 1:
        ...             raise OSError(f"{index}.dng: truncated")
        ...         return super().__getitem__(index)
        >>> pairs = Readable(Damaged(["first", "second"]))
        >>> list(pairs), pairs.broken
        (['first'], {1: '1.dng: truncated'})
    """

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs
        self.broken: dict[int, str] = {}

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: Any) -> Any:
        return self.pairs[index]

    def __iter__(self) -> Iterator[Pair]:
        for index in range(len(self.pairs)):
            if (pair := self.attempt(index, self.pairs.__getitem__)) is not None:
                yield pair
        if self.broken and len(self.broken) == len(self.pairs):
            raise ValueError(f"none of the {len(self.pairs)} frames can be read; {self.reasons()[0]}")

    def attempt(self, index: int, read: Callable[[int], T]) -> T | None:
        """``read(index)``; None where this pair, now or before, could not be read."""
        if index in self.broken:
            return None
        try:
            return read(index)
        except (OSError, ValueError) as error:
            self.broken[index] = " ".join(str(error).split())
            return None

    def reasons(self) -> list[str]:
        """Why pairs were left out so far, in their order."""
        return [self.broken[index] for index in sorted(self.broken)]

    def kept(self) -> Sequence[Pair]:
        """Those that were not found to be broken so far; all of them as they were given if none was."""
        if not self.broken:
            return self.pairs
        kept = [k for k in range(len(self.pairs)) if k not in self.broken]
        if isinstance(self.pairs, SomePairs):  # of the same pairs
            return SomePairs(self.pairs.pairs, [self.pairs.indices[k] for k in kept])
        return SomePairs(self.pairs, kept)


def left_out(pairs: Readable, of: str) -> list[str]:
    """What was left out of a dataset, as lines to print: how many, then the reason of each; none if nothing was."""
    reasons = pairs.reasons()
    if not reasons:
        return []
    return [f"left out of {printable(of)}: {len(reasons)} of {len(pairs)} frames, unreadable", *map(printable, reasons)]


def each_readable(pairs: Sequence[Pair], of: str, seconds: float = math.inf, least: int = 1) -> Iterator[Pair]:
    """The pairs that can be read, one by one; at the end the others are printed.

    Args:
        pairs: a dataset, or one that is :class:`Readable` already, which then keeps what was found.
        of: what a user calls it.
        seconds: after which no further pair is read, from the first one on, which also waits for the libraries.
        least: that many are read all the same.

    Raises:
        ValueError: if there are pairs, and none can be read.
    """
    readable = pairs if isinstance(pairs, Readable) else Readable(pairs)
    start = math.inf
    for count, pair in enumerate(readable, start=1):
        start = min(start, time.perf_counter())
        yield pair
        if count >= least and time.perf_counter() - start > seconds:
            break
    if lines := left_out(readable, of):
        print("\n".join(lines))
