"""The stream of training samples: sample i depends only on (seed, i), so any step can be repeated.

One part of a batch is real crops (clean RAW of the few pairs with its captured noise, or with drawn noise if none was
captured; or crops of frames without a clean RAW). The other part is RAW made from sRGB pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from rawaug.data.pairs import Sample
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.params import AugmentParams
from rawaug.seeding import keyed_generator
from rawaug.training.sources import PictureCrops, Source


class TrainingStream(Dataset[Any]):
    """The samples of an arm by their number.

    Args:
        real: samples of real frames; needed if ``augmented`` is below 1.
        pictures: samples made from sRGB pictures; needed if ``augmented`` is above 0.
        batch: samples in a step.
        augmented: share of every batch, from 0 to 1, that is made from pictures; these come first.
        seed: seed of all samples.
    """

    def __init__(
        self, real: Source | None, pictures: Source | RawPairs | None, batch: int, augmented: float, seed: int
    ) -> None:
        if isinstance(pictures, RawPairs):
            pictures = PictureCrops(pictures)
        self.real = real
        self.pictures = pictures
        self.batch = batch
        self.seed = seed
        self.from_pictures = round(augmented * batch)

        if self.from_pictures and pictures is None:
            raise ValueError("an augmented arm needs sRGB pictures; set data.pictures")
        if self.from_pictures < batch and real is None:
            raise ValueError("this arm needs real pairs; set data.pairs")

    def leave_pairs_to(self, device: torch.device) -> Callable[[Tensor, AugmentParams], Sample] | None:
        """Leave the pairs to a device, see :class:`PictureCrops`; None if not all samples are pairs of pictures."""
        if self.from_pictures < self.batch or not isinstance(self.pictures, PictureCrops):
            return None
        return self.pictures.leave_pairs_to(device)

    def __getitem__(self, index: int) -> Any:
        source = self.real
        if self._is_of_picture(index):
            source = self.pictures
        assert source is not None
        return source.draw(self._generator(index))

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        """Draw the samples of a step; those of pictures are drawn together if their source can do so."""
        of_pictures = list(filter(self._is_of_picture, indices))
        draw_batch = getattr(self.pictures, "draw_batch", None)

        samples: dict[int, Any] = {}
        if draw_batch is not None and of_pictures:
            batch = draw_batch(list(map(self._generator, of_pictures)))
            samples.update(zip(of_pictures, batch, strict=True))

        for index in indices:
            if index not in samples:
                samples[index] = self[index]
        return [samples[index] for index in indices]

    def _is_of_picture(self, index: int) -> bool:
        return index % self.batch < self.from_pictures

    def _generator(self, index: int) -> torch.Generator:
        return keyed_generator(self.seed, "stream", index)


class StepSampler(Sampler[list[int]]):
    """The numbers of the samples of each step; each of several processes takes every ``world``-th.

    Args:
        start: the first step.
        steps: the step to stop before.
        batch: samples in a step, over all processes.
        rank: number of this process.
        world: number of processes, which must divide ``batch``.
    """

    def __init__(self, start: int, steps: int, batch: int, rank: int = 0, world: int = 1) -> None:
        if batch % world:
            raise ValueError(f"train.batch={batch} must be a multiple of the number of processes, {world}")
        self.start = start
        self.steps = steps
        self.batch = batch
        self.rank = rank
        self.world = world

    def __len__(self) -> int:
        return self.steps - self.start

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start, self.steps):
            first = step * self.batch
            yield list(range(first + self.rank, first + self.batch, self.world))
