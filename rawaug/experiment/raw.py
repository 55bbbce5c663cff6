"""RAW: networks take packed noisy RAW and return packed RAW, trained on real frames, on pictures, or on both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import nn

from rawaug.bayer import CFA
from rawaug.data.frames import OWN_PICTURES
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.trials import Trial, make_trial, make_trials
from rawaug.experiment.task import TASKS, Task, change_cfa
from rawaug.noise import CalibratedNoise, NoiseModel
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.seeding import derive_seed
from rawaug.training.estimators import ESTIMATORS, SelfSupervised
from rawaug.training.noisy_frames import FrozenPictures, NoisyCrops, r2r_trials
from rawaug.training.sources import (
    WATCHED,
    OwnPictureCrops,
    PictureCrops,
    RealCrops,
    Source,
    draw_statistics,
    freeze_samples,
)
from rawaug.training.stream import TrainingStream


@TASKS.register("raw")
class RawTask(Task):
    """Denoisers of RAW in one of Bayer's patterns, trained with clean targets or on noisy frames alone."""

    def stream(self, arm: str, cfa: CFA, seed: int) -> TrainingStream:
        """Make crops of the frames, and of pictures as RAW, in the arm's shares."""
        settings = self.recipe.arms[arm]
        train = self.recipe.loop(arm)
        seed = derive_seed(seed, "stream")
        estimator = ESTIMATORS.make(settings.estimator)

        augment = None
        if settings.augmented:
            draw = settings.draw or self.recipe.draw
            augment = RawAugment(
                change_cfa(self.isp, cfa), self.noise, draw=draw, target=settings.srgb or self.recipe.target
            )

        real: Source | None = None
        synthetic: Source | None = None
        if isinstance(estimator, SelfSupervised):
            if self.real and settings.augmented < 1.0:
                real = NoisyCrops(self.real, estimator, train.crop, cfa)
            if augment is not None:
                pictures = self.frames["pictures"]
                frozen = FrozenPictures(pictures, augment, derive_seed(seed, "pictures"), estimator.shots)
                synthetic = NoisyCrops(frozen, estimator, train.crop, cfa)
        else:
            noise = self.noise
            if self.real:
                real = RealCrops(self.real, noise, train.crop, cfa)
            if augment is not None:
                synthetic = self.synthetic_crops(arm, augment, noise)
                if isinstance(noise, CalibratedNoise) and noise.is_typical:
                    signals, _ = draw_statistics(synthetic)
                    noise = noise.at_signals(signals)
                    augment = augment.with_draws(noise, settings.draw or self.recipe.draw)
                    synthetic = self.synthetic_crops(arm, augment, noise)
                    _, decibels = draw_statistics(synthetic)
                    print(f"{arm}: noisy crops have a mean PSNR of {decibels:.2f} dB")

        return TrainingStream(real, synthetic, train.batch, settings.augmented, seed)

    def synthetic_crops(self, arm: str, augment: RawAugment, noise: NoiseModel) -> Source:
        """Make the samples that join the real crops of a supervised arm, from its ``source``."""
        settings, crop = self.recipe.arms[arm], self.recipe.train.crop
        if settings.source == "own":
            return OwnPictureCrops(self.real, augment, crop)
        if settings.source == "more":
            return RealCrops(self.frames["more"], noise, crop, augment.isp.cfa)
        if settings.source == "noise":
            clean = [replace(pair, noisy=None, noisy_srgb=None) for pair in self.real]
            return RealCrops(clean, noise, crop, augment.isp.cfa)

        if self.recipe.data.pictures == OWN_PICTURES and settings.zoom == 1.0:
            return OwnPictureCrops(self.real, augment, crop)
        return PictureCrops(RawPairs(self.frames["pictures"], augment, crop, zoom=settings.zoom))

    def validation(self, cfa: CFA) -> Sequence[Trial]:
        """Take frames with frozen noise, or as r2r pairs if no arm sees clean ones; without any, pictures as RAW."""
        if self.watched and not self.recipe.self_supervised:
            return [make_trial(pair, self.noise, cfa) for pair in self.watched]

        isp = change_cfa(self.isp, cfa)
        augment = RawAugment(isp, self.noise, draw=self.recipe.draw, target=self.recipe.target)
        pictures = self.frames["pictures"]
        if self.recipe.self_supervised:
            frozen = self.watched or FrozenPictures(pictures, augment, derive_seed("validation"))[:WATCHED]
            return r2r_trials(frozen, cfa)

        return freeze_samples(PictureCrops(RawPairs(pictures, augment, self.recipe.train.crop)), "validation")

    def test(self) -> Sequence[Trial]:
        """Take the frames with captured or frozen noise, in the pattern of the ISP."""
        return make_trials(self.frames["test"], lambda pair: make_trial(pair, self.noise, self.isp.cfa))

    def denoiser(self, name: str, network: nn.Module, cfa: CFA, views: int = 1) -> RawDenoiser:
        """Make a denoiser of the network, in tiles, for its own pattern."""
        return RawDenoiser.of(network, self.recipe.device, name=name, cfa=cfa, views=views, checked=False)
