"""PSNR_d: a denoiser trained on a method's RAW from sRGB pictures, scored on real RAW.

Pictures, network, steps and noise are the same for every method; what differs is the way from sRGB to RAW. The
dictionary ISP draws camera settings from its hull, UPI from its published distributions; a network has one answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from denoisers import Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.folders import skip_broken
from rawaug.data.pairs import Sample, SomePairs
from rawaug.denoise.denoiser import RawDenoiser
from rawaug.evaluation.scores import Row, score
from rawaug.evaluation.trials import Trial, trial_of
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import as_float
from rawaug.noise import NoiseModel, noise_model
from rawaug.paper.methods import Method
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.seeding import derive_seed, keyed_generator
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train
from rawaug.training.stream import PictureCrops, Source, TrainingStream

WATCHED = 16
"""Samples made from the pictures on which training is watched."""
SHORTEST_CROP = 256


@dataclass
class DownstreamConfig:
    """The denoising experiment.

    Args:
        methods: families to compare.
        test: RAW frames of unseen cameras; folders, or ``kind:path``.
        test_crop: side of the central crop scored of each test frame; null for the whole frame.
        test_count: number of frames of each of ``test``; null for all.
        bin: K bins them K x K by colour site: clean references of real photographs.
        exposure: lowest and highest exposure in stops at which the RAW of a fitted ISP is drawn, for the test cameras'
            headroom is not known; ISPs of published cameras and UPI's published distributions have their own.
        noise: preset, in training and on the test frames.
        denoiser: the network.
        train: the loop.
    """

    methods: list[str] = field(default_factory=lambda: ["dictionary", "upi"])
    test: list[str] = field(default_factory=lambda: ["demo:test"])
    test_crop: int | None = 1024
    test_count: int | None = None
    bin: int = 1
    exposure: tuple[float, float] | None = (-1.5, 0.0)
    noise: str = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def shortest(self) -> DownstreamConfig:
        """One step, one small test frame."""
        one = replace(self.train, steps=1, batch=2, warmup=1, validate_every=1, checkpoint_every=1)
        return replace(self, test_crop=SHORTEST_CROP, test_count=1, train=one)


class DownstreamScore(NamedTuple):
    """PSNR in dB."""

    psnr: float
    psnr_srgb: float


def mean_of(scores: Sequence[Row]) -> DownstreamScore:
    """The mean over frames; sRGB over those that can be developed."""
    developed = [score.psnr_srgb for score in scores if score.psnr_srgb is not None]
    return DownstreamScore(fmean(score.psnr for score in scores), fmean(developed))


def psnr_d(model: Method, pictures: Sequence[Tensor], config: DownstreamConfig, place: Path, seed: int) -> float:
    """Train a denoiser on what ``model`` makes of ``pictures``; its mean PSNR on the test frames."""
    net = trained_on(_crops(model, pictures, noise_model(config.noise), config), config, place, seed)
    return score_on(net, config, CFA(model.cfa)).psnr


def trained_on(crops: Source, config: DownstreamConfig, place: Path, seed: int) -> Denoiser:
    """A denoiser trained on these samples."""
    stream = TrainingStream(None, crops, config.train.batch, 1.0, derive_seed(seed, "downstream"))
    drawn = (crops.draw(keyed_generator("watched", k)) for k in range(WATCHED))
    watched = [Trial(s.noisy[None], s.clean[None], s.variance[None]) for s in drawn]
    folder = place / f"seed{seed}"
    return train(stream, watched, config.denoiser, config.train, folder, seed, label=f"{place.name} {seed}")


def score_on(net: Denoiser, config: DownstreamConfig, cfa: CFA) -> DownstreamScore:
    """Mean scores on the test frames; their noise is frozen with seed 0."""
    opened = ((open_pairs(spec, split="test", bin=config.bin), spec) for spec in config.test)
    chosen = ((SomePairs(found, range(len(found))[: config.test_count]), spec) for found, spec in opened)
    pairs = (pair for frames, spec in chosen for pair in skip_broken(frames, spec))
    noise, denoiser = noise_model(config.noise), RawDenoiser.of(net, cfa=cfa)
    frames = [pair.middle(config.test_crop) if config.test_crop else pair for pair in pairs]
    return mean_of(list(score([denoiser], (trial_of(pair, noise, cfa) for pair in frames), "PSNR_d")))


def _crops(model: Method, pictures: Sequence[Tensor], noise: NoiseModel, config: DownstreamConfig) -> Source:
    if not isinstance(model, DictionaryISP):
        return MadeCrops(pictures, model.draw, model.cfa, noise, config.train.crop)
    # The plugin keeps each crop's place in its frame.
    draw = Draw(exposure=None if model.config.cameras else config.exposure)
    augment = RawAugment(model, noise, draw=draw)
    return PictureCrops(RawPairs(pictures, augment, config.train.crop))


class MadeCrops:
    """Crops of pictures, turned at random, made RAW by any function."""

    def __init__(
        self,
        pictures: Sequence[Tensor],
        make: Callable[[Tensor, torch.Generator], Tensor],
        cfa: CFA,
        noise: NoiseModel,
        crop: int,
    ) -> None:
        self.pictures, self.make, self.cfa, self.noise = pictures, make, cfa, noise
        self.crop = bayer.RandomCrop(crop)

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> Sample:
        picture = self.pictures[int(torch.randint(len(self.pictures), (), generator=generator))]
        patch = bayer.RandomTurn(self.cfa, keep_cfa=False)(self.crop(picture, generator), generator)
        clean = bayer.pack(self.make(as_float(patch[None]), generator).clamp(0.0, 1.0), self.cfa)
        params = self.noise.sample(1, generator)
        noisy = self.noise.apply(clean, params)
        return Sample(noisy[0], clean[0], self.noise.variance(noisy, params)[0])
