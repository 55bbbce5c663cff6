"""The report of a run: ``results.json``, tables, a picture, the page with all of it, and the command to use."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from denoisers.files import find_denoiser
from rawaug.bayer import noise_variance
from rawaug.data.folders import reports
from rawaug.data.pairs import Pair
from rawaug.evaluation.figures import Panels, crops_at_100, plot_curves, save_picture
from rawaug.evaluation.page import Page
from rawaug.evaluation.scores import require_numbers
from rawaug.evaluation.tables import first_runs, print_table
from rawaug.evaluation.trials import own_noise_note
from rawaug.evaluation.verdict import verdict
from rawaug.experiment.settings import Recipe
from rawaug.experiment.task import Task, find_classical
from rawaug.files import write_json
from rawaug.io.pictures import write_picture
from rawaug.registry import spec_label, split_spec

_MOST_ROWS = 3
"""Largest number of test frames of RAW in ``picture.png``."""

ScoresByTable = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""By table, ``results`` has the summaries ``plain`` and ``self_ensemble`` for each seed of an arm, and ``others`` the
summary of each denoiser that arms are compared with, by name."""


def write_results(task: Task, folder: Path, tables: ScoresByTable, unreadable: Sequence[str]) -> dict[str, Any]:
    """Write ``results.json`` and return the scores of the arms; a table without a name is not named there either.

    Args:
        task: the task.
        folder: folder of the run.
        tables: the scores, as far as there are any.
        unreadable: lines that name frames which cannot be read.
    """
    by_table: Mapping[str, Any] = tables
    results: dict[str, Any] = {table: scores["results"] for table, scores in tables.items()}
    if set(tables) == {""}:
        by_table, results = tables[""], results[""]

    content = {"recipe": asdict(task.recipe), **by_table}
    if task.recipe.target == "srgb":  # scores of RAW state the frames' own noise themselves
        content["own_noise"] = {}
        for pair in task.frames["test"]:
            levels = pair.clean.noise_profile if isinstance(pair, Pair) else None  # developed pictures state none
            if levels is not None:
                content["own_noise"][pair.name] = noise_variance(pair.clean.mosaic, *levels).mean().item()
    if unreadable:
        content["unreadable"] = list(unreadable)

    write_json(content, folder / "results.json")
    return results


def write_report(
    task: Task,
    folder: Path,
    tables: ScoresByTable,
    panels: Sequence[Panels],
    training_note: str,
    unreadable: Sequence[str],
) -> None:
    """Write the picture and the page, and print the tables, the verdict and the command to use.

    Args:
        task: the task.
        folder: folder of the run.
        tables: the scores.
        panels: the frames of the page.
        training_note: a line on training frames that have much noise themselves; empty if there are none.
        unreadable: lines that name frames which cannot be read.

    Raises:
        ValueError: if a score is not a number; everything else has been written by then.
    """
    recipe: Recipe = task.recipe

    # Verdicts, and what they recommend.
    sentences, uses, first = [], {}, {}
    for table, scores in tables.items():
        decision = verdict(scores["results"], scores["others"])
        uses[table] = decision.use
        sentences.append(with_name(table[:1].upper() + table[1:], decision.sentence, ": "))
        for name, summary in first_runs(scores["results"], scores["others"]).items():
            first[with_name(name, table)] = summary

    commands = usage(recipe, folder, tables, uses)
    own_noise = own_noise_note(first)

    # The page.
    settings = f"real pairs: {len(task.frames['pairs'])}, steps: {recipe.train.steps}, seeds: {recipe.seeds}"
    title = f"{recipe.name} tested on {recipe.data.test} ({settings})"
    if recipe.full_colour:
        title += ": linear camera RGB"
    elif recipe.target == "srgb":
        title += ": developed sRGB"

    page = Page(title, " ".join(filter(None, sentences)))
    facts = {
        "Noise": recipe.noise_in_test,
        "To use it": commands[-1].partition(": ")[2],
        "Training frames": training_note,
        "Own noise": own_noise,
    }
    page.add_facts(facts, next(iter(tables.values()))["results"])
    page.add("Methods", terms=explain_methods(recipe))
    for table, scores in tables.items():
        page.add_scores(scores["results"], scores["others"], table)

    logs = {}
    for arm in recipe.arms:
        logs[arm] = [folder / f"seed{seed}" / arm / "log.csv" for seed in recipe.all_seeds]
    note = ""
    weighings = sorted({recipe.loop(arm).weigh for arm in recipe.arms})
    if len(weighings) > 1:
        note = f"Losses compare between arms of the same weighting alone (weigh: {', '.join(weighings)})."
    page.add_curves(plot_curves(logs), *filter(None, [note]))

    for row in panels:
        page.add_frame(row, recipe.data.test_crop)
    page.write(folder / "report.html", asdict(recipe))

    picture = folder / "picture.png"
    if recipe.target == "srgb":
        write_picture(picture, crops_at_100(panels))
    else:
        save_picture(panels[:_MOST_ROWS], picture)

    # What is printed.
    for table, scores in tables.items():
        print_table(scores["results"], with_name(title, table, ": "), scores["others"])
    paths = f"table: {folder / 'results.json'}\npicture: {picture}\npage: {folder / 'report.html'}"
    lines = [page.lead, own_noise, training_note, paths, *reports(task.frames["pictures"]), *unreadable, *commands]
    print(*filter(None, lines), sep="\n")

    summaries: list[Mapping[str, Any]] = []
    for scores in tables.values():
        for runs in scores["results"].values():
            for run in runs:
                summaries += run.values()
        summaries += scores["others"].values()
    require_numbers(summaries)


def with_name(name: str, table: str, between: str = ", ") -> str:
    """Join two texts, of which one may be empty."""
    return between.join(filter(None, [name, table]))


def explain_methods(recipe: Recipe) -> dict[str, str]:
    """Write a line on each method, by the name that its rows begin with."""
    texts = {}
    for spec in find_classical(recipe.classical):
        texts[spec_label(spec)] = "a filter, nothing is trained"
    for file in recipe.baselines:
        texts[find_denoiser(file).stem] = "trained weights as they are"

    synthetic = "RAW made from pictures"
    if recipe.target == "srgb":
        synthetic = "developed pictures with noise"

    for label, arm in recipe.arms.items():
        network = recipe.network(label)
        start = f"{network.name} from random weights"
        if network.start is not None:
            start = f"{network.start}, trained further"

        real, estimator = "real noisy frames", f", by {spec_label(arm.estimator)}"
        if arm.sees_clean:
            real, estimator = "real pairs", ""

        samples = f"{real}, with {synthetic} as {arm.augmented:.0%} of a batch"
        if arm.augmented == 0.0:
            samples = real
        elif arm.augmented == 1.0:
            samples = synthetic
        texts[label] = f"{start}, on {samples}{estimator}"

    return texts


# -- what to use -------------------------------------------------------------------------------------------------------


def usage(recipe: Recipe, folder: Path, tables: ScoresByTable, uses: Mapping[str, str]) -> list[str]:
    """List the files of weights, and the command for what each table recommends; an arm has its best seed's weights.

    Args:
        recipe: the recipe.
        folder: folder of the run.
        tables: the scores of the arms.
        uses: by table, the name of the recommended method; empty if nothing is recommended.
    """
    weights = {}
    for arm in recipe.arms:
        weights[arm] = [folder / f"seed{seed}" / arm / "denoiser.safetensors" for seed in recipe.all_seeds]

    lines = []
    for arm, files in weights.items():
        lines += [f"denoiser, {arm}: {file}" for file in files]

    for table, name in uses.items():
        command = method_command(recipe, name)
        if name in weights:
            scores = [run["plain"].get("psnr", 0.0) for run in tables[table]["results"][name]]
            command = weights_command(recipe, weights[name][scores.index(max(scores))])

        line = f"to use {name}: {command}"
        if not name:
            line = "to use: nothing is recommended, as the verdict says"
        elif not command:
            line = "to use: nothing, the frames are best as they are"
        if line not in lines:
            lines.append(line)

    return lines


def weights_command(recipe: Recipe, path: Path) -> str:
    """Write the command that uses the weights of an arm."""
    kind = "dng"
    if recipe.target == "srgb":
        kind = "jpg"

    return f"rawaug denoise IN.{kind} OUT.{kind} --denoiser {shlex.quote(str(path))}"


def method_command(recipe: Recipe, name: str) -> str:
    """Write the command that uses a method besides the arms, by the name of its row; empty for the noisy input."""
    for baseline in recipe.baselines:
        if name.partition(", ")[0] == Path(baseline).stem:
            return f"rawaug denoise IN.dng OUT.dng --denoiser {shlex.quote(baseline)}"

    for spec in recipe.classical:
        if not f"{name}, ".startswith(f"{spec_label(spec)}, "):
            continue
        if recipe.target == "srgb":
            return f"rawaug denoise IN.jpg OUT.jpg --denoiser {shlex.quote(split_spec(spec)[0])}"

        text = spec if isinstance(spec, str) else json.dumps(spec)
        return f"rawaug denoise IN.dng OUT.dng --classical {shlex.quote(text)}"

    return ""
