"""A recipe, stage by stage: fit the ISP, train every arm, evaluate, report.

Each stage leaves a file in ``OUT/NAME``; a stage whose file was made with the same settings is not done again, so that
a run that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import denoisers
from denoisers.network import Denoiser
from rawaug.augment import RawAugment, RawPairs
from rawaug.bayer import CFA
from rawaug.data import RawFolder, open_pairs, open_pictures
from rawaug.data.pairs import Pair
from rawaug.experiment.evaluate import frozen_sample, score_denoiser, summary, write_json
from rawaug.experiment.fitting import fit
from rawaug.experiment.recipe import ArmConfig, Recipe
from rawaug.experiment.report import Row, draw, print_table
from rawaug.experiment.stream import RealCrops, Sample, TrainingStream
from rawaug.experiment.train import train
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.seeding import derived_seed

SHOWN = 3
"""Test frames in the picture."""


def run(recipe: Recipe) -> dict[str, list[dict[str, Any]]]:
    """Run a recipe; the results by arm, one entry a seed, as they stand in ``results.json``."""
    folder = Path(recipe.out) / recipe.name
    pairs = list(open_pairs(recipe.data.pairs, split="train")[: recipe.data.count])
    test = open_pairs(recipe.data.test)
    _require_unseen(recipe, test)
    open_pictures(recipe.data.pictures)  # what is missing is told before anything is fitted
    results: dict[str, list[dict[str, Any]]] = {arm: [] for arm in recipe.arms}
    models: dict[str, Denoiser] = {}
    cfa = pairs[0].cfa
    for seed in range(recipe.seed, recipe.seed + recipe.seeds):
        isp = _fitted_isp(recipe, pairs, seed, folder)
        for name, arm in recipe.arms.items():
            place = folder / f"seed{seed}" / name
            models[name] = _trained(recipe, arm, name, isp, pairs, cfa, seed, place)
            results[name].append(_evaluated(recipe, models[name], name, test, cfa, place))
    write_json({"recipe": asdict(recipe), "results": results}, folder / "results.json")
    picture = draw(_rows(recipe, models, test, cfa), cfa, folder / "picture.png")
    counted = (
        f"{len(pairs)} real pairs, {recipe.train.steps} steps, {recipe.seeds} seed(s), tested on {recipe.data.test}"
    )
    print_table(results, f"{recipe.name}: {counted}")
    print(f"table: {folder / 'results.json'}\npicture: {picture}")
    return results


def _require_unseen(recipe: Recipe, test: Sequence[Pair]) -> None:
    """Refuse test frames that are also among the frames of training or validation."""
    unseen = _identities(test)
    for part in ("pairs", "validation"):
        seen = unseen & _identities(open_pairs(getattr(recipe.data, part), split="train" if part == "pairs" else part))
        if seen:
            raise ValueError(f"data.test: {min(seen)} is also among data.{part}; test on frames that nothing has seen")


def _identities(pairs: Sequence[Pair]) -> set[str]:
    """What tells frames apart without reading them: the path of a file, else the name."""
    if isinstance(pairs, RawFolder):
        return {str(file.resolve()) for file in pairs.files}
    return {pair.name for pair in pairs}


def _key(*settings: Any) -> str:
    """A fingerprint of settings: equal if and only if the stage would do the same."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _fitted_isp(recipe: Recipe, pairs: Sequence[Pair], seed: int, folder: Path) -> DictionaryISP:
    path = folder / f"seed{seed}" / "isp.safetensors"
    settings = {**asdict(recipe.isp), "seed": seed}
    key = _key("isp", settings, [pair.name for pair in pairs])
    if path.is_file():
        isp = DictionaryISP.from_pretrained(path)
        if isp.info.get("key") == key:
            print(f"fitted already: {path}")
            return isp
    isp = fit(pairs, **settings)
    isp.info["key"] = key
    isp.save(path)
    return isp


def _trained(
    recipe: Recipe,
    arm: ArmConfig,
    name: str,
    isp: DictionaryISP,
    pairs: Sequence[Pair],
    cfa: CFA,
    seed: int,
    place: Path,
) -> Denoiser:
    path = place / "denoiser.safetensors"
    config = recipe.train
    key = _key(
        "train",
        isp.info["key"],
        asdict(arm),
        asdict(config),
        asdict(recipe.denoiser),
        recipe.noise,
        recipe.data.pictures,
    )
    if path.is_file():
        model, info = denoisers.load(path)
        if info.get("key") == key:
            print(f"trained already: {path}")
            return model
    _discard_other_checkpoint(place, key)
    noise = noise_model(recipe.noise)
    real = RealCrops(pairs, noise, config.crop, cfa)
    augmented = None
    if arm.augmented:
        augment = RawAugment(isp, noise, arm.sampling, arm.strength)
        augmented = RawPairs(open_pictures(recipe.data.pictures), augment, config.crop)
    stream = TrainingStream(real, augmented, config.batch, arm.augmented, derived_seed(seed, "stream"))
    label = f"seed {seed}, {name}"
    model = train(
        stream, _validation(recipe, cfa), recipe.denoiser, config, place, seed, recipe.device, recipe.devices, label
    )
    info = {"key": key, "cfa": str(cfa), "noise": recipe.noise, "steps": config.steps, "seed": seed, "arm": name}
    denoisers.save(model, path, {**info, "real_pairs": [pair.name for pair in pairs], "pictures": recipe.data.pictures})
    (place / "last.pt").unlink(missing_ok=True)
    return model


def _discard_other_checkpoint(place: Path, key: str) -> None:
    """A checkpoint of other settings cannot be gone on from."""
    place.mkdir(parents=True, exist_ok=True)
    stamp = place / "key.txt"
    if not stamp.is_file() or stamp.read_text() != key:
        for file in ("last.pt", "log.csv"):
            (place / file).unlink(missing_ok=True)
    stamp.write_text(key)


def _validation(recipe: Recipe, cfa: CFA) -> list[Sample]:
    noise = noise_model(recipe.noise)
    return [frozen_sample(pair, noise, cfa, seed=0) for pair in open_pairs(recipe.data.validation, split="validation")]


def _evaluated(
    recipe: Recipe, model: Denoiser, name: str, test: Sequence[Pair], cfa: CFA, place: Path
) -> dict[str, Any]:
    """Plain and self-ensemble scores on the test frames."""
    noise = noise_model(recipe.noise)
    result: dict[str, Any] = {}
    for kind in ("plain", "self_ensemble"):
        scored = score_denoiser(model, test, noise, cfa, 0, kind == "self_ensemble", f"evaluate {name}, {kind}")
        result[kind] = summary([score for score, *_ in scored])
    write_json(result, place / "evaluation.json")
    return result


def _rows(recipe: Recipe, models: dict[str, Denoiser], test: Sequence[Pair], cfa: CFA) -> list[Row]:
    """Panels of the first test frames with the last seed's models."""
    noise = noise_model(recipe.noise)
    rows: list[Row] = []
    for pair in list(test[:SHOWN]):
        row = Row(pair, {}, {})
        for name, model in models.items():
            score, _, sample, denoised = next(score_denoiser(model, [pair], noise, cfa, 0, False, f"picture, {name}"))
            row.panels.setdefault("noisy", sample.noisy)
            row.captions["noisy"] = f"{score.psnr_noisy:.2f} dB"
            row.panels[name] = denoised
            row.captions[name] = f"{score.psnr:.2f} dB"
        row.panels["clean"] = sample.clean
        row.captions["clean"] = pair.name
        rows.append(row)
    return rows
