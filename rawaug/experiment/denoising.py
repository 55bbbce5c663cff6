"""A recipe, stage by stage: fit the ISP, train every arm, evaluate, report.

Each stage leaves a file in ``OUT/NAME``; a stage whose file was made with the same settings is skipped, so that
a stopped run resumes.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import denoisers
from denoisers.files import find
from denoisers.network import Denoiser
from rawaug.bayer import CFA
from rawaug.camera.fit import fit
from rawaug.data.folders import reports
from rawaug.data.pairs import OWN_PICTURES, Pair, PairPictures, stamps
from rawaug.denoise.denoiser import RawDenoiser, require_classical
from rawaug.errors import extra
from rawaug.evaluation.page import Page, draw_curves, shown_on_page
from rawaug.evaluation.scores import NOISY, Panels, Row, by_denoiser, panels_of, require_numbers, score, summary
from rawaug.evaluation.tables import draw, first_runs, print_table, verdict
from rawaug.evaluation.trials import Trial, added_noise_note, own_noise_note, trial_of, trials_of
from rawaug.experiment.arms import (
    chosen,
    frames_of,
    in_pattern,
    methods_of,
    training_stream,
    validation_samples,
)
from rawaug.experiment.plan import planned, require_usable, with_given_pairs
from rawaug.experiment.recipe import Recipe
from rawaug.experiment.run_folder import claim, require_free, run_folder
from rawaug.files import find_weights, fingerprint, one_at_a_time, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, camera_law, noise_model
from rawaug.plugin.augment import noise_for
from rawaug.progress import time_stage
from rawaug.registry import ESTIMATORS, EXPERIMENTS, FILTERS, Spec, spec_label, split_spec
from rawaug.training.config import weights_key
from rawaug.training.loop import require_trainable, train
from rawaug.training.noisy_frames import faintness_note, noisy_only
from rawaug.training.state import first_network, start_of
from rawaug.training.stream import TrainingStream

SHOWN = 3
"""Test frames in the picture."""

KINDS = ("plain", "self_ensemble")
"""How a denoiser is scored, in this order."""

Results = dict[str, list[dict[str, Any]]]
"""By arm, one entry a seed: the summaries ``plain`` and ``self_ensemble``."""


@EXPERIMENTS.register("training")
def run(
    recipe: Recipe,
    overwrite: bool = False,
    *,
    pairs: Sequence[Pair] | None = None,
    validation: Sequence[Pair] | None = None,
    test: Sequence[Pair] | None = None,
) -> Results:
    """Run a recipe; the results by arm, one entry a seed, as in ``results.json``.

    Of several processes (``devices``) the first one writes; the others return empty lists.

    Args:
        recipe: what is run.
        overwrite: replace a run of this name with other settings; what does not depend on them is kept.
        pairs, validation, test: in place of what ``data.pairs``, ``data.validation`` and ``data.test`` name. With
            ``pairs`` alone a part of them is held out for validation.
    """
    given = {"pairs": pairs, "validation": validation, "test": test}
    given_frames = {key: frames for key, frames in given.items() if frames is not None}
    return TrainingRun(recipe, overwrite, given_frames).all_stages()


class TrainingRun:
    """One recipe on its data; what could be missing or wrong is opened or tried before anything is fitted.

    A kind of experiment with another target overrides :meth:`stream`, :meth:`watched`, :meth:`trial`,
    :meth:`evaluated` or :meth:`reported`.
    """

    input: Any = NOISY
    """What stands for the noisy input in tables."""

    def __init__(self, recipe: Recipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        recipe = with_given_pairs(recipe, given)
        require_free(recipe, overwrite)
        require_trainable(recipe.device, recipe.devices, recipe.train.precision)
        self.recipe, self.data, self.overwrite = recipe, recipe.data, overwrite
        self.folder = run_folder(recipe)
        self.classical = installed_classical(recipe.classical, shown=_leads())
        if recipe.noise != "camera":
            noise_model(recipe.noise)
        self.estimators = {label: ESTIMATORS.make(arm.estimator) for label, arm in recipe.arms.items()}
        for arm, estimator in self.estimators.items():
            network = first_network(recipe.network_of(arm), seed=0)
            estimator.require(network)
            if (network.upscale > 1) != (recipe.target == "rgb"):
                named = recipe.network_of(arm).start or type(network).__name__
                gives = "full colour: rawaug run demosaic trains it" if network.upscale > 1 else "no full colour"
                raise ValueError(f"denoiser: {named} gives {gives}; take another network")
        self.starts = {arm: start_of(recipe.network_of(arm)) for arm in recipe.arms}
        self.untouched = [RawDenoiser.of(find(name), recipe.device, name=Path(name).stem) for name in recipe.untouched]
        plan = planned(recipe, given)
        _say(*plan.lines(recipe))
        plan, self.unreadable = plan.read()
        _say(*self.unreadable)
        self.pairs, self.validation, self.test = list(plan.pairs), plan.validation, plan.test
        if recipe.self_supervised:  # from here on nothing knows a clean frame but the test
            self.pairs, self.validation = ([noisy_only(p) for p in part] for part in (self.pairs, self.validation))
        self.pictures = PairPictures(self.pairs) if self.data.pictures == OWN_PICTURES else plan.pictures
        self.frames: dict[str, Sequence[Any]] = {}
        self._trials: tuple[NoiseModel, Sequence[Trial]] | None = None
        self._noisy: list[Row] | None = None
        self.seconds: dict[str, float] = {}
        require_usable(recipe, self.pairs, self.validation)

    @one_at_a_time(lambda self: self.folder if _leads() else None)
    def all_stages(self) -> Results:
        recipe = self.recipe
        if _leads():
            claim(recipe, self.overwrite)
        results: Results = {arm: [] for arm in recipe.arms}
        models: dict[str, Denoiser] = {}
        for seed in self.seeds:
            isp = self.fitted_isp(seed)
            if not models or recipe.noise == "camera":  # another fit may have measured another law
                noise = noise_for(isp, recipe.noise)
            if _leads() and not models:
                _say(added_noise_note(self.trials(noise, isp)))
            if not self.frames or recipe.noise == "camera":
                parts = {"pairs": self.pairs, "validation": self.validation}
                self.frames = {part: frames_of(recipe, pairs, isp) for part, pairs in parts.items()}
                _say(faintness_note(self.frames["pairs"]) if recipe.self_supervised else "")
            for arm in recipe.arms:
                models[arm] = self.trained(arm, in_pattern(isp, self.pattern(arm, isp)), noise, seed)
                if _leads():
                    results[arm].append(self.evaluated(arm, models[arm], noise, isp, seed))
        if _leads():
            self.reported(results, models, noise, isp)
        return results

    @property
    def seeds(self) -> range:
        return range(self.recipe.seed, self.recipe.seed + self.recipe.seeds)

    def place(self, arm: str, seed: int) -> Path:
        return self.folder / f"seed{seed}" / arm

    def pattern(self, arm: str, isp: DictionaryISP) -> CFA:
        """The CFA that an arm is trained for: that of the weights that it starts from, else the ISP's."""
        start = self.starts[arm]
        return isp.cfa if start is None else start.cfa

    @time_stage("fit")
    def fitted_isp(self, seed: int) -> DictionaryISP:
        """The ISP of the few pairs, or the recipe's own."""
        if self.recipe.camera is not None:
            weights = find_weights(self.recipe.camera)
            isp = DictionaryISP.from_pretrained(weights)
            isp.info["key"] = sha256(weights)
            return isp
        path = self.folder / f"seed{seed}" / "isp.safetensors"
        settings = {**asdict(self.recipe.isp), "seed": seed}
        measure = self.recipe.noise == "camera"
        key = fingerprint("isp", settings, stamps(self.pairs), measure, self.recipe.self_supervised)
        if path.is_file():
            isp = DictionaryISP.from_pretrained(path)
            if isp.info.get("key") == key:
                _say(f"already fitted: {path}")
                return isp
        isp = fit(self.pairs, noise="on" if measure else "off", **settings)
        isp.info["key"] = key
        isp.save(path)
        return isp

    @time_stage("training")
    def trained(self, arm: str, isp: DictionaryISP, noise: NoiseModel, seed: int) -> Denoiser:
        recipe, place = self.recipe, self.place(arm, seed)
        path = place / "denoiser.safetensors"
        config, network, start = recipe.loop_of(arm), recipe.network_of(arm), self.starts[arm]
        key = self.weights_key(arm, isp, seed)
        if path.is_file():
            model, info = denoisers.load(path)
            if info.get("key") == key:
                print(f"already trained: {path}")
                return model
        stream = self.stream(arm, isp, noise, seed)
        model = train(
            stream,
            self.watched(isp, noise),
            network,
            config,
            place,
            seed,
            recipe.device,
            recipe.devices,
            label=f"seed {seed}, {arm}",
            estimator=self.estimators[arm],
            choose=bool(self.validation),
            key=key,
        )
        if not _leads():
            return model
        levels = camera_law(isp.info["noise"]).spec() if recipe.noise == "camera" else recipe.noise
        info = {"key": key, "cfa": str(isp.cfa), "noise": levels, "steps": config.steps, "seed": seed, "arm": arm}
        info |= {} if recipe.arms[arm].sees_clean else {"estimator": recipe.arms[arm].estimator}
        info |= {} if start is None else {"start": network.start, "start_sha256": start.sha256}
        info |= {"real_pairs": [pair.name for pair in self.pairs], "pictures": self.data.pictures}
        denoisers.save(model, path, info)
        (place / "last.pt").unlink(missing_ok=True)
        return model

    def stream(self, arm: str, isp: DictionaryISP, noise: NoiseModel, seed: int) -> TrainingStream:
        """The training samples of an arm."""
        return training_stream(
            self.recipe, self.recipe.arms[arm], self.frames["pairs"], self.pictures, isp, noise, seed
        )

    def watched(self, isp: DictionaryISP, noise: NoiseModel) -> list[Trial]:
        """The frozen samples by which the weights of every arm are chosen."""
        return validation_samples(self.recipe, self.frames["validation"], self.pictures, isp, noise)

    def weights_key(self, arm: str, isp: DictionaryISP, seed: int) -> str:
        """What the weights of an arm depend on."""
        recipe, data, start = self.recipe, self.data, self.starts[arm]
        real = isp.info["key"], recipe.noise, data.pairs, stamps(self.pairs)
        pictures = data.pictures, len(self.pictures), data.max_pixels
        how = recipe.target, asdict(recipe.arms[arm]), self.estimators[arm].revision, start and start.sha256
        watched = data.validation, data.validation_crop, stamps(self.validation), recipe.validated_with
        validation = watched if self.validation else None
        samples = (seed, *real, *pictures, *how)
        return weights_key(recipe.network_of(arm), recipe.loop_of(arm), samples, validation)

    @time_stage("scores of the arms")
    def evaluated(self, arm: str, model: Denoiser, noise: NoiseModel, isp: DictionaryISP, seed: int) -> dict[str, Any]:
        """Plain and self-ensemble scores on the test frames."""
        path = self.place(arm, seed) / "evaluation.json"
        known = json.loads(path.read_text()) if path.is_file() else {}
        key = self.scores_key(sha256(path.with_name("denoiser.safetensors")))
        result: dict[str, Any] = known if known.get("key") == key else {"key": key}
        missing = [kind for kind in KINDS[: 1 + self.recipe.self_ensemble] if kind not in result]
        if not missing:
            print(f"already evaluated: {path}")
        for kind in missing:
            one = self.denoiser(arm, model, isp, self.recipe.views if kind == "self_ensemble" else 1)
            (rows,) = self.scored([one], noise, isp, f"evaluate {arm}, {kind}").values()
            result[kind] = summary(rows, self.noisy_rows(noise, isp))
            write_json(result, path)
            print(f"evaluated {arm}, seed {seed}, {kind}: {result[kind].get('psnr', math.nan):.2f} dB: {path}")
        return {kind: result[kind] for kind in KINDS if kind in result}

    def scores_key(self, digest: str) -> str:
        """What the scores of an arm depend on, besides the noise and the arm's own settings."""
        frames = self.data.test, self.data.test_crop, self.data.bin, stamps(self.test)
        return fingerprint(digest, *frames, self.recipe.views)

    def trials(self, noise: NoiseModel, isp: DictionaryISP) -> Sequence[Trial]:
        """The test cases, made once; another seed's fit may have measured another noise."""
        if self._trials is None or self._trials[0] is not noise:
            self._trials = noise, trials_of(self.test, lambda pair: self.trial(pair, noise, isp))
            self._noisy = None
        return self._trials[1]

    def trial(self, pair: Pair, noise: NoiseModel, isp: DictionaryISP) -> Trial:
        """A test case of a frame."""
        return trial_of(pair, noise, isp.cfa)

    def scored(
        self, denoisers: Sequence[Any], noise: NoiseModel, isp: DictionaryISP, label: str
    ) -> dict[str, list[Row]]:
        """The rows of every denoiser, by name; all see a test case before the next one is made."""
        return by_denoiser(score(denoisers, self.trials(noise, isp), label))

    def noisy_rows(self, noise: NoiseModel, isp: DictionaryISP) -> list[Row]:
        """The scores of the input itself."""
        trials = self.trials(noise, isp)
        if self._noisy is None:
            self._noisy = next(iter(by_denoiser(score([self.input], trials)).values()))
        return self._noisy

    def denoiser(self, arm: str, model: Denoiser, isp: DictionaryISP, views: int = 1) -> RawDenoiser:
        """An arm's network as it is tested; one whose training diverged is scored as it is."""
        around, cfa = self.estimators[arm].at_test, self.pattern(arm, isp)
        made = {"name": arm, "cfa": cfa, "views": views, "around": around, "checked": False}
        return RawDenoiser.of(model, self.recipe.device, **made)

    def untrained(self) -> list[RawDenoiser]:
        """What the arms are compared with: classical denoisers, and trained ones as they are."""
        return [*map(RawDenoiser.of, self.classical), *self.untouched]

    def reported(self, results: Results, models: dict[str, Denoiser], noise: NoiseModel, isp: DictionaryISP) -> None:
        """``results.json``, the table, the picture, and the page with all of it."""
        recipe = self.recipe
        others = self.untrained()
        candidates = {label: arm.candidate_of for label, arm in recipe.arms.items() if arm.candidate_of is not None}
        searches = chosen(candidates, [self.folder / f"seed{s}" for s in self.seeds], bool(self.validation))
        classical: dict[str, Any] = {}
        everything: dict[str, Any] = {"recipe": asdict(recipe), "results": results, "classical": classical}
        everything |= {"chosen": searches} if searches else {}
        everything |= {"unreadable": self.unreadable} if self.unreadable else {}
        write_json(everything, self.folder / "results.json")
        for name, rows in self.compared(others, noise, isp).items():
            classical[name] = summary(rows, self.noisy_rows(noise, isp))
        write_json(everything, self.folder / "results.json")
        settings = f"real pairs: {len(self.pairs)}, steps: {recipe.train.steps}, seeds: {recipe.seeds}"
        title = f"{recipe.name} tested on {self.data.test} ({settings})"
        everyone = [*others, *(self.denoiser(arm, model, isp) for arm, model in models.items())]
        facts = {"Noise": recipe.noise, "To use it": self.usage(results, classical)[-1].partition(": ")[2]}
        named = {one.name for one in everyone}
        about = {name: text for name, text in methods_of(recipe).items() if name in named}
        page = Page.of_scores(title, results, classical, facts, about)
        picture = self.pictured(page, everyone, self.trials(noise, isp))
        print_table(results, title, classical)
        _say(page.lead, own_noise_note(first_runs(results, classical)))
        print(f"table: {self.folder / 'results.json'}\npicture: {picture}\npage: {self.folder / 'report.html'}")
        searched = [
            f"{arm}, by validation: " + ", ".join(f"{name} {score:.2f} dB" for name, score in found.items())
            for arm, found in searches.items()
        ]
        spent = "time: " + ", ".join(f"{stage} {seconds:.0f} s" for stage, seconds in self.seconds.items())
        _say(*reports(self.pictures), *self.unreadable, *searched, spent, *self.usage(results, classical))
        summaries = [scores for runs in results.values() for run in runs for scores in run.values()]
        require_numbers([*summaries, *classical.values()])

    @time_stage("other denoisers")
    def compared(self, others: Sequence[RawDenoiser], noise: NoiseModel, isp: DictionaryISP) -> dict[str, list[Row]]:
        """The rows of what the arms are compared with."""
        return self.scored(others, noise, isp, "other denoisers") if others else {}

    @time_stage("report")
    def pictured(self, page: Page, denoisers: Sequence[RawDenoiser], trials: Sequence[Trial]) -> Path:
        """Write the page, with curves and frames, and the picture; of the classical denoisers they show the first."""
        logs = {arm: [self.place(arm, seed) / "log.csv" for seed in self.seeds] for arm in self.recipe.arms}
        page.add_curves(draw_curves(logs))
        hidden = [spec_label(spec) for spec in self.classical[1:]]
        shown = [one for one in denoisers if one.name not in hidden]
        rows: list[Panels] = []
        for trial in shown_on_page(trials):
            row = panels_of(shown, trial)
            page.add_frame(row)
            rows += [row] if len(rows) < SHOWN else []
        page.write(self.folder / "report.html", asdict(self.recipe))
        return draw(rows, self.folder / "picture.png")

    def usage(self, results: Results, others: Mapping[str, Mapping[str, Any]]) -> list[str]:
        """The files of weights, and the command that uses what the verdict names; of an arm the best seed's."""
        files = {(arm, s): self.place(arm, s) / "denoiser.safetensors" for arm in results for s in self.seeds}
        lines = [f"denoiser, {arm}: {file}" for (arm, _), file in files.items()]
        chosen, _ = verdict(results, others)
        if chosen in results:
            runs = [run["plain"].get("psnr", 0.0) for run in results[chosen]]
            what = f"--denoiser {files[chosen, self.seeds[runs.index(max(runs))]]}"
        elif untouched := [name for name in self.recipe.untouched if Path(name).stem == chosen]:
            what = f"--denoiser {untouched[0]}"
        elif chosen in others:
            spec = next(spec for spec in self.classical if spec_label(spec) == chosen)
            what = f"--classical {spec if isinstance(spec, str) else shlex.quote(json.dumps(spec))}"
        else:
            return [*lines, "to use: nothing, the frames are best as they are"]
        return [*lines, f"to use {chosen}: rawaug denoise IN.dng OUT.dng {what}"]


def _say(*lines: str) -> None:
    """Print what is not empty, in the process that writes."""
    if any(lines) and _leads():
        print("\n".join(filter(None, lines)))


def _leads() -> bool:
    """Whether this is the one of several training processes that writes and evaluates."""
    with extra("train"):
        from lightning_fabric.utilities.rank_zero import rank_zero_only

    return getattr(rank_zero_only, "rank", 0) == 0


def installed_classical(specs: Sequence[Spec], shown: bool = True) -> list[Spec]:
    """The classical denoisers of a recipe, without BM3D where its wheel is missing, which is then printed if
    ``shown``.
    """
    bm3d = {"BM3D": FILTERS["BM3D"].missing()}
    kept = [spec for spec in specs if not bm3d.get(split_spec(spec)[0])]
    if shown and len(kept) < len(specs):
        print(f"classical: BM3D is left out: {bm3d['BM3D']}")
    require_classical(kept)
    return kept
