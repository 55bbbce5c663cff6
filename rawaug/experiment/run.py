"""The stages of a recipe in turn: fit the ISP, train every arm, score it, report.

Each stage leaves a file in ``OUT/NAME``. A stage whose file was made with the same settings is skipped, so that a
stopped run resumes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from dataclasses import replace
from tempfile import TemporaryDirectory
from typing import Any

from denoisers.classical import FILTERS
from denoisers.files import find_denoiser
from rawaug.data.pairs import OWN_PICTURES, Pair, PairPictures
from rawaug.denoising.denoiser import require_classical
from rawaug.evaluation.trials import added_noise_note, training_noise_note
from rawaug.experiment.folder import claim, require_free
from rawaug.experiment.inputs import Inputs, name_given_pairs, open_inputs, require_usable
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.experiment.report import Report, say, write_report
from rawaug.experiment.stages import Camera, Experiment, Results, fit_isp, is_leader, score_arm, train_arm
from rawaug.files import LOCK, locked
from rawaug.noise import noise_model
from rawaug.registry import Spec, split_spec
from rawaug.tasks.base import TASKS
from rawaug.tasks.settings import Recipe
from rawaug.training.estimators import ESTIMATORS
from rawaug.training.launch import require_trainable
from rawaug.training.noisy_frames import drop_clean, faintness_note
from rawaug.training.state import first_network, start_of


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
    frames = {}
    if pairs is not None:
        frames["pairs"] = pairs
    if validation is not None:
        frames["validation"] = validation
    if test is not None:
        frames["test"] = test

    experiment = prepare(recipe, overwrite, frames)
    leads = is_leader()

    with ExitStack() as stack:
        if leads:
            stack.enter_context(locked(experiment.folder / LOCK))
            claim(experiment.recipe, overwrite)

        report = Report(experiment)
        camera: Camera | None = None
        for seed in experiment.seeds:
            isp = fit_isp(experiment, seed)
            if camera is None:
                camera = Camera.of(experiment, isp)
                report.noise_note = warn_of_noise(camera)
            else:
                camera = camera.with_isp(isp)

            for arm in experiment.recipe.arms:
                network = train_arm(experiment, camera, arm, seed)
                if leads:
                    report.add(arm, network, score_arm(experiment, camera, arm, seed, network))

        if leads and camera is not None:
            write_report(report, camera)

        return report.results


def prepare(recipe: Recipe, overwrite: bool, frames: dict[str, Sequence[Pair]]) -> Experiment:
    """Prepare an experiment: open or try everything that could be missing or wrong, before anything is fitted."""
    recipe = name_given_pairs(recipe, frames)
    folder = require_free(recipe, overwrite)
    require_trainable(recipe.device, recipe.devices, recipe.train.precision, recipe.train.logger)

    isp = None
    if recipe.isp_source is not None:
        isp = recipe.isp_source.load()

    task = TASKS[recipe.kind](recipe)
    classical = find_classical(recipe.classical, shown=is_leader())
    if recipe.noise != "camera":
        noise_model(recipe.noise_at_iso)

    estimators = {}
    starts = {}
    for label, arm in recipe.arms.items():
        config = recipe.network(label)
        network = first_network(config, seed=0)
        estimators[label] = ESTIMATORS.make(arm.estimator)
        estimators[label].require(network)
        task.require_network(network, config.start or type(network).__name__)
        starts[label] = start_of(config)

    baselines = [find_denoiser(name) for name in recipe.baselines]
    methods = task.open_methods(classical, baselines)

    inputs = open_inputs(recipe, frames, task)
    say(*inputs.lines(recipe))
    inputs, unreadable = inputs.read()
    say(*unreadable)
    inputs = _hide_clean_frames(recipe, inputs)
    require_usable(recipe, inputs.pairs, inputs.validation)

    return Experiment(recipe, task, folder, isp, inputs, unreadable, classical, methods, estimators, starts)


def _hide_clean_frames(recipe: Recipe, inputs: Inputs) -> Inputs:
    """Keep the inputs in memory; if no arm sees clean frames, only the test knows any from here on."""
    pairs = list(inputs.pairs)
    validation = inputs.validation
    if recipe.self_supervised:
        pairs = list(map(drop_clean, pairs))
        validation = list(map(drop_clean, validation))

    pictures = inputs.pictures
    if recipe.data.pictures == OWN_PICTURES:
        pictures = PairPictures(pairs)

    return replace(inputs, pairs=pairs, validation=validation, pictures=pictures)


def warn_of_noise(camera: Camera) -> str:
    """Print notes on the frames' own noise; return the one on training frames, which is empty if there is none."""
    if not is_leader():
        return ""

    recipe, inputs = camera.experiment.recipe, camera.experiment.inputs
    arms = []
    for name, arm in recipe.arms.items():
        if arm.sees_clean and arm.augmented < 1.0:
            arms.append(name)

    training_note = training_noise_note(inputs.pairs, camera.noise, arms)
    notes = [added_noise_note(camera.trials), training_note]
    if recipe.self_supervised:
        notes.append(faintness_note(camera.pairs))
    for note in filter(None, notes):
        say(f"note: {note}")

    return training_note


def find_classical(specs: Sequence[Spec], shown: bool = True) -> list[Spec]:
    """Find a recipe's classical denoisers, without BM3D if its wheel is missing; if ``shown``, that is printed.

    Raises:
        ValueError: if another filter's library is missing, or a filter or setting is unknown.
    """
    missing = FILTERS["BM3D"].missing()
    installed = []
    for spec in specs:
        name, _ = split_spec(spec)
        if name != "BM3D" or not missing:
            installed.append(spec)

    if shown and len(installed) < len(specs):
        print(f"classical: BM3D is left out: {missing}")

    require_classical(installed)
    return installed


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
        if settings.isp_source is not None:
            settings.isp_source.load()  # a mistyped name is refused before any data are opened
        print("\n".join(open_inputs(settings, {}).lines(settings)))

    with TemporaryDirectory() as elsewhere, redirect_stdout(io.StringIO()) as output:
        run_kind(kind, replace(settings.shortest(), out=elsewhere))

    result = "no problems found"
    for line in output.getvalue().splitlines():
        if line.startswith("note: "):
            print(line)
            result = "it runs, but see the note above"

    print(f"Dry run: {result}, nothing written to {folder}")
