"""The stream of training samples: sample i depends on (seed, i) alone, so any step can be repeated.

A batch is part real crops (clean RAW of the few pairs with its captured noise, or with drawn noise where none was
captured; or of frames that are only known noisy), part RAW made from sRGB pictures.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair, Sample
from rawaug.noise import NoiseModel
from rawaug.plugin.dataset import RawPairs
from rawaug.seeding import keyed_generator


class Source(Protocol):
    """Where samples come from."""

    def draw(self, generator: torch.Generator) -> Any:
        """A training sample, a named tuple of tensors, that depends on ``generator`` alone."""
        ...


class RealCrops:
    """Crops of real RAW pairs, in eight turns that keep the CFA."""

    def __init__(self, pairs: Sequence[Pair], noise: NoiseModel, crop: int, cfa: CFA) -> None:
        self.pairs = [pair.with_levels() for pair in pairs]
        self.noise, self.crop, self.cfa = noise, crop, cfa

    def draw(self, generator: torch.Generator) -> Sample:
        pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))]
        mosaics = [pair.raw] if pair.noisy is None else [pair.raw, pair.noisy]
        packed = packed_crop(pair.name, mosaics, pair.cfa, self.crop, self.cfa, generator)
        params = self.noise.sample(1, generator)
        if pair.noisy is not None:
            params = {"shot_var": torch.tensor([pair.shot_var]), "read_var": torch.tensor([pair.read_var])}
            clean, noisy = packed[:1], packed[1:]
            level = bayer.noise_variance(noisy, params["shot_var"], params["read_var"])
            return Sample(noisy[0], clean[0], level[0])
        noisy = self.noise.apply(packed, params)
        return Sample(noisy[0], packed[0], self.noise.variance(noisy, params)[0])


class PictureCrops:
    """Samples of :class:`rawaug.RawPairs` in any target; zeros stand for the noise map where there is none."""

    def __init__(self, pairs: RawPairs) -> None:
        self.pairs = pairs

    def draw(self, generator: torch.Generator) -> Sample:
        return self.draw_batch([generator])[0]

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
        """One crop for each generator, all made together."""
        indices = [int(torch.randint(len(self.pairs), (), generator=generator)) for generator in generators]
        pair = self.pairs.draw_batch(indices, generators)
        variance = pair.variance if pair.variance.numel() else torch.zeros_like(pair.noisy)
        return [Sample(*tensors) for tensors in zip(pair.noisy, pair.clean, variance, strict=True)]


def packed_crop(
    name: str, mosaics: Sequence[Tensor], own: CFA, crop: int, cfa: CFA, generator: torch.Generator
) -> Tensor:
    """One random place of mosaics ``(C, H, W)`` of pattern ``own``, in one of eight turns, packed in that of ``cfa``.

    Returns ``(sum of C, 4, crop / 2, crop / 2)``.
    """
    height, width = mosaics[0].shape[-2:]
    if min(height, width) < crop + 6:
        raise ValueError(f"{name}: a frame of {height} x {width} is too small for train.crop={crop}")
    mosaics = [bayer.crop_to_cfa(mosaic, own, cfa) for mosaic in mosaics]
    side = crop + 4  # turned, then cut to size, so that lines lost to the CFA do not show
    top, left = (2 * int(torch.randint((n - side) // 2 + 1, (), generator=generator)) for n in mosaics[0].shape[-2:])
    view = int(torch.randint(bayer.N_VIEWS, (), generator=generator))
    images = torch.cat([bayer.crop(mosaic, top, left, side, side) for mosaic in mosaics])
    turned = bayer.turn_keeping_cfa(images, cfa, view)
    return bayer.pack(bayer.crop(turned, 0, 0, crop, crop)[:, None], cfa)


class TrainingStream(Dataset[Any]):
    """Sample i of an arm: the first ``augmented`` of every batch from pictures, the rest real."""

    def __init__(
        self, real: Source | None, pictures: Source | RawPairs | None, batch: int, augmented: float, seed: int
    ) -> None:
        self.real, self.batch, self.seed = real, batch, seed
        self.pictures = PictureCrops(pictures) if isinstance(pictures, RawPairs) else pictures
        self.from_pictures = round(augmented * batch)
        if self.from_pictures and pictures is None:
            raise ValueError("an augmented arm needs sRGB pictures; set data.pictures")
        if self.from_pictures < batch and real is None:
            raise ValueError("this arm needs real pairs; set data.pairs")

    def __getitem__(self, index: int) -> Any:
        source = self.pictures if self._pictured(index) else self.real
        assert source is not None
        return source.draw(self._generator(index))

    def __getitems__(self, indices: Sequence[int]) -> list[Any]:
        made: dict[int, Any] = {}
        if isinstance(self.pictures, PictureCrops) and (pictured := [*filter(self._pictured, indices)]):
            made = dict(zip(pictured, self.pictures.draw_batch([*map(self._generator, pictured)]), strict=True))
        return [made[index] if index in made else self[index] for index in indices]

    def _pictured(self, index: int) -> bool:
        return index % self.batch < self.from_pictures

    def _generator(self, index: int) -> torch.Generator:
        return keyed_generator(self.seed, "stream", index)


class StepSampler(Sampler[list[int]]):
    """The samples of each step from ``start`` on; of several processes each takes every ``world``-th."""

    def __init__(self, start: int, steps: int, batch: int, rank: int = 0, world: int = 1) -> None:
        if batch % world:
            raise ValueError(f"train.batch={batch} must be a multiple of the number of processes, {world}")
        self.start, self.steps, self.batch, self.rank, self.world = start, steps, batch, rank, world

    def __len__(self) -> int:
        return self.steps - self.start

    def __iter__(self) -> Iterator[list[int]]:
        for step in range(self.start, self.steps):
            yield [step * self.batch + position for position in range(self.rank, self.batch, self.world)]
