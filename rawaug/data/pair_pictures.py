"""The sRGB pictures of RAW-sRGB pairs, as pictures to augment with: what few pairs alone can give."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from rawaug.data.pair import Pair

OWN_PICTURES = "pairs"
"""``data.pictures`` of a recipe that augments the pictures of its own pairs."""


class PairPictures(Sequence[Tensor]):
    """The pictures uint8 ``(3, H, W)`` of pairs; a pair is read when its picture is asked for.

    Args:
        pairs: the pairs; keep them in memory if they are asked for often.
    """

    def __init__(self, pairs: Sequence[Pair]) -> None:
        self.pairs = pairs

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[k] for k in range(len(self))[index]]
        return self.pairs[index].srgb
