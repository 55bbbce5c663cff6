"""What an arm of a recipe is trained on: its estimator, its stream of samples, and the samples it is watched on.

A setting of an estimator that is chosen on validation: one candidate is trained for each value, the best is named.

No test frame has a say. The score is the one by which a training keeps its weights: the best of ``log.csv``, or the
last where there are no validation frames.
"""

from __future__ import annotations

import copy
import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.scores import frozen_sample
from rawaug.experiment.recipe import ArmConfig, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.registry import ESTIMATORS
from rawaug.seeding import derived_seed, keyed_generator
from rawaug.training.estimators import SelfSupervised, Supervised
from rawaug.training.noisy_frames import FrozenPictures, NoisyCrops, held_out, noisy_frame
from rawaug.training.stream import PictureCrops, RealCrops, Source, TrainingStream
from rawaug.training.validation import Watched, watched

WATCHED = 16
"""Samples made from pictures on which a training without validation pairs is watched."""


def estimator_of(arm: ArmConfig) -> Supervised:
    """The estimator that the arm names.

    Example:
        >>> estimator_of(ArmConfig(estimator={"name": "r2r", "settings": {"alpha": 0.5}})).alpha
        0.5
    """
    estimator: Supervised = ESTIMATORS.make(arm.estimator)
    return estimator


def in_pattern(isp: DictionaryISP, cfa: CFA) -> DictionaryISP:
    """The ISP of the same camera behind another CFA, a copy."""
    if isp.cfa == cfa:
        return isp
    other = copy.deepcopy(isp)
    other.configure(cfa=str(cfa))
    return other


def frames_of(recipe: Recipe, pairs: Sequence[Pair], isp: DictionaryISP) -> Sequence[Any]:
    """The real frames as the arms take them: the pairs, or a :class:`NoisyFrame` of each where no arm sees clean ones.

    Arms and seeds share them, so that the signal of a noisy frame is estimated once.
    """
    return [noisy_frame(pair, isp.info.get("noise")) for pair in pairs] if recipe.self_supervised else pairs


def training_stream(
    recipe: Recipe,
    arm: ArmConfig,
    frames: Sequence[Any],
    pictures: Any,
    isp: DictionaryISP,
    noise: NoiseModel,
    seed: int,
) -> TrainingStream:
    """The training samples of one arm.

    Args:
        frames: the real ones, see :func:`frames_of`.
        pictures: the sRGB pictures.
        isp, noise: make RAW of them.
        seed: of the run.
    """
    config, seed = recipe.train, derived_seed(seed, "stream")
    estimator = estimator_of(arm)
    real: Source | None = None
    synthetic: Source | None = None
    if isinstance(estimator, SelfSupervised):
        if frames and arm.augmented < 1.0:
            real = NoisyCrops(frames, estimator, config.crop, isp.cfa)
        if arm.augmented:
            augment = RawAugment(isp, noise, arm.sampling, arm.strength, exposure=arm.exposure)
            frozen = FrozenPictures(pictures, augment, derived_seed(seed, "pictures"), estimator.shots)
            synthetic = NoisyCrops(frozen, estimator, config.crop, isp.cfa)
    else:
        if frames:
            real = RealCrops(frames, noise, config.crop, isp.cfa)
        if arm.augmented:
            synthetic = picture_source(recipe, arm, pictures, isp, noise)
    return TrainingStream(real, synthetic, config.batch, arm.augmented, seed)


def picture_source(recipe: Recipe, arm: ArmConfig, pictures: Any, isp: DictionaryISP, noise: NoiseModel) -> Source:
    """Crops of the sRGB pictures as RAW of the ISP's cameras."""
    augment = RawAugment(isp, noise, arm.sampling, arm.strength, exposure=arm.exposure)
    return PictureCrops(RawPairs(pictures, augment, recipe.train.crop, zoom=arm.zoom))


def validation_samples(
    recipe: Recipe, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
) -> list[Watched]:
    """The frozen samples by which weights are chosen, the same in every arm and run.

    Args:
        frames: of validation, see :func:`frames_of`; none for samples made from ``pictures``.
    """
    augment = RawAugment(isp, noise)
    if recipe.self_supervised:
        frozen = frames or FrozenPictures(pictures, augment, derived_seed("validation"))[:WATCHED]
        return [Watched(*sample) for sample in held_out(frozen, isp.cfa)]
    if frames:
        return [watched(frozen_sample(pair, noise, isp.cfa, seed=0), pair, isp.cfa) for pair in frames]
    crops = PictureCrops(RawPairs(pictures, augment, recipe.train.crop))
    drawn = (crops.draw(keyed_generator("validation", k)) for k in range(WATCHED))
    return [Watched(s.noisy[None], s.clean[None], s.variance[None]) for s in drawn]


def chosen(candidates: Mapping[str, str], folders: Sequence[Path], best: bool) -> dict[str, dict[str, float]]:
    """Of every arm with a search its candidates and their mean validation PSNR over the runs, the highest first.

    Args:
        candidates: by name, the arm whose they are.
        folders: of the runs, each with a folder for each candidate.
        best: weights are those of the best score, else those of the last.
    """
    scores: dict[str, dict[str, float]] = {}
    for label, arm in candidates.items():
        found = [_score(folder / label / "log.csv", best) for folder in folders]
        scores.setdefault(arm, {})[label] = fmean(found)
    return {arm: dict(sorted(found.items(), key=lambda one: -one[1])) for arm, found in scores.items()}


def _score(log: Path, best: bool) -> float:
    with log.open(newline="") as file:
        scores = [float(row["psnr"]) for row in csv.DictReader(file)]
    return max(scores) if best else scores[-1]
