"""Pictures kept in memory once decoded, for training on a few hundred photographs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch.utils.data import Dataset


class Remembered(Dataset[Tensor]):
    """A dataset of pictures, kept as decoded up to ``megabytes``; the rest is read again each time.

    Each worker process has its own cache.

    Example:
        >>> import torch
        >>> pictures = Remembered([torch.zeros(3, 8, 8, dtype=torch.uint8)], megabytes=1)
        >>> pictures[0] is pictures[0]
        True
    """

    def __init__(self, pictures: Sequence[Tensor] | Any, megabytes: int) -> None:
        self.pictures, self._left = pictures, megabytes * 2**20
        self._kept: dict[int, Tensor] = {}

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> Tensor:
        if index not in self._kept:
            picture: Tensor = self.pictures[index]
            if picture.nbytes > self._left:
                return picture
            self._left -= picture.nbytes
            self._kept[index] = picture
        return self._kept[index]
