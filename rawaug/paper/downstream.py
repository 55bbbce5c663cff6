"""PSNR_d, the PSNR on real RAW of a denoiser that is trained on the RAW that a method makes of sRGB pictures.

Pictures, network, steps and noise are the same for every method. The dictionary ISP draws camera settings from its
hull, and UPI draws them from its published distributions; a network has only one answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from denoisers import Denoiser
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.frames import skip_broken
from rawaug.data.pairs import Sample
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import Row, score
from rawaug.evaluation.trials import Trial, make_trial
from rawaug.isp.functional import as_float
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.paper.baselines.base import BaselineISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw, Sampling
from rawaug.seeding import derive_seed
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train
from rawaug.training.sources import PictureCrops, Source, add_noise, freeze_samples
from rawaug.training.stream import TrainingStream

SHORTEST_CROP = 256
"""Side in pixels of the part of a test frame that a dry run scores."""


@dataclass
class DownstreamConfig:
    """The settings by which PSNR_d is measured.

    Args:
        methods: the families for which it is measured.
        test: RAW frames of unseen cameras; folders, or ``kind:path``.
        test_crop: side of the central crop scored of each test frame; null for the whole frame.
        test_count: number of frames of each of ``test``; null for all.
        bin: K bins these frames K x K by colour site, for clean references of real photographs.
        sampling: how the camera settings of a fitted ISP are drawn, see :class:`rawaug.plugin.draw.Draw`.
        exposure: lowest and highest exposure in stops at which the RAW of a fitted ISP is drawn, since the test
            cameras' headroom is not known; ISPs of published cameras and UPI's published distributions have their own.
        noise: preset of the noise, in training and on the test frames.
        denoiser: the network.
        train: the loop.
    """

    methods: list[str] = field(default_factory=lambda: ["dictionary", "upi"])
    test: list[str] = field(default_factory=lambda: ["demo:test"])
    test_crop: int | None = 1024
    test_count: int | None = None
    bin: int = 1
    sampling: Sampling = "convex"
    exposure: tuple[float, float] | None = (-1.5, 0.0)
    noise: str = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)

    def shortest(self) -> DownstreamConfig:
        """Take one step and one small test frame."""
        train = replace(self.train, steps=1, batch=2, warmup=1, validate_every=1, checkpoint_every=1)
        return replace(self, test_crop=SHORTEST_CROP, test_count=1, train=train)


def psnr_d(
    model: BaselineISP | DictionaryISP,
    pictures: Sequence[Tensor],
    config: DownstreamConfig,
    folder: Path,
    seed: int,
    key: str = "",
) -> float:
    """Measure the mean PSNR in dB, on the test frames, of a denoiser that is trained on a method's RAW.

    Args:
        model: makes the RAW.
        pictures: uint8 sRGB ``(3, H, W)``.
        config: network, loop, noise and test frames.
        folder: folder of the training's files, with one folder for each seed, from which a stopped training resumes.
        seed: seed of the training.
        key: hash of what the weights depend on besides the seed; files of a training with another key are replaced.
    """
    crops = synthesise_crops(model, pictures, noise_model(config.noise), config)
    net = train_on(crops, config, folder, seed, key)
    rows = score_on(net, config, CFA(model.cfa))
    return fmean(row.psnr for row in rows)


def train_on(crops: Source, config: DownstreamConfig, folder: Path, seed: int, key: str = "") -> Denoiser:
    """Train a denoiser on ``crops``; the other arguments are as in :func:`psnr_d`."""
    stream = TrainingStream(None, crops, config.train.batch, 1.0, derive_seed(seed, "downstream"))
    samples = freeze_samples(crops, "watched")
    label = f"{folder.name} {seed}"
    return train(stream, samples, config.denoiser, config.train, folder / f"seed{seed}", seed, label=label, key=key)


def score_on(net: Denoiser, config: DownstreamConfig, cfa: CFA) -> list[Row]:
    """Score a network on the test frames, whose noise is frozen with seed 0; ``cfa`` is the network's."""
    noise = noise_model(config.noise)
    denoiser = RawDenoiser.of(net, cfa=cfa)

    trials: list[Trial] = []
    for spec in config.test:
        every = open_pairs(spec, split="test", bin=config.bin)
        frames = every.some(range(len(every))[: config.test_count])
        for pair in skip_broken(frames, spec):
            if config.test_crop is not None:
                pair = pair.middle(config.test_crop)
            trials.append(make_trial(pair, noise, cfa))
    return list(score([denoiser], trials, "PSNR_d"))


def synthesise_crops(
    model: BaselineISP | DictionaryISP, pictures: Sequence[Tensor], noise: NoiseModel, config: DownstreamConfig
) -> Source:
    """Make the training samples that a method gives for pictures."""
    if isinstance(model, BaselineISP):
        return MadeCrops(pictures, model.draw, model.cfa, noise, config.train.crop)

    # The plugin keeps each crop's place in its frame.
    draw = Draw(config.sampling)
    if not model.config.cameras:
        draw = replace(draw, exposure=config.exposure)
    return PictureCrops(RawPairs(pictures, RawAugment(model, noise, draw=draw), config.train.crop))


class MadeCrops:
    """Crops of pictures, turned at random and made into RAW by any function.

    Args:
        pictures: uint8 sRGB ``(3, H, W)``.
        make: maps float sRGB ``(1, 3, h, w)`` and a generator to a mosaic ``(1, 1, h, w)``.
        cfa: the pattern of these mosaics.
        noise: the noise that is drawn for each crop.
        crop: side of the crops in pixels.
    """

    def __init__(
        self,
        pictures: Sequence[Tensor],
        make: Callable[[Tensor, torch.Generator], Tensor],
        cfa: CFA,
        noise: NoiseModel,
        crop: int,
    ) -> None:
        self.pictures = pictures
        self.make = make
        self.cfa = cfa
        self.noise = noise
        self.crop = bayer.RandomCrop(crop)
        self.turn = bayer.RandomView(cfa, keep_cfa=False)

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample of packed RAW ``(4, crop / 2, crop / 2)``."""
        index = int(torch.randint(len(self.pictures), (), generator=generator))
        patch = self.turn(self.crop(self.pictures[index], generator), generator)
        raw = self.make(as_float(patch[None]), generator).clamp(0.0, 1.0)
        clean = bayer.pack(raw, self.cfa)
        return add_noise(clean, self.noise, generator)
