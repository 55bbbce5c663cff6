"""Sources of training samples: crops of real frames, of pictures as RAW, and of pictures as mosaics of any pattern."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy, deepcopy
from functools import partial
from operator import itemgetter
from statistics import fmean
from typing import Any, Protocol

import torch
from torch import Tensor

from denoisers.mosaic import entry_pattern, with_planes
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair, Sample
from rawaug.evaluation.trials import Trial
from rawaug.metrics import psnr
from rawaug.noise import NoiseModel
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.maker import PairMaker
from rawaug.plugin.params import AugmentParams
from rawaug.seeding import keyed_generator

WATCHED = 16
"""This many samples are made from pictures to watch a training without validation pairs."""


class Source(Protocol):
    """A source of samples; one with a ``draw_batch(generators)`` makes all samples of a step together."""

    def draw(self, generator: torch.Generator) -> Any:
        """Draw a training sample, a named tuple of tensors ``(C, h, w)``, which depends only on ``generator``."""
        ...


def freeze_samples(source: Source, key: str) -> list[Trial]:
    """Draw :data:`WATCHED` samples of a source as trials, the same for the same ``key``."""
    trials = []
    for k in range(WATCHED):
        sample = source.draw(keyed_generator(key, k))
        trials.append(Trial(sample.noisy[None], sample.clean[None], sample.variance[None]))
    return trials


_CALIBRATED_ON = 1024
"""This many samples are drawn to set the noise by the PSNR of the pairs."""


def draw_statistics(source: Source) -> tuple[list[float], float]:
    """Measure samples of a source: the mean signal of each one's clean RAW, and the mean PSNR of the pairs in dB."""
    signals, decibels = [], []
    for k in range(_CALIBRATED_ON):
        sample = source.draw(keyed_generator("pair_psnr", k))
        signals.append(float(sample.clean.mean().clamp(1e-6, 1.0)))
        decibels.append(psnr(sample.noisy[None], sample.clean[None]).item())
    return signals, fmean(decibels)


def add_noise(clean: Tensor, noise: NoiseModel, generator: torch.Generator) -> Sample:
    """Draw noise for clean packed RAW ``(1, 4, h, w)``, which makes a sample of ``(4, h, w)``."""
    params = noise.sample(1, generator)
    noisy = noise.apply(clean, params)
    return Sample(noisy[0], clean[0], noise.variance(noisy, params)[0])


class RealCrops:
    """Crops of real RAW pairs, in eight views that keep the CFA.

    Args:
        pairs: clean frames, with or without a noisy capture.
        noise: the noise drawn for frames without a capture.
        crop: side of the crops in pixels.
        cfa: the pattern in which all crops are packed.
    """

    def __init__(self, pairs: Sequence[Pair], noise: NoiseModel, crop: int, cfa: CFA) -> None:
        self.pairs = [pair.with_levels() for pair in pairs]
        self.noise = noise
        self.crop = crop
        self.cfa = cfa

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample of packed RAW ``(4, crop / 2, crop / 2)``."""
        pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))]
        if pair.noisy is None:
            packed = packed_crop(pair.name, [pair.clean.mosaic], pair.cfa, self.crop, self.cfa, generator)
            return add_noise(packed, self.noise, generator)

        mosaics = [pair.clean.mosaic, pair.noisy.mosaic]
        clean, noisy = packed_crop(pair.name, mosaics, pair.cfa, self.crop, self.cfa, generator)
        assert pair.noisy.noise_profile is not None  # all pairs have been asked for their levels
        shot_var, read_var = pair.noisy.noise_profile
        variance = bayer.noise_variance(noisy, torch.tensor(shot_var), torch.tensor(read_var))
        return Sample(noisy, clean, variance)


class PictureCrops:
    """Samples of :class:`rawaug.RawPairs` in any target; zeros stand for the noise map if there is none.

    After :meth:`leave_pairs_to` a sample is a crop of a picture and the parameters of its pair, which are a quarter of
    the pair's bytes.
    """

    def __init__(self, pairs: RawPairs) -> None:
        self.pairs = pairs
        self._cuts_only = False

    def draw(self, generator: torch.Generator) -> Any:
        """Draw a sample of one crop, ``(C, h, w)`` as the target has it."""
        return self.draw_batch([generator])[0]

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Any]:
        """Draw one crop for each generator, all made together."""
        indices = [int(torch.randint(len(self.pairs), (), generator=generator)) for generator in generators]
        crops, params = self.pairs.cut_batch(indices, generators)
        if not self._cuts_only:
            return list(map(Sample, *_make_pairs(self.pairs.augment, crops, params)))

        samples = []
        for number, crop in enumerate(crops):
            samples.append((crop, params.map(itemgetter(number))))
        return samples

    def leave_pairs_to(self, device: torch.device) -> Callable[[Tensor, AugmentParams], Sample]:
        """Draw no more than crops and parameters from now on; return what makes a batch of pairs of them on a device.

        The pairs are those that were drawn before, up to the last bits in which two kinds of device differ.
        """
        self._cuts_only = True
        return partial(_make_pairs, deepcopy(self.pairs.augment).to(device))


def _make_pairs(augment: PairMaker, crops: Tensor, params: AugmentParams) -> Sample:
    """Make the pairs of crops ``(B, 3, h, w)``, on their device; zeros stand for the noise map if there is none."""
    pair = augment.apply(crops, params)
    variance = pair.variance
    if not variance.numel():
        variance = torch.zeros_like(pair.noisy)
    return Sample(pair.noisy, pair.clean, variance)


class OwnPictureCrops:
    """The real pairs' own pictures as RAW, in eight views.

    A rendering is as sharp as the readings at the sites of its sensor and as soft as its demosaicing between them. So
    crops begin where, once turned, the RAW lies at the sites that were read.

    Args:
        pairs: frames with their pictures.
        augment: an augmentation of a Bayer pattern.
        crop: side of the crops in pixels.
    """

    def __init__(self, pairs: Sequence[Pair], augment: RawAugment, crop: int) -> None:
        self.pairs = list(pairs)
        self.augment = augment
        self.crop = crop

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample of packed RAW ``(4, crop / 2, crop / 2)``."""
        return self.draw_batch([generator])[0]

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
        """Draw one crop for each generator, all made together."""
        patches, parameters = [], []
        for generator in generators:
            pair = self.pairs[int(torch.randint(len(self.pairs), (), generator=generator))]
            patch, place = self.draw_patch(pair, generator)
            patches.append(patch[None])
            chosen = self.augment.look(pair.srgb)
            params = self.augment.sample(patch[None], generator, place[None], chosen)
            params.extras.pop("blur", None)  # a camera's own pictures are as soft as it is
            parameters.append(params)

        pairs = self.augment.apply(torch.cat(patches), AugmentParams.concatenate(parameters))
        return list(map(Sample, pairs.noisy, pairs.clean, pairs.variance))

    def draw_patch(self, pair: Pair, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Cut a patch ``(3, crop, crop)`` out of a pair's picture, turned, with its place as AugmentParams keep it."""
        height, width = pair.srgb.shape[-2:]
        view = int(torch.randint(bayer.N_VIEWS, (), generator=generator))
        before_turn = next(cfa for cfa in CFA if cfa.turn(view) == CFA(self.augment.cfa))
        row, column = pair.cfa.shift_to(before_turn)

        top = row + 2 * int(torch.randint((height - row - self.crop) // 2 + 1, (), generator=generator))
        left = column + 2 * int(torch.randint((width - column - self.crop) // 2 + 1, (), generator=generator))
        patch = pair.srgb[:, top : top + self.crop, left : left + self.crop]
        return bayer.turn(patch, view), torch.tensor([top, left, height, width, view])


class MosaicCrops:
    """Crops of pictures as RAW of a pattern drawn by its share, with the planes of its colours, from any of its cells.

    Args:
        pictures: a Dataset of pictures.
        augment: an augmentation of a Bayer pattern; noise of planes is then that of the four sites of every 2 x 2
            square.
        crop: side in pixels.
        zoom: see :class:`rawaug.RawPairs`.
        patterns: shares of patterns by name.
    """

    def __init__(
        self, pictures: Any, augment: RawAugment, crop: int, zoom: float, patterns: Mapping[str, float]
    ) -> None:
        self.crop = crop
        self.patterns = [entry_pattern(bayer.pattern(name)) for name in patterns]
        self.shares = torch.tensor(list(patterns.values()))

        margin = max(pattern.period for pattern in self.patterns)
        self.pairs = []
        for pattern in self.patterns:
            of_pattern = copy(augment)
            of_pattern.pattern = pattern
            self.pairs.append(RawPairs(pictures, of_pattern, crop + margin, zoom=zoom))

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample: noisy RAW and planes ``(4, crop, crop)``, clean RAW and variance ``(1, crop, crop)``."""
        number = int(torch.multinomial(self.shares, 1, generator=generator))
        pairs, pattern = self.pairs[number], self.patterns[number]
        pair = pairs.draw(int(torch.randint(len(pairs), (), generator=generator)), generator)

        cell = 2 * torch.randint(pattern.period // 2, (2,), generator=generator)
        row, column = cell.tolist()
        window = (..., slice(row, row + self.crop), slice(column, column + self.crop))

        noisy = with_planes(pair.noisy[None], pattern)[0]
        return Sample(noisy[window], pair.clean[window], pair.variance[window])


def packed_crop(
    name: str, mosaics: Sequence[Tensor], own: CFA, crop: int, cfa: CFA, generator: torch.Generator
) -> Tensor:
    """Cut one random part out of all mosaics of a frame, in one of eight views, and pack it.

    Args:
        name: name of the frame.
        mosaics: the mosaics, each ``(C, H, W)``, of the pattern ``own``.
        own: their pattern.
        crop: side in pixels.
        cfa: the pattern in which the result is packed.
        generator: draws the part and the turn.

    Returns:
        ``(sum of C, 4, crop / 2, crop / 2)``.

    Raises:
        ValueError: if the frame is too small.
    """
    height, width = mosaics[0].shape[-2:]
    if min(height, width) < crop + 6:
        raise ValueError(f"{name}: a frame of {height} x {width} is too small for train.crop={crop}")

    mosaics = [bayer.crop_to_cfa(mosaic, own, cfa) for mosaic in mosaics]
    height, width = mosaics[0].shape[-2:]

    side = crop + 4  # turned, then cut to size, so that lines lost to the CFA do not matter
    row = 2 * int(torch.randint((height - side) // 2 + 1, (), generator=generator))
    column = 2 * int(torch.randint((width - side) // 2 + 1, (), generator=generator))
    view = int(torch.randint(bayer.N_VIEWS, (), generator=generator))

    parts = torch.cat([bayer.crop(mosaic, row, column, side, side) for mosaic in mosaics])
    turned = bayer.pattern(cfa).turn_keeping(parts, view)
    return bayer.pack(bayer.crop(turned, 0, 0, crop, crop)[:, None], cfa)
