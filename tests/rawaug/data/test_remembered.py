"""Pictures kept in memory: each is decoded once, as far as the memory goes."""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.data.folders import Remembered


class Decoded:
    """Three pictures of 0.5 MiB; what is decoded is noted."""

    def __init__(self) -> None:
        self.read: list[int] = []

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> Tensor:
        self.read.append(index)
        return torch.full((2, 512, 512), index, dtype=torch.uint8)


def test_a_picture_is_decoded_once() -> None:
    pictures = Decoded()
    kept = Remembered(pictures, megabytes=2)
    for _ in range(2):
        assert [int(kept[k][0, 0, 0]) for k in range(len(kept))] == [0, 1, 2]
    assert pictures.read == [0, 1, 2]


def test_what_has_no_room_is_decoded_again() -> None:
    pictures = Decoded()
    kept = Remembered(pictures, megabytes=1)  # room for two
    for _ in range(2):
        assert [int(kept[k][0, 0, 0]) for k in (2, 0, 1)] == [2, 0, 1]
    assert pictures.read == [2, 0, 1, 1]
