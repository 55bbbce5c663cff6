"""Whether five whole frames beat augmentation in a short training: one suspect changed at a time, at equal real crops.

    python -m benchmarks.half_decibel PHOTOS --out RUNS --seed 0 --arms real mixtures more

Every arm but ``real8`` sees two real crops a step, and those with more in a batch have six of elsewhere. The set-up is
a short training in which augmentation has lost: five whole frames of ``phones:``, one of each phone, the ISP fitted to
them, a U-Net of width 8 without a domain, 2,400 steps with a linear loss, weights by ten validation frames, 40 test
frames.

``mixtures`` is what the suspects are changed in: mixtures of the atoms of the fitted ISP, as soft as the frames, with
the noise of the phones. ``more`` and ``noise`` have no picture of elsewhere: what they lose to ``real`` is lost by
sharing a step, not by the RAW that pictures become.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch

from benchmarks.measure import parser
from rawaug.data.pairs import Pair, Sample
from rawaug.experiment.raw import RawTask
from rawaug.experiment.run import run
from rawaug.experiment.settings import ArmConfig, DataConfig, Recipe
from rawaug.experiment.task import TASKS
from rawaug.isp.fit import FitConfig
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.sources import PictureCrops, Source, add_noise

PHONES = ["iPhone 7", "Google Pixel", "Samsung Galaxy S6 Edge", "Motorola Nexus 6", "LG G4"]
STEPS = 2400
LONG = 3
"""Times as many steps in the arms whose names begin with ``long``."""
LENS = 0.6
"""Deviation in pixels of the lens of the frames."""

SOFT = Draw(blur=LENS)
STABILISED = {
    "denoiser": DenoiserConfig("UNet", {"width": 8, "scales": 3, "domain": "anscombe"}),
    "weigh": "stabilised",
}
ARMS = {
    "real8": ArmConfig(),
    "real": ArmConfig(batch=2),
    "noise": ArmConfig(0.75, source="noise"),
    "more": ArmConfig(0.75, source="more"),
    "own": ArmConfig(0.75, source="own", draw=SOFT),
    "mixtures": ArmConfig(0.75, draw=SOFT),
    "sharp": ArmConfig(0.75, draw=Draw(blur=0.0)),
    "as_bright": ArmConfig(0.75, draw=SOFT),
    "their_noise": ArmConfig(0.75, draw=SOFT),
    "tied": ArmConfig(0.75, draw=SOFT),
    "chosen_whole": ArmConfig(0.75, draw=Draw("perturb", blur=LENS)),
    "chosen_crop": ArmConfig(0.75, draw=Draw("perturb", blur=LENS)),
    "normalised": ArmConfig(0.75, draw=SOFT, weigh="normalised"),
    "real_normalised": ArmConfig(batch=2, weigh="normalised"),
    "stabilised": ArmConfig(0.75, draw=SOFT, **STABILISED),  # type: ignore[arg-type]
    "real_stabilised": ArmConfig(batch=2, **STABILISED),  # type: ignore[arg-type]
    "more_stabilised": ArmConfig(0.75, source="more", **STABILISED),  # type: ignore[arg-type]
    "long_real": ArmConfig(batch=2),
    "long_mixtures": ArmConfig(0.75, draw=SOFT),
    "long_more": ArmConfig(0.75, source="more"),
}


class LikeFrames:
    """Samples that are made as bright as the frames, or noisy as they are, or both together.

    Args:
        source: samples of pictures.
        pairs: the frames.
        how: ``as_bright`` multiplies a sample so that its mean, on average, is the frames'; ``their_noise`` draws the
            levels of one of them; ``tied`` takes those of the frame whose brightness is next to the sample's.
    """

    def __init__(self, source: Source, pairs: Sequence[Pair], how: str, noise: NoiseModel) -> None:
        self.source, self.how, self.noise = source, how, noise
        self.levels = []
        for pair in pairs:
            levels = None if pair.noisy is None else pair.noisy.noise_profile
            self.levels.append(levels or (0.0, 0.0))
        self.stops = [math.log2(pair.clean.mosaic.mean()) for pair in pairs]

        stops = [self.measure(source.draw(torch.Generator().manual_seed(seed))) for seed in range(500)]
        self.shift = fmean(self.stops) - fmean(stops)
        print(f"{how}: the frames are at {fmean(self.stops):.2f} stops, samples {-self.shift:+.2f} from there")

    @staticmethod
    def measure(sample: Sample) -> float:
        """Measure how bright a sample is, in stops from white."""
        return math.log2(sample.clean.mean().clamp_min(1e-4))

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample, with noise that is drawn anew."""
        sample = self.source.draw(generator)
        clean, noise = sample.clean[None], self.noise
        if self.how == "as_bright":
            clean = (clean * 2.0**self.shift).clamp(max=1.0)
        if self.how == "their_noise":
            noise = noise_model(self.levels[int(torch.randint(len(self.levels), (), generator=generator))])
        if self.how == "tied":
            stops = self.measure(sample)
            nearest = min(range(len(self.stops)), key=lambda k: abs(self.stops[k] - stops))
            noise = noise_model(self.levels[nearest])
        return add_noise(clean, noise, generator)


class CropChoice(PictureCrops):
    """Crops of pictures whose setting is chosen on the crop instead of the whole picture."""

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
        """Draw one crop for each generator."""
        samples = []
        for generator in generators:
            index = int(torch.randint(len(self.pairs), (), generator=generator))
            _, patches, places, _ = self.pairs._cut([index], [generator])
            augment = self.pairs.augment
            assert isinstance(augment, RawAugment)
            crop = patches[0][None]
            params = augment.sample(crop, generator, places[0][None], augment.settings.choose(crop.float() / 255.0))
            pair = augment.apply(crop, params)
            samples.append(Sample(pair.noisy[0], pair.clean[0], pair.variance[0]))
        return samples


@TASKS.register("half_decibel")
class HalfDecibel(RawTask):
    """The arms that no recipe can state."""

    def synthetic_crops(self, arm: str, augment: RawAugment, noise: NoiseModel) -> Source:
        """Make the samples of the arm."""
        if arm == "chosen_crop":
            return CropChoice(RawPairs(self.frames["pictures"], augment, self.recipe.train.crop))
        source = super().synthetic_crops(arm, augment, noise)
        if arm in ("as_bright", "their_noise", "tied"):
            return LikeFrames(source, self.real, arm, noise)
        return source


class HalfDecibelRecipe(Recipe):
    """A recipe of this task."""

    kind = "half_decibel"


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("photographs", type=Path)
    cli.add_argument("--out", default="runs")
    cli.add_argument("--seed", type=int, default=0)
    cli.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    options = cli.parse_args()
    torch.set_num_threads(1)

    arms = {}
    for name in options.arms:
        arms[name] = replace(ARMS[name], steps=STEPS * (LONG if name.startswith("long") else 1))
    phones = f"phones:{options.photographs}"
    recipe = HalfDecibelRecipe(
        name="half_decibel",
        data=DataConfig(
            pairs=phones,
            count=5,
            select="phones",
            pictures=f"{options.photographs}/train",
            memory_mb=700,
            validation=phones,
            validation_count=10,
            validation_crop=256,
            test=phones,
            test_count=None,
            test_crop=256,
        ),
        fit=FitConfig(method="published", steps=60, joint_steps=400, pixels=16384, batch=512),
        noise=PHONES,
        denoiser=DenoiserConfig("UNet", {"width": 8, "scales": 3}),
        train=TrainConfig(
            steps=STEPS * LONG, batch=8, crop=64, learning_rate=1e-3, validate_every=200, checkpoint_every=400
        ),
        arms=arms,
        self_ensemble=False,
        seed=options.seed,
        out=options.out,
    )
    run(recipe, overwrite=True)


if __name__ == "__main__":
    main()
