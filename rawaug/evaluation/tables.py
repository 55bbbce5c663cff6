"""Tables of scores: their columns, their cells, and how they are printed.

A run has a list for each arm, with one entry per seed: summaries by kind, ``plain`` and ``self_ensemble``, see
:func:`rawaug.evaluation.scores.summary`. Several seeds give a mean and a standard deviation.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rawaug.errors import count_of, escape
from rawaug.evaluation.scores import METRICS
from rawaug.evaluation.verdict import input_summary, paired_interval

WIDTH = 140
"""Width of a printed table in columns, if stdout is not a terminal."""

FIGURES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "psnr_srgb": "PSNR, sRGB",
    "ssim_srgb": "SSIM, sRGB",
    "own_noise": "own noise",
}
"""Headings by figure: of the mosaic, of its development, and the references' own share of the squared error."""

WITHOUT_BEST = {"own_noise"}
"""Figures whose highest value is not the best, so that none of their cells is marked."""

Runs = Mapping[str, Sequence[Mapping[str, Any]]]
"""A list for each arm with one entry per seed: summaries by kind, ``plain`` and ``self_ensemble``."""

Columns = Mapping[str, tuple[str, str]]
"""The kind of summary, and the figure in it, that the column under each heading of a table shows."""


def _columns(kind: str) -> Columns:
    return {heading: (kind, key) for key, heading in FIGURES.items()}


def _quarters() -> Columns:
    columns = {}
    for key in METRICS:
        for part in ("worst", "best"):
            columns[f"{FIGURES[key]}, {part} 25%"] = "plain", f"{key}_{part}25"
    return columns


PLAIN = _columns("plain")
ENSEMBLE = _columns("self_ensemble")
QUARTERS = _quarters()
_PRINTED: Columns = {
    "PSNR (dB)": ("plain", "psnr"),
    "SSIM": ("plain", "ssim"),
    "PSNR, self-ensemble": ("self_ensemble", "psnr"),
    "SSIM, self-ensemble": ("self_ensemble", "ssim"),
    **PLAIN,
}


def make_table(
    results: Runs, others: Mapping[str, Mapping[str, Any]] | None, columns: Columns
) -> tuple[list[str], dict[str, list[str]], set[tuple[str, int]]]:
    """Make a table of the noisy input, other denoisers and the arms, without columns and rows that have no figure.

    Returns:
        The headings of its columns; cells by row, which are empty if a figure does not apply; and (row, column) of the
        best cells. Scores that the frames do not tell from the highest are best, too: their paired interval holds 0. A
        column has no best cell if its highest score comes from keeping the references' own noise.
    """
    first_arm = next(iter(results.values()))
    methods: dict[str, Sequence[Mapping[str, Any]]] = {"noisy input": [{"plain": input_summary(first_arm[0]["plain"])}]}
    for name, scores in (others or {}).items():
        methods[name] = [{"plain": scores}]
    methods |= results

    # Methods that score more than a perfect denoiser would keep the references' own noise.
    keeping_noise = set()
    for name, runs in methods.items():
        if any(run["plain"].get("own_noise", 0.0) > 1.0 for run in runs):
            keeping_noise.add(name)

    headings: list[str] = []
    cells: dict[str, list[str]] = {}
    best_cells = set()
    for head, (kind, key) in columns.items():
        values = {}
        for name, runs in methods.items():
            values[name] = _values(runs, kind, key)
        if not any(values.values()):
            continue

        best = _best_rows(key, values)
        if key in METRICS:
            best = _not_told_apart(best, {name: methods[name] for name in methods if values[name]}, kind, key)
        if keeping_noise.isdisjoint(best):
            for name in best:
                best_cells.add((name, len(headings)))
        headings.append(head)
        for name in methods:
            cells.setdefault(name, []).append(_cell(key, values[name]))

    rows = {name: row for name, row in cells.items() if any(row)}
    return headings, rows, best_cells


def _best_rows(key: str, values: Mapping[str, Sequence[float]]) -> list[str]:
    """Find the rows with the highest mean, as shown, in a column of several; none if less is better."""
    means = {}
    for name, column in values.items():
        if column:
            means[name] = round(statistics.fmean(column), _digits(key))

    if len(means) < 2 or key in WITHOUT_BEST:
        return []

    best = max(means.values())
    return [name for name, mean in means.items() if mean == best]


def _not_told_apart(best: Sequence[str], methods: Runs, kind: str, key: str) -> list[str]:
    """Add to the best rows those that the frames do not tell from them; none if they tell none apart.

    Rows without scores by frame, or of another number of seeds, are compared by their means alone.
    """
    if not best:
        return []

    scores = {}
    for name, runs in methods.items():
        by_run = [[image.get(key, math.nan) for image in run.get(kind, {}).get("images", [])] for run in runs]
        scores[name] = np.array(by_run, np.float64)

    marked = []
    first = scores[best[0]]
    for name, others in scores.items():
        is_alike = name in best
        if not is_alike and others.shape == first.shape and first.size:
            differences = first - others
            paired = differences[:, np.isfinite(differences).all(axis=0)]
            is_alike = paired_interval(paired)[0] <= 0
        if is_alike:
            marked.append(name)

    if len(marked) == len(methods):
        return []
    return marked


def first_runs(results: Runs, others: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """Get the summary of every method by name; for an arm, that of its first seed."""
    summaries = dict(others)
    for arm, runs in results.items():
        summaries[arm] = runs[0]["plain"]

    return summaries


# -- cells -------------------------------------------------------------------------------------------------------------


def _values(runs: Sequence[Mapping[str, Any]], kind: str, key: str) -> list[float]:
    return [run[kind][key] for run in runs if key in run.get(kind, {})]


def _cell(key: str, values: Sequence[float]) -> str:
    if len(values) > 1 and key != "own_noise":
        return mean_and_spread(values, _digits(key))

    if not values:
        return ""

    return _format_figure(key, statistics.fmean(values))


def _digits(key: str) -> int:
    if "psnr" in key:
        return 2

    return 4


def mean_and_spread(values: Sequence[float], digits: int) -> str:
    """Format ``mean``, or ``mean ± standard deviation`` of several values."""
    mean = f"{statistics.fmean(values):.{digits}f}"
    if len(values) < 2:
        return mean

    return f"{mean} ± {statistics.stdev(values):.{digits}f}"


def _format_figure(key: str, value: float | None) -> str:
    """Format the figure of a metric for tables; empty if there is none."""
    if value is None:
        return ""
    if key == "own_noise":
        return f"{value:.0%}"

    return f"{value:.{_digits(key)}f}"


def join_figures(scores: Mapping[str, Any], first: str, second: str) -> str:
    """Format two figures for a cell; a dash stands for a missing number."""
    figure = _format_figure(first, scores.get(first)) or "-"
    second_figure = _format_figure(second, scores.get(second)) or "-"
    return f"{figure} / {second_figure}"


# -- printing ----------------------------------------------------------------------------------------------------------


def print_rows(title: str, head: Sequence[str], *sections: Sequence[Sequence[str]]) -> None:
    """Print a table with a name and figures in each row, and a line between sections."""
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    table = RichTable(title=Text(escape(title)))
    table.add_column(head[0])
    for column in head[1:]:
        table.add_column(column, justify="right")

    for rows in sections:
        for row in rows:
            table.add_row(*(Text(escape(cell)) for cell in row))  # Text, since brackets are not markup here
        table.add_section()

    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(table)


def print_cells(title: str, head: Sequence[str], cells: Mapping[str, Sequence[str]]) -> None:
    """Print a table of one section, whose cells are given by the name of their row."""
    print_rows(title, head, [[name, *row] for name, row in cells.items()])


def print_table(results: Runs, title: str, others: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """Print PSNR and SSIM of every method: in RAW, plain and by self-ensemble, and developed.

    ``results`` has one entry per seed in an arm's list, ``others`` a summary by name.
    """
    headings, rows, _ = make_table(results, others, _PRINTED)
    print_cells(title, ["arm", *headings], rows)

    first_arm = next(iter(results.values()))
    note = levels_note(first_arm[0]["plain"])
    if note:
        print(note)


def print_scores(result: Mapping[str, Any]) -> None:
    """Print the table of ``rawaug evaluate`` from what ``--json`` writes."""
    denoises = result["kind"] == "denoiser"
    title = "PSNR_r, RAW reconstruction"
    keys = ["psnr"]
    if denoises:
        title = "PSNR_d, RAW denoising"
        keys = list(METRICS)
        if "own_noise" in result:
            keys.append("own_noise")
    if result.get("self_ensemble"):
        title += f", self-ensemble of {result['views']} views"

    images = []
    for image in result["images"]:
        name = image["name"]
        if image.get("levels_from_clean"):
            name += " *"
        images.append([name, *_figures(image, keys)])

    means = []
    for name, end in (("mean", ""), ("worst 25%", "_worst25"), ("best 25%", "_best25"), ("noisy", "_noisy")):
        if f"psnr{end}" in result:
            means.append([name, *_figures(result, keys, end)])
    if "plain" in result:
        means.append(["mean, without self-ensemble", *_figures(result["plain"], keys)])
    for name, scores in result.get("classical", {}).items():
        means.append([name, *_figures(scores, keys)])

    head = ["image", *(FIGURES[key] for key in keys)]
    print_rows(f"{title}: {result['data']}", head, images, means)
    note = levels_note(result)
    if note:
        print(note)


def _figures(scores: Mapping[str, Any], keys: Sequence[str], end: str = "") -> list[str]:
    return [_format_figure(key, scores.get(key + end)) for key in keys]


def levels_note(summary: Mapping[str, Any]) -> str:
    """Make a note on scores whose noise levels came from the clean frames; empty if there are none."""
    flagged = summary.get("levels_from_clean")
    if not flagged:
        return ""

    images = count_of(len(summary["images"]), "image")
    return f"* noise levels of {flagged} of {images} were measured against their clean frames"
