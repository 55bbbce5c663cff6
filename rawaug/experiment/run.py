"""A recipe from the file to the table: fit the ISP, train every arm, score it, report.

Each stage leaves a file in ``OUT/NAME`` with a hash of everything that it depends on, and is left out if that file is
there already (:func:`rawaug.files.cached`), so that a stopped run resumes.
"""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, redirect_stdout
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import denoisers
from denoisers.classical import FILTERS
from denoisers.files import find_denoiser
from denoisers.network import Denoiser
from rawaug.bayer import CFA
from rawaug.data.frames import as_frames
from rawaug.data.opening import picture_stamp
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.figures import make_panels
from rawaug.evaluation.scores import Row, group_rows, score, summary
from rawaug.evaluation.trials import Trial, added_noise_note, training_noise_note
from rawaug.experiment.data import name_given_pairs, open_frames, read_frames, require_usable
from rawaug.experiment.folder import claim, require_free
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.experiment.report import write_report, write_results
from rawaug.experiment.settings import Recipe
from rawaug.experiment.task import TASKS, Task, find_classical
from rawaug.files import LOCK, cached, fingerprint, locked, sha256
from rawaug.isp.model import DictionaryISP
from rawaug.noise import camera_law, noise_model
from rawaug.progress import progress
from rawaug.training.camera_fit import fit
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.launch import is_leader, require_trainable
from rawaug.training.loop import train
from rawaug.training.noisy_frames import faintness_note
from rawaug.training.state import first_network

Results = dict[str, Any]
"""Summaries ``plain`` and ``self_ensemble`` for each seed, by arm; by table before, if there are several."""


@contextmanager
def printing_once() -> Iterator[None]:
    """Print nothing in this block, or function, in all processes of a training but the first."""
    with redirect_stdout(sys.stdout if is_leader() else io.StringIO()):
        yield


@printing_once()
def run(
    recipe: Recipe,
    overwrite: bool = False,
    *,
    pairs: Sequence[Pair] | None = None,
    validation: Sequence[Pair] | None = None,
    test: Sequence[Pair] | None = None,
) -> Results:
    """Run a recipe and return its results, as in ``results.json``.

    Of several processes (``devices``) the first one writes; the others return no scores.

    Args:
        recipe: the recipe to run.
        overwrite: whether a run of this name with other settings is replaced; what does not depend on them is kept.
        pairs: frames in place of those that ``data.pairs`` names. Without ``validation``, a part of them is held out.
        validation: frames in place of those that ``data.validation`` names.
        test: frames in place of those that ``data.test`` names.

    Returns:
        By arm, one entry for each seed: the summaries ``plain`` and ``self_ensemble``. If a task has several tables, by
        pattern or level, each of these has such results.
    """
    leads = is_leader()
    sequences = {"pairs": pairs, "validation": validation, "test": test}
    replacements = {part: sequence for part, sequence in sequences.items() if sequence is not None}
    recipe = name_given_pairs(recipe, replacements)

    # Prepare: whatever could be missing or wrong is found before anything is fitted.
    folder = require_free(recipe, overwrite)
    require_runnable(recipe)
    finished_isp = None
    if recipe.isp is not None:
        finished_isp = recipe.isp.load()
    baselines = []
    for file in map(find_denoiser, recipe.baselines):
        baselines.append(RawDenoiser.of(file, recipe.device, name=file.stem).require_mosaic())

    frames, listing = open_frames(recipe, replacements)
    print(*listing, sep="\n")
    frames, unreadable = read_frames(recipe, frames)
    for line in unreadable:
        print(line)
    require_usable(recipe, frames["pairs"], frames["validation"])

    tables: dict[str, dict[str, dict[str, Any]]] = {}
    networks: dict[str, Any] = {}
    with locked(folder / LOCK) if leads else nullcontext():
        if leads:
            claim(recipe, overwrite)

        for seed in recipe.all_seeds:
            # Fit the ISP. If it has measured the noise, the test frames have this noise; else they stay.
            file = folder / f"seed{seed}" / "isp.safetensors"
            isp = finished_isp or fit_to_pairs(recipe, frames["pairs"], file, seed)
            task: Task = TASKS[recipe.kind](recipe, isp, frames)
            if leads and (seed == recipe.seed or recipe.noise == "camera"):
                trials = task.test()
                noisy_rows = group_rows(score([task.input], trials), "table")
            if leads and seed == recipe.seed:
                training_note = warn_of_noise(task, trials)

            make_validation = cache(task.validation)  # arms of one pattern share it
            for arm in recipe.arms:
                # Train.
                arm_folder = folder / f"seed{seed}" / arm
                cfa = find_pattern(recipe, arm, isp)
                network = train_arm(task, arm, cfa, seed, make_validation(cfa), arm_folder)

                # Score.
                if not leads:
                    continue
                networks[arm] = task.denoiser(arm, network, cfa)
                by_kind = {"plain": networks[arm]}
                if recipe.self_ensemble:
                    by_kind["self_ensemble"] = task.denoiser(arm, network, cfa, recipe.views)
                scores = score_arm(task, by_kind, trials, noisy_rows, f"{arm}, seed {seed}", arm_folder)
                for table, summaries in scores.items():
                    parts = tables.setdefault(table, {"results": {}, "others": {}})
                    parts["results"].setdefault(arm, []).append(summaries)

        if not leads:
            return {arm: [] for arm in recipe.arms}

        # Score what the arms are compared with; what there is by then is in results.json.
        write_results(task, folder, tables, unreadable)
        filters = {table: task.filters(table) for table in tables}
        compared = {table: [*filters[table], *baselines] for table in tables}
        for table, summaries in score_tables(compared, trials, noisy_rows, "other denoisers").items():
            tables[table]["others"] = summaries
        results = write_results(task, folder, tables, unreadable)

        # Report: the page shows the first filter, the baselines and the arms.
        panels = []
        for trial in task.shown(trials):
            shown = filter(trial.takes, [*filters[trial.table][:1], *baselines, *networks.values()])
            panels.append(make_panels(list(shown), trial, task.input))

        write_report(task, folder, tables, panels, training_note, unreadable)
        return results


# -- prepare -----------------------------------------------------------------------------------------------------------


def require_runnable(recipe: Recipe) -> None:
    """Refuse a recipe that cannot run here, before any data are opened; BM3D is left out, and a line says so.

    Raises:
        MissingExtra: if a library is not installed.
        ValueError: if the device or a filter is unavailable, the noise is unknown, or a network does not suit its
            start, its estimator or the recipe's target.
    """
    require_trainable(recipe.device, recipe.devices, recipe.train.precision, recipe.train.logger)
    if len(find_classical(recipe.classical)) < len(recipe.classical):
        print(f"classical: BM3D is left out: {FILTERS['BM3D'].missing()}")
    if recipe.noise != "camera":
        noise_model(recipe.noise_at_iso)

    upscale = 1
    if recipe.target == "rgb":
        upscale = 2

    for label, arm in recipe.arms.items():
        config = recipe.network(label)
        network = first_network(config, seed=0)
        ESTIMATORS.make(arm.estimator).require(network)
        if network.upscale != upscale:
            gives = "no full colour"
            if network.upscale > 1:
                gives = "full colour: rawaug run demosaic trains it"
            raise ValueError(f"denoiser: {config.start or type(network).__name__} gives {gives}; take another network")


def warn_of_noise(task: Task, trials: Iterable[Trial]) -> str:
    """Print notes on the frames' own noise; return the one on training frames, which is empty if there is none."""
    arms = []
    for name, arm in task.recipe.arms.items():
        if arm.sees_clean and arm.augmented < 1.0:
            arms.append(name)

    training_note = training_noise_note(task.frames["pairs"], task.noise, arms)
    notes = [added_noise_note(trials), training_note]
    if task.recipe.self_supervised:
        notes.append(faintness_note(task.real))
    for note in filter(None, notes):
        print(f"note: {note}")

    return training_note


# -- fit, train --------------------------------------------------------------------------------------------------------


def fit_to_pairs(recipe: Recipe, pairs: Sequence[Pair], file: Path, seed: int) -> DictionaryISP:
    """Fit the ISP to the few pairs, or read it if it was fitted to them before; its hash is ``info["key"]``."""
    settings = {**asdict(recipe.fit), "seed": seed}
    noise: Literal["on", "off"] = "on" if recipe.noise == "camera" else "off"
    inputs = "isp", settings, as_frames(pairs).stamps(), noise == "on", recipe.self_supervised

    def read(path: Path) -> tuple[DictionaryISP, Mapping[str, Any]]:
        isp = DictionaryISP.from_pretrained(path)
        return isp, isp.info

    def write(isp: DictionaryISP, path: Path, key: str) -> None:
        isp.info["key"] = key
        isp.save(path)

    return cached(file, inputs, lambda: fit(pairs, noise=noise, **settings), read, write, done="already fitted")


def find_pattern(recipe: Recipe, arm: str, isp: DictionaryISP) -> CFA:
    """Find the CFA that an arm is trained for: that of the weights that it starts from, else the ISP's."""
    if recipe.full_colour:
        return CFA.RGGB  # the truth is mosaicked anew

    start = recipe.network(arm).start
    if start is None:
        return isp.cfa

    _, info = denoisers.load(find_denoiser(start))
    return CFA(info.get("cfa", "RGGB"))


def train_arm(task: Task, arm: str, cfa: CFA, seed: int, validation: Sequence[Trial], folder: Path) -> Denoiser:
    """Train the network of an arm, or read it if it has been trained on the same before.

    Args:
        task: the task.
        arm: name of the arm.
        cfa: the pattern that it is trained for.
        seed: seed of the training.
        validation: the frozen samples that choose the weights.
        folder: gets the weights, the checkpoint and the log.
    """
    recipe, frames = task.recipe, task.frames
    settings, config = recipe.arms[arm], recipe.network(arm)
    estimator = ESTIMATORS.make(settings.estimator)

    info = {
        "cfa": str(cfa),
        "noise": recipe.noise_at_iso,
        "steps": recipe.loop(arm).steps,
        "seed": seed,
        "arm": arm,
        "real_pairs": [pair.name for pair in frames["pairs"]],
        "pictures": recipe.data.pictures,
    }
    if recipe.noise == "camera":
        info["noise"] = camera_law(task.isp.info["noise"]).spec()
    if settings.estimator != "supervised":
        info["estimator"] = settings.estimator
    if config.start is not None:
        info["start"] = config.start
        info["start_sha256"] = sha256(find_denoiser(config.start))

    inputs = {
        "settings": recipe.weights_settings(arm),
        "seed": seed,
        "isp": task.isp.info["key"],
        "pairs": as_frames(frames["pairs"]).stamps(),
        "more": as_frames(frames["more"]).stamps() if settings.source == "more" else [],
        "pictures": picture_stamp(recipe.data.pictures),
        "validation": as_frames(frames["validation"]).stamps(),
        "start": info.get("start_sha256"),
        "estimator": estimator.revision,
    }

    def make() -> Denoiser:
        return train(
            task.stream(arm, cfa, seed),
            validation,
            config,
            recipe.loop(arm),
            folder,
            seed,
            device=recipe.device,
            devices=recipe.devices,
            label=f"seed {seed}, {arm}",
            estimator=estimator,
            choose=bool(frames["validation"]),
            key=fingerprint(inputs),
        )

    def write(network: Denoiser, path: Path, key: str) -> None:
        if is_leader():
            denoisers.save(network, path, {"key": key, **info})
            (folder / "last.pt").unlink(missing_ok=True)

    path = folder / "denoiser.safetensors"
    return cached(path, inputs, make, denoisers.load, write, done="already trained")


# -- score -------------------------------------------------------------------------------------------------------------


def score_arm(
    task: Task,
    by_kind: Mapping[str, Any],
    trials: Sequence[Trial],
    noisy_rows: Mapping[str, list[Row]],
    label: str,
    folder: Path,
) -> dict[str, dict[str, Any]]:
    """Compute the summaries of an arm by table and kind, ``plain`` and ``self_ensemble``, or read those of before.

    Args:
        task: the task.
        by_kind: the arm's denoisers.
        trials: the test frames with their noise.
        noisy_rows: the scores of the noisy input, by table.
        label: arm and seed, for what is printed.
        folder: has the weights, and gets ``plain.json`` and ``self_ensemble.json``.
    """
    weights = sha256(folder / "denoiser.safetensors")
    inputs = weights, as_frames(task.frames["test"]).stamps(), task.recipe.scores_settings()

    summaries: dict[str, dict[str, Any]] = {}
    for kind, denoiser in by_kind.items():
        make = partial(score_denoiser, denoiser, trials, noisy_rows, f"{label}, {kind}")
        scores = cached(folder / f"{kind}.json", [kind, *inputs], make, done="already evaluated")
        for table, scores_of_table in scores["tables"].items():
            summaries.setdefault(table, {})[kind] = scores_of_table

    return summaries


def score_denoiser(
    denoiser: Any, trials: Sequence[Trial], noisy_rows: Mapping[str, list[Row]], label: str
) -> dict[str, dict[str, Any]]:
    """Compute the summaries of one denoiser in ``tables``, without those whose pattern it does not take; print them."""
    for_all_tables = {table: [denoiser] for table in noisy_rows}
    tables = {}
    for table, summaries in score_tables(for_all_tables, trials, noisy_rows, f"evaluate {label}").items():
        if not summaries:
            continue
        tables[table] = summaries[denoiser.name]
        title = ", ".join(filter(None, [label, table]))
        print(f"evaluated {title}: {tables[table].get('psnr', math.nan):.2f} dB")

    return {"tables": tables}


def score_tables(
    by_table: Mapping[str, Sequence[Any]], trials: Sequence[Trial], noisy_rows: Mapping[str, list[Row]], label: str
) -> dict[str, dict[str, Any]]:
    """Compute the summaries of denoisers by table and name, with one trial in memory at a time.

    Args:
        by_table: the denoisers; those that do not take a trial's image are left out.
        trials: the test frames with their noise.
        noisy_rows: the scores of the noisy input, by table.
        label: label of the progress bar.
    """
    rows: dict[str, list[Row]] = {table: [] for table in by_table}
    for trial in progress(trials, label=label, unit="image"):
        rows[trial.table] += score(list(filter(trial.takes, by_table[trial.table])), [trial])

    tables: dict[str, dict[str, Any]] = {}
    for table, of_table in rows.items():
        tables[table] = {}
        for name, of_denoiser in group_rows(of_table).items():
            tables[table][name] = summary(of_denoiser, noisy_rows[table])

    return tables


# -- kinds of experiment -----------------------------------------------------------------------------------------------


def run_kind(kind: str, settings: Any, overwrite: bool = False) -> Any:
    """Run the settings of a kind of experiment, a task or a comparison of methods."""
    if kind in TASKS:
        return run(settings, overwrite)

    return EXPERIMENTS[kind](settings, overwrite)


def dry_run(kind: str, settings: Any, overwrite: bool = False) -> None:
    """Print what data a training would use, and try the run in its shortest form in a temporary folder.

    Args:
        kind: kind of the experiment.
        settings: the experiment's recipe.
        overwrite: as for the run itself.
    """
    folder = require_free(settings, overwrite)
    if kind in TASKS:
        if settings.isp is not None:
            settings.isp.load()  # a mistyped name is refused before any data are opened
        _, listing = open_frames(settings, {})
        print("\n".join(listing))

    with TemporaryDirectory() as elsewhere, redirect_stdout(io.StringIO()) as output:
        run_kind(kind, replace(settings.shortest(), out=elsewhere))

    result = "no problems found"
    for line in output.getvalue().splitlines():
        if line.startswith("note: "):
            print(line)
            result = "it runs, but see the note above"

    print(f"Dry run: {result}, nothing written to {folder}")
