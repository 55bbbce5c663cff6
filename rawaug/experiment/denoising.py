"""A recipe, stage by stage: fit the ISP, train every arm, evaluate, report.

Each stage leaves a file in ``OUT/NAME``; a stage whose file was made with the same settings is skipped, so that
a stopped run resumes.
"""

from __future__ import annotations

import copy
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import denoisers
from denoisers.classical import FILTERS
from denoisers.files import find_denoiser
from denoisers.network import Denoiser
from rawaug.bayer import CFA
from rawaug.camera.fit import fit
from rawaug.data.folders import reports
from rawaug.data.pairs import OWN_PICTURES, Pair, PairPictures, stamps
from rawaug.denoising.denoiser import RawDenoiser, require_classical
from rawaug.errors import extra
from rawaug.evaluation.figures import Panels, panels_of, plot_curves, save_picture
from rawaug.evaluation.page import Page, select_for_page
from rawaug.evaluation.scores import NOISY, Row, group_rows, require_numbers, score, summary
from rawaug.evaluation.tables import first_runs, print_table
from rawaug.evaluation.trials import Trial, added_noise_note, make_trials, own_noise_note, training_noise_note, trial_of
from rawaug.evaluation.verdict import verdict
from rawaug.experiment.plan import claim, name_given_pairs, plan_data, require_free, require_usable, run_folder
from rawaug.experiment.recipe import EXPERIMENTS, ArmConfig, Recipe
from rawaug.files import find_weights, fingerprint, one_at_a_time, sha256, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, camera_law, noise_model
from rawaug.plugin.augment import RawAugment, noise_for
from rawaug.plugin.dataset import RawPairs
from rawaug.registry import Spec, spec_label, split_spec
from rawaug.seeding import derive_seed
from rawaug.training.config import weights_key
from rawaug.training.estimators import ESTIMATORS, SelfSupervised
from rawaug.training.loop import require_trainable, train
from rawaug.training.noisy_frames import FrozenPictures, NoisyCrops, drop_clean, faintness_note, noisy_frame, r2r_trials
from rawaug.training.state import first_network, start_of
from rawaug.training.stream import WATCHED, PictureCrops, RealCrops, Source, TrainingStream, freeze_samples

SHOWN = 3
"""Test frames in ``picture.png``."""

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
        overwrite: whether a run of this name with other settings is replaced; what does not depend on them is kept.
        pairs: frames in place of those that ``data.pairs`` names. Without ``validation`` a part of them is held out.
        validation: frames in place of those that ``data.validation`` names.
        test: frames in place of those that ``data.test`` names.
    """
    given = {"pairs": pairs, "validation": validation, "test": test}
    given_frames = {key: frames for key, frames in given.items() if frames is not None}
    return TrainingRun(recipe, overwrite, given_frames).run_stages()


class TrainingRun:
    """One recipe on its data; what could be missing or wrong is opened or tried before anything is fitted.

    ``isp``, ``noise``, ``frames`` and ``trials`` are those of the seed that runs. A kind of experiment with another
    target overrides :meth:`stream`, :meth:`validation_trials`, :meth:`test_trials`, :meth:`evaluate` or :meth:`report`.

    Args:
        recipe: what is run.
        overwrite: whether a run of this name with other settings is replaced.
        given: frames in place of those that the recipe names: ``pairs``, ``validation``, ``test``.
    """

    input: Any = NOISY
    """The denoiser that stands for the noisy input in tables."""
    compared_in: ClassVar[str] = ""
    """Ends the table's title with what is compared, if it is not RAW."""
    isp: DictionaryISP
    noise: NoiseModel
    frames: Mapping[str, Sequence[Any]]
    trials: Sequence[Trial]
    noise_note: str

    def __init__(self, recipe: Recipe, overwrite: bool, given: Mapping[str, Sequence[Pair]]) -> None:
        recipe = name_given_pairs(recipe, given)
        require_free(recipe, overwrite)
        require_trainable(recipe.device, recipe.devices, recipe.train.precision, recipe.train.logger)
        self.recipe, self.data, self.overwrite = recipe, recipe.data, overwrite
        self.folder, self.seeds = run_folder(recipe), range(recipe.seed, recipe.seed + recipe.seeds)
        self.classical = find_classical(recipe.classical, shown=_leads())
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
        files = [find_denoiser(name) for name in recipe.untouched]
        untouched = [RawDenoiser.of(file, recipe.device, name=file.stem) for file in files]
        self.others = [one.require_mosaic() for one in (*map(RawDenoiser.of, self.classical), *untouched)]
        plan = plan_data(recipe, given)
        _say(*plan.lines(recipe))
        plan, self.unreadable = plan.read()
        _say(*self.unreadable)
        self.pairs, self.validation, self.test = list(plan.pairs), plan.validation, plan.test
        if recipe.self_supervised:  # from here on nothing knows a clean frame but the test
            self.pairs, self.validation = ([drop_clean(p) for p in part] for part in (self.pairs, self.validation))
        self.pictures = PairPictures(self.pairs) if self.data.pictures == OWN_PICTURES else plan.pictures
        self.results: Results = {arm: [] for arm in recipe.arms}
        self.models: dict[str, Denoiser] = {}
        require_usable(recipe, self.pairs, self.validation)

    @one_at_a_time(lambda self: self.folder if _leads() else None)
    def run_stages(self) -> Results:
        """Fit, train and evaluate with every seed, then report; the results by arm, one entry a seed."""
        if _leads():
            claim(self.recipe, self.overwrite)
        for seed in self.seeds:
            self.isp = self.fit_isp(seed)
            if not self.models or self.recipe.noise == "camera":  # another fit may have measured another law
                self._add_noise()
            for arm in self.recipe.arms:
                self.models[arm] = self.train_arm(arm, seed)
                if _leads():
                    self.results[arm].append(self.evaluate(arm, seed))
        if _leads():
            self.report()
        return self.results

    def _add_noise(self) -> None:
        """Set the noise of this seed, and the frames and trials that have it."""
        self.noise = noise_for(self.isp, self.recipe.noise)
        self.trials, self._noisy = self.test_trials(), list[Row]()
        parts = {"pairs": self.pairs, "validation": self.validation}
        self.frames = {part: frames_of(self.recipe, pairs, self.isp) for part, pairs in parts.items()}
        if _leads() and not self.models:
            _say(added_noise_note(self.trials))
            self.noise_note = training_noise_note(self.pairs, self.noise, self._arms_with_clean_targets())
            _say(self.noise_note)
            _say(faintness_note(self.frames["pairs"]) if self.recipe.self_supervised else "")

    def _arms_with_clean_targets(self) -> list[str]:
        """The arms that train on clean real frames."""
        arms = self.recipe.arms.items()
        return [name for name, arm in arms if arm.sees_clean and arm.augmented < 1.0]

    def arm_folder(self, arm: str, seed: int) -> Path:
        """The folder of an arm's weights, log and scores."""
        return self.folder / f"seed{seed}" / arm

    def pattern(self, arm: str) -> CFA:
        """The CFA that an arm is trained for: that of the weights that it starts from, else the ISP's."""
        start = self.starts[arm]
        return self.isp.cfa if start is None else start.cfa

    def fit_isp(self, seed: int) -> DictionaryISP:
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

    def train_arm(self, arm: str, seed: int) -> Denoiser:
        """The network of an arm, trained, or loaded if it has been trained with the same settings."""
        recipe, folder = self.recipe, self.arm_folder(arm, seed)
        path = folder / "denoiser.safetensors"
        config, network, start = recipe.loop_of(arm), recipe.network_of(arm), self.starts[arm]
        key = self.weights_key(arm, seed)
        if path.is_file():
            model, info = denoisers.load(path)
            if info.get("key") == key:
                print(f"already trained: {path}")
                return model
        isp = change_cfa(self.isp, self.pattern(arm))
        stream, watched = self.stream(arm, isp, seed), self.validation_trials(isp)
        where: dict[str, Any] = {"device": recipe.device, "devices": recipe.devices, "label": f"seed {seed}, {arm}"}
        how: dict[str, Any] = {"estimator": self.estimators[arm], "choose": bool(self.validation), "key": key}
        model = train(stream, watched, network, config, folder, seed, **where, **how)
        if not _leads():
            return model
        levels = camera_law(isp.info["noise"]).spec() if recipe.noise == "camera" else recipe.noise
        info = {"key": key, "cfa": str(isp.cfa), "noise": levels, "steps": config.steps, "seed": seed, "arm": arm}
        info |= {} if recipe.arms[arm].sees_clean else {"estimator": recipe.arms[arm].estimator}
        info |= {} if start is None else {"start": network.start, "start_sha256": start.sha256}
        info |= {"real_pairs": [pair.name for pair in self.pairs], "pictures": self.data.pictures}
        denoisers.save(model, path, info)
        (folder / "last.pt").unlink(missing_ok=True)
        return model

    def stream(self, arm: str, isp: DictionaryISP, seed: int) -> TrainingStream:
        """The training samples of an arm; ``isp`` has the arm's CFA."""
        settings, frames = self.recipe.arms[arm], self.frames["pairs"]
        return training_stream(self.recipe, settings, frames, self.pictures, isp, self.noise, seed)

    def validation_trials(self, isp: DictionaryISP) -> list[Trial]:
        """The frozen samples by which the weights of every arm are chosen; ``isp`` has the arm's CFA."""
        return validation_samples(self.recipe, self.frames["validation"], self.pictures, isp, self.noise)

    def weights_key(self, arm: str, seed: int) -> str:
        """Hash the settings and frames that the weights of an arm depend on."""
        recipe, data, start = self.recipe, self.data, self.starts[arm]
        real = self.isp.info["key"], recipe.noise, data.pairs, stamps(self.pairs)
        pictures = data.pictures, len(self.pictures), data.max_pixels
        how = recipe.target, asdict(recipe.arms[arm]), self.estimators[arm].revision, start and start.sha256
        watched = data.validation, data.validation_crop, stamps(self.validation), recipe.validation_noise
        validation = watched if self.validation else None
        samples = (seed, *real, *pictures, *how)
        return weights_key(recipe.network_of(arm), recipe.loop_of(arm), samples, validation)

    def evaluate(self, arm: str, seed: int) -> dict[str, Any]:
        """The arm's summaries ``plain`` and ``self_ensemble`` on the test frames; those in its file are kept."""
        path = self.arm_folder(arm, seed) / "evaluation.json"
        known = json.loads(path.read_text()) if path.is_file() else {}
        key = self.scores_key(sha256(path.with_name("denoiser.safetensors")))
        result: dict[str, Any] = known if known.get("key") == key else {"key": key}
        kinds = KINDS[: 1 + self.recipe.self_ensemble]
        missing = [kind for kind in kinds if kind not in result]
        if not missing:
            print(f"already evaluated: {path}")
        for kind in missing:
            one = self.denoiser(arm, self.recipe.views if kind == "self_ensemble" else 1)
            rows = list(score([one], self.trials, f"evaluate {arm}, {kind}"))
            result[kind] = summary(rows, self.noisy_rows())
            write_json(result, path)
            print(f"evaluated {arm}, seed {seed}, {kind}: {result[kind].get('psnr', math.nan):.2f} dB: {path}")
        return {kind: result[kind] for kind in kinds}

    def scores_key(self, digest: str) -> str:
        """Hash what the scores of an arm depend on besides the noise and the arm's own settings.

        ``digest`` is that of its weights.
        """
        frames = self.data.test, self.data.test_crop, self.data.bin, stamps(self.test)
        return fingerprint(digest, *frames, self.recipe.views)

    def test_trials(self) -> Sequence[Trial]:
        """The test frames with their frozen noise, each made when it is first asked for."""
        return make_trials(self.test, lambda pair: trial_of(pair, self.noise, self.isp.cfa))

    def noisy_rows(self) -> list[Row]:
        """The scores of the input itself."""
        self._noisy = self._noisy or list(score([self.input], self.trials))
        return self._noisy

    def denoiser(self, arm: str, views: int = 1) -> RawDenoiser:
        """An arm's network as it is tested; one whose training diverged is scored as it is."""
        cfa, device = self.pattern(arm), self.recipe.device
        return RawDenoiser.of(self.models[arm], device, name=arm, cfa=cfa, views=views, checked=False)

    def report(self) -> None:
        """Write ``results.json``, the table, the picture, and the page with all of it."""
        recipe, results = self.recipe, self.results
        others: dict[str, Any] = {}
        everything: dict[str, Any] = {"recipe": asdict(recipe), "results": results, "others": others}
        everything |= {"unreadable": self.unreadable} if self.unreadable else {}
        file = self.folder / "results.json"
        write_json(everything, file)
        others |= {name: summary(rows, self.noisy_rows()) for name, rows in self._score_others().items()}
        write_json(everything, file)
        settings = f"real pairs: {len(self.pairs)}, steps: {recipe.train.steps}, seeds: {recipe.seeds}"
        title = f"{recipe.name} tested on {self.data.test} ({settings}){self.compared_in}"
        use = self.usage(others)
        facts = {"Noise": recipe.noise, "To use it": use[-1].partition(": ")[2], "Training frames": self.noise_note}
        everyone = [*self.others, *(self.denoiser(arm) for arm in self.models)]
        named = {one.name for one in everyone}
        about = {name: text for name, text in methods_of(recipe).items() if name in named}
        page = Page.of_scores(title, results, others, facts, about)
        picture = self._draw(page, everyone)
        print_table(results, title, others)
        _say(page.lead, own_noise_note(first_runs(results, others)), self.noise_note)
        print(f"table: {file}\npicture: {picture}\npage: {self.folder / 'report.html'}")
        _say(*reports(self.pictures), *self.unreadable, *use)
        require_numbers(
            [*(scores for runs in results.values() for run in runs for scores in run.values()), *others.values()]
        )

    def _score_others(self) -> dict[str, list[Row]]:
        return group_rows(score(self.others, self.trials, "other denoisers")) if self.others else {}

    def _draw(self, page: Page, denoisers: Sequence[RawDenoiser]) -> Path:
        """Write the page, with curves and frames, and the picture; of the classical denoisers they show the first."""
        page.add_curves(self.curves())
        hidden = [spec_label(spec) for spec in self.classical[1:]]
        shown = [one for one in denoisers if one.name not in hidden]
        rows: list[Panels] = []
        for trial in select_for_page(self.trials):
            row = panels_of(shown, trial, self.input)
            page.add_frame(row, self.data.test_crop)
            rows += [row] if len(rows) < SHOWN else []
        page.write(self.folder / "report.html", asdict(self.recipe))
        return save_picture(rows, self.folder / "picture.png")

    def curves(self) -> dict[str, bytes]:
        """PNG files of the arms' loss and validation PSNR, by title."""
        logs = {arm: [self.arm_folder(arm, seed) / "log.csv" for seed in self.seeds] for arm in self.recipe.arms}
        return plot_curves(logs)

    def usage(self, others: Mapping[str, Mapping[str, Any]]) -> list[str]:
        """The files of weights, and the command that uses what the verdict names; of an arm the best seed's."""
        files = {(arm, s): self.arm_folder(arm, s) / "denoiser.safetensors" for arm in self.results for s in self.seeds}
        lines = [f"denoiser, {arm}: {file}" for (arm, _), file in files.items()]
        best = verdict(self.results, others).use
        if not best:
            return [*lines, "to use: nothing is recommended, as the verdict says"]
        if best in self.results:
            runs = [run["plain"].get("psnr", 0.0) for run in self.results[best]]
            what = f"--denoiser {files[best, self.seeds[runs.index(max(runs))]]}"
        elif untouched := [name for name in self.recipe.untouched if best.partition(", ")[0] == Path(name).stem]:
            what = f"--denoiser {untouched[0]}"
        elif best in others:
            spec = next(spec for spec in self.classical if f"{best}, ".startswith(f"{spec_label(spec)}, "))
            what = f"--classical {spec if isinstance(spec, str) else shlex.quote(json.dumps(spec))}"
        else:
            return [*lines, "to use: nothing, the frames are best as they are"]
        return [*lines, f"to use {best}: rawaug denoise IN.dng OUT.dng {what}"]


def _say(*lines: str) -> None:
    """Print what is not empty, in the process that writes."""
    if any(lines) and _leads():
        print("\n".join(filter(None, lines)))


def _leads() -> bool:
    """Whether this is the one of several training processes that writes and evaluates."""
    with extra("train"):
        from lightning_fabric.utilities.rank_zero import rank_zero_only

    return getattr(rank_zero_only, "rank", 0) == 0


def find_classical(specs: Sequence[Spec], shown: bool = True) -> list[Spec]:
    """The classical denoisers of a recipe; BM3D is left out if its wheel is missing, which is printed if ``shown``.

    Raises:
        ValueError: if another filter's library is missing, or a filter or setting is unknown.
    """
    bm3d = {"BM3D": FILTERS["BM3D"].missing()}
    kept = [spec for spec in specs if not bm3d.get(split_spec(spec)[0])]
    if shown and len(kept) < len(specs):
        print(f"classical: BM3D is left out: {bm3d['BM3D']}")
    require_classical(kept)
    return kept


# -- the arms ----------------------------------------------------------------------------------------------------------


def methods_of(recipe: Recipe) -> dict[str, str]:
    """Explain each row of the table in a line, by its name."""
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
