"""Samples for a network of every mosaic: RAW of patterns drawn at random, each beside the planes of its colours."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from typing import Any

import torch

from denoisers.mosaic import entry_pattern, with_planes
from rawaug import bayer
from rawaug.data.pairs import Sample
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs


class MosaicCrops:
    """Crops of pictures as RAW of a pattern drawn by its share, ``(4, crop, crop)`` with planes, from any of its cells.

    Args:
        pictures: a Dataset of pictures.
        augment: of a Bayer pattern; noise of planes is then of the four sites of every 2 x 2 square.
        crop: side in pixels.
        zoom: see :class:`rawaug.RawPairs`.
        patterns: shares of patterns by name.
    """

    def __init__(
        self, pictures: Any, augment: RawAugment, crop: int, zoom: float, patterns: Mapping[str, float]
    ) -> None:
        self.crop, self.patterns = crop, [entry_pattern(bayer.pattern(name)) for name in patterns]
        self.shares = torch.tensor([*patterns.values()])
        room = max(pattern.period for pattern in self.patterns)
        self.pairs = []
        for pattern in self.patterns:
            of_pattern = copy(augment)
            of_pattern.pattern = pattern
            self.pairs.append(RawPairs(pictures, of_pattern, crop + room, zoom=zoom))

    def draw(self, generator: torch.Generator) -> Sample:
        kind = int(torch.multinomial(self.shares, 1, generator=generator))
        pairs, pattern = self.pairs[kind], self.patterns[kind]
        pair = pairs.draw(int(torch.randint(len(pairs), (), generator=generator)), generator)
        top, left = (2 * torch.randint(pattern.period // 2, (2,), generator=generator)).tolist()
        window = (..., slice(top, top + self.crop), slice(left, left + self.crop))
        noisy = with_planes(pair.noisy[None], pattern)[0]
        return Sample(noisy[window], pair.clean[window], pair.variance[window])
