"""What an arm of a recipe is trained on: its stream of samples, and the samples by which its weights are chosen."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.trials import Trial, trial_of
from rawaug.experiment.recipe import ArmConfig, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.registry import ESTIMATORS, spec_label
from rawaug.seeding import derive_seed
from rawaug.training.estimators import SelfSupervised
from rawaug.training.noisy_frames import FrozenPictures, NoisyCrops, noisy_frame, r2r_trials
from rawaug.training.stream import WATCHED, PictureCrops, RealCrops, Source, TrainingStream, freeze_samples


def methods_of(recipe: Recipe) -> dict[str, str]:
    """What each row of the table is, in a line, by its name."""
    filters = {spec_label(spec): "a filter, nothing is trained" for spec in recipe.classical}
    unchanged = {Path(name).stem: "trained weights as they are" for name in recipe.untouched}
    return {**filters, **unchanged, **{label: _explain(recipe, label) for label in recipe.arms}}


def _explain(recipe: Recipe, label: str) -> str:
    arm, network = recipe.arms[label], recipe.network_of(label)
    begun = f"{network.name} from random weights" if network.start is None else f"{network.start}, trained further"
    real, made = "real pairs" if arm.sees_clean else "real noisy frames", "RAW made from pictures"
    mixed = f"{real}, with {made} as {arm.augmented:.0%} of a batch"
    how = "" if arm.sees_clean else f", by {spec_label(arm.estimator)}"
    frames = {0.0: real, 1.0: made}.get(arm.augmented, mixed)
    return f"{begun}, on {frames}{how}"


def change_cfa(isp: DictionaryISP, cfa: CFA) -> DictionaryISP:
    """The ISP of the same camera behind a CFA: itself, or a copy if it had another."""
    if isp.cfa == cfa:
        return isp
    other = copy.deepcopy(isp)
    other.configure(cfa=str(cfa))
    return other


def frames_of(recipe: Recipe, pairs: Sequence[Pair], isp: DictionaryISP) -> Sequence[Any]:
    """The real frames as the arms take them: pairs, or a :class:`NoisyFrame` of each if no arm sees clean ones."""
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
        recipe: the whole recipe.
        arm: its part on this arm.
        frames: the real frames, see :func:`frames_of`.
        pictures: the sRGB pictures.
        isp: makes RAW of them, in the CFA of the arm's network.
        noise: added to clean RAW.
        seed: of the run.
    """
    crop, seed, estimator = recipe.train.crop, derive_seed(seed, "stream"), ESTIMATORS.make(arm.estimator)
    real: Source | None = None
    made: Source | None = None
    augment: RawAugment | None = None
    if arm.augmented:
        augment = RawAugment(isp, noise, draw=arm.draw, target=arm.srgb or recipe.target)
    if isinstance(estimator, SelfSupervised):
        if frames and arm.augmented < 1.0:
            real = NoisyCrops(frames, estimator, crop, isp.cfa)
        if augment:
            frozen = FrozenPictures(pictures, augment, derive_seed(seed, "pictures"), estimator.shots)
            made = NoisyCrops(frozen, estimator, crop, isp.cfa)
    else:
        real = RealCrops(frames, noise, crop, isp.cfa) if frames else None
        made = PictureCrops(RawPairs(pictures, augment, crop, zoom=arm.zoom)) if augment else None
    return TrainingStream(real, made, recipe.train.batch, arm.augmented, seed)


def validation_samples(
    recipe: Recipe, frames: Sequence[Any], pictures: Any, isp: DictionaryISP, noise: NoiseModel
) -> list[Trial]:
    """The frozen samples by which weights are chosen, the same in every arm and run.

    Args:
        recipe: the whole recipe.
        frames: the validation frames, see :func:`frames_of`; without any, samples are made from pictures.
        pictures: the sRGB pictures.
        isp: makes RAW of them, and says the CFA of all samples.
        noise: added to clean RAW.
    """
    augment = RawAugment(isp, noise, target=recipe.target)
    if recipe.self_supervised:
        frozen = frames or FrozenPictures(pictures, augment, derive_seed("validation"))[:WATCHED]
        return r2r_trials(frozen, isp.cfa)
    if frames:
        return [trial_of(pair, noise, isp.cfa) for pair in frames]
    return freeze_samples(PictureCrops(RawPairs(pictures, augment, recipe.train.crop)), "validation")
