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
from rawaug.augment import RawAugment, RawPairs, noise_for
from rawaug.data import RawFolder, open_pairs, open_pictures
from rawaug.data.pairs import Pair
from rawaug.experiment.evaluate import frozen_sample, score_denoiser, summary, write_json
from rawaug.experiment.fitting import fit
from rawaug.experiment.recipe import Recipe
from rawaug.experiment.report import Row, draw, print_table
from rawaug.experiment.stream import RealCrops, TrainingStream
from rawaug.experiment.train import train
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel
from rawaug.seeding import derived_seed

SHOWN = 3
"""Test frames in the picture."""


def run(recipe: Recipe) -> dict[str, list[dict[str, Any]]]:
    """Run a recipe; the results by arm, one entry a seed, as they stand in ``results.json``."""
    return _Run(recipe).all_stages()


class _Run:
    """One recipe on its data; everything that could be missing is opened before anything is fitted."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe, self.data = recipe, recipe.data
        self.folder = Path(recipe.out) / recipe.name
        self.test = open_pairs(self.data.test)
        self.validation = open_pairs(self.data.validation, split="validation")
        source = open_pairs(self.data.pairs, split="train")
        _require_unseen(self.test, {"pairs": source, "validation": self.validation})
        self.pictures = open_pictures(self.data.pictures)
        self.pairs = list(source[: self.data.count])
        self.cfa = self.pairs[0].cfa

    def all_stages(self) -> dict[str, list[dict[str, Any]]]:
        recipe = self.recipe
        results: dict[str, list[dict[str, Any]]] = {arm: [] for arm in recipe.arms}
        models: dict[str, Denoiser] = {}
        for seed in range(recipe.seed, recipe.seed + recipe.seeds):
            isp = self.fitted_isp(seed)
            noise = noise_for(isp, recipe.noise)
            for arm in recipe.arms:
                models[arm] = self.trained(arm, isp, noise, seed)
                results[arm].append(self.evaluated(arm, models[arm], noise, seed))
        table = self.folder / "results.json"
        write_json({"recipe": asdict(recipe), "results": results}, table)
        picture = draw(self.rows(models, noise), self.cfa, self.folder / "picture.png")
        settings = f"{len(self.pairs)} real pairs, {recipe.train.steps} steps, {recipe.seeds} seed(s)"
        print_table(results, f"{recipe.name}: {settings}, tested on {self.data.test}")
        print(f"table: {table}\npicture: {picture}")
        return results

    def fitted_isp(self, seed: int) -> DictionaryISP:
        """The ISP of the few pairs."""
        path = self.folder / f"seed{seed}" / "isp.safetensors"
        settings = {**asdict(self.recipe.isp), "seed": seed}
        measure = self.recipe.noise == "camera"
        key = _key("isp", settings, [pair.name for pair in self.pairs], measure)
        if path.is_file():
            isp = DictionaryISP.from_pretrained(path)
            if isp.info.get("key") == key:
                print(f"fitted already: {path}")
                return isp
        isp = fit(self.pairs, noise="on" if measure else "off", **settings)
        isp.info["key"] = key
        isp.save(path)
        return isp

    def trained(self, arm: str, isp: DictionaryISP, noise: NoiseModel, seed: int) -> Denoiser:
        """The denoiser of one arm."""
        recipe, place = self.recipe, self.folder / f"seed{seed}" / arm
        path = place / "denoiser.safetensors"
        config, network = recipe.train, recipe.denoiser
        key = _key(
            isp.info["key"], asdict(recipe.arms[arm]), asdict(config), asdict(network), recipe.noise, asdict(self.data)
        )
        if path.is_file():
            model, info = denoisers.load(path)
            if info.get("key") == key:
                print(f"trained already: {path}")
                return model
        _discard_other_checkpoint(place, key)
        validation = [frozen_sample(pair, noise, self.cfa, seed=0) for pair in self.validation]
        stream, label = self.stream(arm, isp, noise, seed), f"seed {seed}, {arm}"
        model = train(stream, validation, network, config, place, seed, recipe.device, recipe.devices, label)
        levels = [isp.info["noise"][k] for k in ("shot_var", "read_var")] if recipe.noise == "camera" else recipe.noise
        info = {"key": key, "cfa": str(self.cfa), "noise": levels, "steps": config.steps, "seed": seed, "arm": arm}
        info |= {"real_pairs": [pair.name for pair in self.pairs], "pictures": self.data.pictures}
        denoisers.save(model, path, info)
        (place / "last.pt").unlink(missing_ok=True)
        return model

    def stream(self, arm: str, isp: DictionaryISP, noise: NoiseModel, seed: int) -> TrainingStream:
        """The training samples of one arm."""
        config, settings = self.recipe.train, self.recipe.arms[arm]
        real = RealCrops(self.pairs, noise, config.crop, self.cfa)
        augmented = None
        if settings.augmented:
            augment = RawAugment(isp, noise, settings.sampling, settings.strength)
            augmented = RawPairs(self.pictures, augment, config.crop)
        return TrainingStream(real, augmented, config.batch, settings.augmented, derived_seed(seed, "stream"))

    def evaluated(self, arm: str, model: Denoiser, noise: NoiseModel, seed: int) -> dict[str, Any]:
        """Plain and self-ensemble scores on the test frames."""
        result: dict[str, Any] = {}
        for kind in ("plain", "self_ensemble"):
            label, ensemble = f"evaluate {arm}, {kind}", kind == "self_ensemble"
            scored = score_denoiser(model, self.test, noise, self.cfa, 0, ensemble, label)
            result[kind] = summary([score for score, *_ in scored])
        write_json(result, self.folder / f"seed{seed}" / arm / "evaluation.json")
        return result

    def rows(self, models: dict[str, Denoiser], noise: NoiseModel) -> list[Row]:
        """Panels of the first test frames with the last seed's models."""
        rows: list[Row] = []
        for pair in list(self.test[:SHOWN]):
            row = Row(pair, {}, {})
            for arm, model in models.items():
                scored = score_denoiser(model, [pair], noise, self.cfa, 0, False, f"picture, {arm}")
                score, _, sample, denoised = next(scored)
                row.panels |= {} if "noisy" in row.panels else {"noisy": sample.noisy}
                row.panels[arm] = denoised
                row.captions |= {"noisy": f"{score.psnr_noisy:.2f} dB", arm: f"{score.psnr:.2f} dB"}
            row.panels["clean"] = sample.clean
            row.captions["clean"] = pair.name
            rows.append(row)
        return rows


def _require_unseen(test: Sequence[Pair], others: dict[str, Sequence[Pair]]) -> None:
    """Refuse test frames that are also among the frames of training or validation."""
    unseen = _identities(test)
    for part, pairs in others.items():
        seen = unseen & _identities(pairs)
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


def _discard_other_checkpoint(place: Path, key: str) -> None:
    """A checkpoint of other settings cannot be gone on from."""
    place.mkdir(parents=True, exist_ok=True)
    stamp = place / "key.txt"
    if not stamp.is_file() or stamp.read_text() != key:
        for file in ("last.pt", "log.csv"):
            (place / file).unlink(missing_ok=True)
    stamp.write_text(key)
