"""The report of a run: ``results.json``, tables, a picture, the page with all of it, and the command to use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from denoisers.network import Denoiser
from rawaug.data.folders import reports
from rawaug.evaluation.figures import plot_curves
from rawaug.evaluation.page import Page
from rawaug.evaluation.scores import require_numbers
from rawaug.evaluation.tables import first_runs, print_table
from rawaug.evaluation.trials import own_noise_note
from rawaug.evaluation.verdict import Verdict, verdict
from rawaug.experiment.stages import (
    Camera,
    Experiment,
    Results,
    Summaries,
    is_leader,
    score_methods,
    without_tables,
)
from rawaug.files import write_json
from rawaug.registry import spec_label
from rawaug.tasks.settings import Recipe


class Report:
    """The scores of a run, collected as they come.

    Args:
        experiment: the run.

    Attributes:
        networks: the networks of the last seed, by arm.
        tables: by table and arm, one entry for each seed: the summaries ``plain`` and ``self_ensemble``.
        noise_note: a line on training frames that have much noise themselves; empty if there are none.
    """

    def __init__(self, experiment: Experiment) -> None:
        self.experiment = experiment
        self.networks: dict[str, Denoiser] = {}
        self.tables: dict[str, dict[str, list[Summaries]]] = {}
        self.noise_note = ""

    def add(self, arm: str, network: Denoiser, scores: Mapping[str, Summaries]) -> None:
        """Add the scores of an arm for one more seed."""
        self.networks[arm] = network
        for group, summaries in scores.items():
            self.tables.setdefault(group, {}).setdefault(arm, []).append(summaries)

    @property
    def results(self) -> Results:
        """Return the scores as in ``results.json``; in a process that writes nothing, arms have no entries."""
        if not self.tables:
            return {arm: [] for arm in self.experiment.recipe.arms}

        results: Results = without_tables(self.tables)
        return results


def write_report(report: Report, camera: Camera) -> None:
    """Write ``results.json``, the picture and the page, and print the tables.

    Args:
        report: the scores of the arms.
        camera: the ISP, noise and trials of the last seed.

    Raises:
        ValueError: if a score is not a number; everything else has been written by then.
    """
    experiment = report.experiment
    recipe, task, folder = experiment.recipe, experiment.task, experiment.folder

    others: dict[str, dict[str, Any]] = {group: {} for group in report.tables}
    file = _write_results(report, others)
    methods = _choose_methods(report, camera)
    others |= score_methods(camera, methods)
    _write_results(report, others)

    verdicts = {}
    for group, results in report.tables.items():
        verdicts[group] = verdict(results, others[group])
    commands = usage(experiment, report.tables, verdicts)

    title = _title_of(experiment)
    page = Page(title, _lead_of(verdicts))
    page.add_facts(_facts_of(report, others, commands[-1]), next(iter(report.tables.values())))
    page.add("Methods", terms=_methods_of(experiment, methods))
    for group, results in report.tables.items():
        page.add_scores(results, others[group], group)

    page.add_curves(curves(experiment), *_notes_on_losses(recipe))
    panels = task.panels(_shown_methods(report, camera, methods), camera.trials)
    for row in panels:
        page.add_frame(row, recipe.data.test_crop)
    page.write(folder / "report.html", asdict(recipe))
    picture = task.save_picture(panels, folder / "picture.png")

    for group, results in report.tables.items():
        print_table(results, ": ".join(filter(None, [title, group])), others[group])
    say(page.lead, own_noise_note(_all_first_runs(report, others)), report.noise_note)
    print(f"table: {file}\npicture: {picture}\npage: {folder / 'report.html'}")
    say(*reports(experiment.inputs.pictures), *experiment.unreadable, *commands)
    _require_all_numbers(report, others)


def say(*lines: str) -> None:
    """Print the lines that are not empty, in the process that writes."""
    text = "\n".join(filter(None, lines))
    if text and is_leader():
        print(text)


# -- scores ------------------------------------------------------------------------------------------------------------


def _write_results(report: Report, others: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write ``results.json`` and return its path."""
    experiment = report.experiment
    tables = {}
    for group, results in report.tables.items():
        tables[group] = {"results": results, "others": others[group]}

    content = {"recipe": asdict(experiment.recipe), **without_tables(tables)}
    content |= experiment.task.notes(experiment.inputs.test)
    if experiment.unreadable:
        content["unreadable"] = experiment.unreadable

    path = experiment.folder / "results.json"
    write_json(content, path)
    return path


def _choose_methods(report: Report, camera: Camera) -> dict[str, list[Any]]:
    """Choose the denoisers that arms are compared with, by table."""
    experiment = report.experiment
    arm = next(iter(experiment.recipe.arms))
    methods = {}
    for group in report.tables:
        validation = camera.validation_trials(arm)
        methods[group] = experiment.task.methods_for(group, experiment.methods, validation)

    return methods


def _all_first_runs(report: Report, others: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Collect the summary of every method by name and table; an arm has that of its first seed."""
    runs = {}
    for group, results in report.tables.items():
        for name, scores in first_runs(results, others[group]).items():
            runs[_with_group(name, group)] = scores

    return runs


def _with_group(name: str, group: str) -> str:
    """Name a row, with its table if there are several."""
    return ", ".join(filter(None, [name, group]))


def _require_all_numbers(report: Report, others: Mapping[str, Mapping[str, Any]]) -> None:
    """Raise ValueError if a score of any table is not a number."""
    summaries: list[Mapping[str, Any]] = []
    for group, results in report.tables.items():
        for runs in results.values():
            for run in runs:
                summaries += run.values()
        summaries += others[group].values()

    require_numbers(summaries)


# -- what the page says ------------------------------------------------------------------------------------------------


def _title_of(experiment: Experiment) -> str:
    """Write the title of the tables and the page, which says what was tested on what."""
    recipe, task = experiment.recipe, experiment.task
    settings = f"real pairs: {len(experiment.inputs.pairs)}, steps: {recipe.train.steps}, seeds: {recipe.seeds}"
    title = f"{recipe.name} tested on {recipe.data.test} ({settings})"
    return ": ".join(filter(None, [title, task.compared_in]))


def _lead_of(verdicts: Mapping[str, Verdict]) -> str:
    """Write the verdict of each table as a sentence, headed by what the table is about."""
    sentences = []
    for group, one in verdicts.items():
        heading = group[:1].upper() + group[1:]
        sentences.append(": ".join(filter(None, [heading, one.sentence])))

    return " ".join(sentences)


def _facts_of(report: Report, others: Mapping[str, Mapping[str, Any]], command: str) -> dict[str, Any]:
    """Collect what the page states besides the scores, by term; ``command`` is the line that ends a run."""
    task = report.experiment.task
    return {
        "Noise": task.test_noise(),
        "To use it": command.partition(": ")[2],
        "Training frames": report.noise_note,
        "Own noise": own_noise_note(_all_first_runs(report, others)),
    }


def _methods_of(experiment: Experiment, methods: Mapping[str, Sequence[Any]]) -> dict[str, str]:
    """Write a line on each row of the tables, by name; ``methods`` are the denoisers besides arms, by table."""
    filters = {spec_label(spec) for spec in experiment.recipe.classical}

    texts = {}
    for of_group in methods.values():
        for one in of_group:
            if one.name in filters:
                texts[one.name] = "a filter, nothing is trained"
            else:
                texts[one.name] = "trained weights as they are"

    for label in experiment.recipe.arms:
        texts[label] = _explain(experiment, label)

    return texts


def _explain(experiment: Experiment, label: str) -> str:
    """Say in a line what an arm is trained on."""
    arm, network = experiment.recipe.arms[label], experiment.recipe.network(label)
    start = f"{network.name} from random weights"
    if network.start is not None:
        start = f"{network.start}, trained further"

    real, synthetic = "real noisy frames", experiment.task.synthetic
    how = f", by {spec_label(arm.estimator)}"
    if arm.sees_clean:
        real, how = "real pairs", ""

    frames = f"{real}, with {synthetic} as {arm.augmented:.0%} of a batch"
    if arm.augmented == 0.0:
        frames = real
    elif arm.augmented == 1.0:
        frames = synthetic

    return f"{start}, on {frames}{how}"


def curves(experiment: Experiment) -> dict[str, bytes]:
    """Plot the arms' loss and validation PSNR as PNG files, by title."""
    logs = {}
    for arm in experiment.recipe.arms:
        logs[arm] = [experiment.arm_folder(arm, seed) / "log.csv" for seed in experiment.seeds]

    return plot_curves(logs)


def _notes_on_losses(recipe: Recipe) -> list[str]:
    """Write a note if the losses of arms are in different units."""
    weighings = {recipe.loop(arm).weigh for arm in recipe.arms}
    if len(weighings) == 1:
        return []

    return [f"Losses compare between arms of the same weighting alone (weigh: {', '.join(sorted(weighings))})."]


def _shown_methods(report: Report, camera: Camera, methods: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """Choose the denoisers whose pictures are shown, by table: first filter, trained denoisers, arms."""
    experiment = report.experiment
    hidden = {spec_label(spec) for spec in experiment.classical[1:]}

    arms = []
    for arm, network in report.networks.items():
        arms.append(experiment.task.denoiser(arm, network, camera.pattern(arm)))

    denoisers = {}
    for group, of_group in methods.items():
        denoisers[group] = [one for one in of_group if one.name not in hidden] + arms

    return denoisers


def usage(
    experiment: Experiment, tables: Mapping[str, Mapping[str, Sequence[Summaries]]], verdicts: Mapping[str, Verdict]
) -> list[str]:
    """List the files of weights and the commands for what the verdicts name; an arm has its best seed's."""
    lines = []
    for arm in experiment.recipe.arms:
        for seed in experiment.seeds:
            lines.append(f"denoiser, {arm}: {experiment.arm_folder(arm, seed) / 'denoiser.safetensors'}")

    for group, one in verdicts.items():
        line = _command(experiment, tables[group], one)
        if line not in lines:
            lines.append(line)

    return lines


def _command(experiment: Experiment, results: Mapping[str, Sequence[Summaries]], one: Verdict) -> str:
    """Write the command that uses what a verdict recommends."""
    if not one.use:
        return "to use: nothing is recommended, as the verdict says"

    command = experiment.task.command_of_method(one.use)
    if one.use in results:
        scores = [run["plain"].get("psnr", 0.0) for run in results[one.use]]
        seed = experiment.seeds[scores.index(max(scores))]
        path = experiment.arm_folder(one.use, seed) / "denoiser.safetensors"
        command = experiment.task.command_of_weights(path)

    if not command:
        return "to use: nothing, the frames are best as they are"

    return f"to use {one.use}: {command}"
