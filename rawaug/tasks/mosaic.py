"""Mosaics of every pattern: one network takes a mosaic and the planes of its colours, and returns the mosaic.

The truth is mosaicked anew in each pattern. Results are demosaiced by LibRaw, with Markesteijn's interpolation for
X-Trans; Quad-Bayer, which LibRaw does not know, is demosaiced by :meth:`rawaug.bayer.Pattern.demosaic`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any, ClassVar

from denoisers.mosaic import lines_before, with_planes
from rawaug import bayer
from rawaug.data.pairs import Pair
from rawaug.evaluation.trials import Trial, make_trials
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.plugin.augment import RawAugment
from rawaug.seeding import derive_seed
from rawaug.tasks.base import TASKS
from rawaug.tasks.full_colour import FullColourRecipe, FullColourTask, rgb_trial
from rawaug.training.crops import MosaicCrops
from rawaug.training.stream import TrainingStream


@dataclass
class MosaicRecipe(FullColourRecipe):
    """Networks for mosaics of every pattern.

    Args:
        patterns: shares of the patterns in training, by name.
        test_patterns: patterns of validation and test frames.
    """

    kind: ClassVar[str] = "mosaic"
    patterns: dict[str, float] = field(default_factory=lambda: {"RGGB": 0.4, "XTRANS": 0.4, "QUAD-RGGB": 0.2})
    test_patterns: list[str] = field(default_factory=lambda: ["RGGB", "XTRANS", "QUAD-RGGB"])

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in (*self.patterns, *self.test_patterns):
            bayer.pattern(name)

        shares = self.patterns.values()
        if not shares or min(shares) < 0 or not sum(shares) > 0:
            raise ValueError(f"patterns: shares must be at least 0, and one above, got {self.patterns}")


def mosaic_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """Make a frame a test case of a pattern, in the domain ``rgb``: packed RAW if it is Bayer's, else a mosaic."""
    method = "AHD"
    if cfa.startswith("QUAD"):
        method = "bilinear"

    return rgb_trial(pair, noise, {"": method}, cfa, condition=cfa)


def planes_trial(pair: Pair, cfa: str, noise: NoiseModel) -> Trial:
    """Make a frame what a network of mosaics takes, with its colours' planes: ``(1, 4, H, W)``, domain ``raw``.

    The frame begins at the line from which the network is trained to meet the pattern.
    """
    trial = mosaic_trial(pair, cfa, noise)
    assert trial.variance is not None

    pattern = bayer.pattern(cfa)
    rows_before, columns_before = lines_before(pattern)
    y = -rows_before % pattern.period
    x = -columns_before % pattern.period

    raw = bayer.unpack_if_packed(trial.noisy, cfa)[..., y:, x:]
    variance = bayer.unpack_if_packed(trial.variance, cfa)[..., y:, x:]
    clean = pattern.mosaic(trial.clean)[..., y:, x:]
    noisy = with_planes(raw, pattern.shift(y, x))
    return Trial(noisy, clean, variance, pair.name, condition=cfa)


@TASKS.register("mosaic")
class MosaicTask(FullColourTask):
    """One network on patterns drawn at random, scored in each."""

    settings = MosaicRecipe
    ensembles = False

    def stream(
        self, arm: str, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel, seed: int
    ) -> TrainingStream:
        """Make crops of pictures as RAW of all patterns."""
        settings, train = self.recipe.arms[arm], self.recipe.loop(arm)
        augment = RawAugment(isp, noise, draw=settings.draw or self.recipe.draw)
        crops = MosaicCrops(pictures, augment, train.crop, settings.zoom, self.recipe.patterns)
        return TrainingStream(None, crops, train.batch, 1.0, derive_seed(seed, "stream"))

    def validation_trials(
        self, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
    ) -> Sequence[Trial]:
        """Take the frames in every pattern."""
        trials = []
        for cfa in self.recipe.test_patterns:
            for pair in frames:
                trials.append(planes_trial(pair, cfa, self.noise))

        return trials

    def test_trials(self, frames: Sequence[Any], isp: DictionaryISP, noise: NoiseModel) -> Sequence[Trial]:
        """Take the frames in every pattern."""

        def make(case: tuple[str, int]) -> Trial:
            cfa, index = case
            return mosaic_trial(frames[index], cfa, self.noise)

        cases = list(product(self.recipe.test_patterns, range(len(frames))))
        return make_trials(cases, make)

    def samples_key(self) -> Sequence[Any]:
        """Return the patterns."""
        return self.recipe.patterns, self.recipe.test_patterns

    def trials_key(self) -> Sequence[Any]:
        """Return the noise and the patterns of the test."""
        return self.recipe.test_noise, self.recipe.test_patterns

    def group(self, trial: Any) -> str:
        """Return the pattern."""
        return str(trial.condition)

    def can_denoise(self, denoiser: Any, trial: Trial) -> bool:
        """Tell whether a denoiser takes the pattern: networks of mosaics take any, other denoisers take Bayer's."""
        return bool(denoiser.takes_pattern(trial.condition))
