"""The pairs of a dataset that can be read; those that cannot are named."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from torch.utils.data import Subset

from rawaug.data.pair import Pair


class Readable(Sequence[Pair]):
    """Goes over pairs one by one; one whose files are damaged is left out, its reason kept.

    Attributes:
        broken: by index, why a pair could not be read; a pair is tried once.

    Example:
        >>> class Damaged(list):
        ...     def __getitem__(self, index):
        ...         raise OSError(f"{index}.dng: truncated")
        >>> pairs = Readable(Damaged([0, 1]))
        >>> list(pairs), pairs.broken
        ([], {0: '0.dng: truncated', 1: '1.dng: truncated'})
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
            if index in self.broken:
                continue
            try:
                pair = self.pairs[index]
            except (OSError, ValueError) as error:
                self.broken[index] = " ".join(str(error).split())
                continue
            yield pair

    def kept(self) -> Subset[Pair]:
        """Those that were not found to be broken so far."""
        return Subset(self.pairs, [k for k in range(len(self.pairs)) if k not in self.broken])  # type: ignore[arg-type]
