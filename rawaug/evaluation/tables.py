"""The results of an experiment: tables of scores, and a picture of noisy, denoised and clean side by side.

RAW is developed for the eye by one fixed pipeline, the same for every panel of a row: bilinear demosaic, the frame's
white balance and colour matrix, one exposure taken from the clean frame, the sRGB curve of IEC 61966-2-1.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

from denoisers.network import PACKED
from rawaug.data.pairs import centre
from rawaug.errors import escape, extra
from rawaug.evaluation.scores import METRICS, Panels

PANEL = 256
"""Largest side of a panel in mosaic pixels: larger frames are shown as a crop of the centre."""

ACROSS = 4
"""Panels side by side, at most: more make captions too small to read on a page."""
WIDTH = 140
"""Columns of a printed table where stdout is no terminal."""
MATTERS = 0.05
"""The gain in dB below which an arm is not preferred to a denoiser that needs no training."""

FIGURES = {
    "psnr": "PSNR (dB)",
    "ssim": "SSIM",
    "psnr_srgb": "PSNR, sRGB",
    "ssim_srgb": "SSIM, sRGB",
    "own_noise": "own noise",
}
"""Headings by figure: of the mosaic, of its development, and the references' own share of the squared error."""

Runs = Mapping[str, Sequence[Mapping[str, Any]]]
"""For each arm a list with one entry a seed: summaries by kind, ``plain`` and ``self_ensemble``."""
Columns = Mapping[str, tuple[str, str]]
"""For each heading of a table the kind of summary, and the figure in it, that the column shows."""
PLAIN: Columns = {name: ("plain", key) for key, name in FIGURES.items()}
ENSEMBLE: Columns = {name: ("self_ensemble", key) for key, name in FIGURES.items()}
QUARTERS: Columns = {
    f"{FIGURES[key]}, {part} 25%": ("plain", f"{key}_{part}25") for key in METRICS for part in ("worst", "best")
}
PRINTED: Columns = {
    **dict(list(PLAIN.items())[:2]),
    "PSNR, self-ensemble": ("self_ensemble", "psnr"),
    "SSIM, self-ensemble": ("self_ensemble", "ssim"),
    **PLAIN,
}


def new_figure(width: float, height: float) -> Any:
    """An empty figure of matplotlib's, its sides in inches; no display is needed."""
    with extra("train"):
        from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_picture(rows: Sequence[Panels], path: Path) -> Path:
    """Write the panels of each row as a picture, at most :data:`ACROSS` side by side; the path."""
    columns = min(ACROSS, max(len(row.images) for row in rows))
    lines = [-(-len(row.images) // columns) for row in rows]
    figure = new_figure(2.1 * columns, 2.5 * sum(lines))
    axes = figure.subplots(sum(lines), columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for row, first in zip(rows, accumulate(lines, initial=0), strict=False):
        for axis, (title, image) in zip(axes[first:].flat, row.images.items(), strict=False):
            side = PANEL // 2 if image.shape[1] == PACKED else PANEL
            panel = row.show(centre(image, side, side, step=1))
            axis.imshow(panel.permute(1, 2, 0).numpy(), interpolation="nearest")
            caption = f"{escape(title)}\n{escape(row.captions.get(title, ''))}"
            axis.set_title(caption, fontsize=9, parse_math=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    return path


def mean_and_spread(values: Sequence[float], digits: int) -> str:
    """``mean``, or ``mean ± standard deviation`` of several values."""
    mean = f"{statistics.fmean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.{digits}f}"


def format_figure(key: str, value: float | None) -> str:
    """The figure of a metric as tables have it; empty if there is none."""
    if value is None:
        return ""
    return f"{value:.0%}" if key == "own_noise" else f"{value:.{_digits(key)}f}"


def join_figures(scores: Mapping[str, Any], first: str, second: str) -> str:
    """Two figures in a cell; a dash stands for what is no number."""
    return " / ".join(format_figure(key, scores.get(key)) or "-" for key in (first, second))


def _digits(key: str) -> int:
    return 2 if "psnr" in key else 4


class Table(NamedTuple):
    """A table: its columns, cells by row, empty where a figure does not apply, and the best cells of columns."""

    columns: list[str]
    rows: dict[str, list[str]]
    best: set[tuple[str, int]]


def table_of(results: Runs, others: Mapping[str, Mapping[str, Any]] | None, columns: Columns) -> Table:
    """The noisy input, other denoisers and the arms, without columns and rows that have no figure."""
    plain = next(iter(results.values()))[0]["plain"]
    noisy = {key.replace("_noisy", ""): value for key, value in plain.items() if "_noisy" in key}
    single = {"noisy input": noisy, **(others or {})}
    methods: Runs = {**{name: [{"plain": scores}] for name, scores in single.items()}, **results}
    found = {head: {name: _values(runs, *of) for name, runs in methods.items()} for head, of in columns.items()}
    found = {head: column for head, column in found.items() if any(column.values())}
    best: set[tuple[str, int]] = set()
    for k, (head, column) in enumerate(found.items()):
        key = columns[head][1]
        means = {name: round(statistics.fmean(values), _digits(key)) for name, values in column.items() if values}
        if len(means) > 1 and key != "own_noise":
            best |= {(name, k) for name, mean in means.items() if mean == max(means.values())}
    named = [name for name in methods if any(column[name] for column in found.values())]
    rows = {name: [_cell(columns[head][1], column[name]) for head, column in found.items()] for name in named}
    return Table(list(found), rows, best)


def first_runs(results: Runs, others: Mapping[str, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    """The summary of every method by name; of an arm that of its first seed."""
    return {**others, **{arm: runs[0]["plain"] for arm, runs in results.items()}}


def _values(runs: Sequence[Mapping[str, Any]], kind: str, key: str) -> list[float]:
    return [run[kind][key] for run in runs if key in run.get(kind, {})]


def _cell(key: str, values: Sequence[float]) -> str:
    if len(values) > 1 and key != "own_noise":
        return mean_and_spread(values, _digits(key))
    return format_figure(key, statistics.fmean(values) if values else None)


NOISY = "the noisy input"


def verdict(results: Runs, others: Mapping[str, Mapping[str, Any]]) -> tuple[str, str]:
    """The method to use, which is an arm, one of the others or :data:`NOISY`; and the reason in a line.

    The arm of the highest mean PSNR is compared with the best of the others, or with the noisy input. Both are empty
    if nothing has a PSNR.
    """
    means = {arm: statistics.fmean(found) for arm, runs in results.items() if (found := _values(runs, "plain", "psnr"))}
    if not means:
        return "", ""
    arm = max(means, key=means.__getitem__)
    runs = [run["plain"] for run in results[arm]]
    noisy = {key.removesuffix("_noisy"): value for key, value in runs[0].items() if key.endswith("_noisy")}
    noisy["images"] = [{"psnr": image.get("psnr_noisy")} for image in runs[0]["images"]]
    scored = {name: scores for name, scores in others.items() if "psnr" in scores} or {NOISY: noisy}
    other = max(scored, key=lambda name: scored[name]["psnr"])
    gains = [run["psnr"] - scored[other]["psnr"] for run in runs if "psnr" in run]
    gain = statistics.fmean(gains)
    said = [f"{arm}, the best arm, scores {abs(gain):.2f} dB {'more' if gain >= 0 else 'less'}"]
    if better := gain >= MATTERS:
        said = [f"{gain:+.2f} dB over {other}"]
    if len(gains) > 1:
        spread = statistics.stdev(gains)
        said += [f"{'within' if abs(gain) <= spread else 'more than'} the noise of the seeds (± {spread:.2f} dB)"]
    else:
        pairs = list(zip(runs[0]["images"], scored[other]["images"], strict=False))
        higher = sum((one.get("psnr") or 0.0) > (two.get("psnr") or 0.0) for one, two in pairs)
        said += [f"higher on {higher} of {len(pairs)} frames, one seed"]
    if "psnr_srgb" in scored[other] and all("psnr_srgb" in run for run in runs):
        developed = statistics.fmean(run["psnr_srgb"] for run in runs) - scored[other]["psnr_srgb"]
        said += [f"{developed:+.2f} dB after development"]
    chosen = arm if better else other
    return chosen, f"Use {chosen}: {', '.join(said)}."


def print_rows(title: str, head: Sequence[str], *sections: Sequence[Sequence[str]]) -> None:
    """Print a table with a name and figures in each row, and a line between sections."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(escape(title)))
    for k, column in enumerate(head):
        table.add_column(column, justify="right" if k else "left")
    for rows in sections:
        for row in rows:
            table.add_row(*(Text(escape(cell)) for cell in row))  # Text: brackets are no markup
        table.add_section()
    console = Console()
    (console if console.is_terminal else Console(width=WIDTH)).print(table)


def levels_note(summary: Mapping[str, Any]) -> str:
    """A line on scores whose noise levels came from the clean frames; empty if there are none."""
    flagged = summary.get("levels_from_clean")
    if not flagged:
        return ""
    images = len(summary["images"])
    return f"* noise levels of {flagged} of {images} images were measured against their clean frames"


def print_table(results: Runs, title: str, others: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """Print PSNR and SSIM of every method: in RAW plain and by self-ensemble, and developed.

    ``results`` has one entry a seed in an arm's list, ``others`` a summary by name.
    """
    table = table_of(results, others, PRINTED)
    print_rows(title, ["arm", *table.columns], [[method, *cells] for method, cells in table.rows.items()])
    if note := levels_note(next(iter(results.values()))[0]["plain"]):
        print(note)


def print_scores(result: Mapping[str, Any]) -> None:
    """Print the table of ``rawaug evaluate`` from what ``--json`` writes."""
    denoiser = result["kind"] == "denoiser"
    figures = [key for key in (FIGURES if denoiser else ("psnr",)) if key != "own_noise" or key in result]

    def row(name: str, scores: Mapping[str, Any], form: str = "{}") -> list[str]:
        return [name, *(format_figure(key, scores.get(form.format(key))) for key in figures)]

    images = [row(f"{one['name']}{' *' if one.get('levels_from_clean') else ''}", one) for one in result["images"]]
    shown = {"mean": "{}", "worst 25%": "{}_worst25", "best 25%": "{}_best25", "noisy": "{}_noisy"}
    means = [row(name, result, form) for name, form in shown.items() if form.format("psnr") in result]
    others = {"mean, without self-ensemble": result["plain"]} if "plain" in result else {}
    means += [row(name, scores) for name, scores in (others | result.get("classical", {})).items()]
    title = "PSNR_d, RAW denoising" if denoiser else "PSNR_r, RAW reconstruction"
    title += f", self-ensemble of {result['views']} views" if result.get("self_ensemble") else ""
    print_rows(f"{title}: {result['data']}", ["image", *(FIGURES[key] for key in figures)], images, means)
    if note := levels_note(result):
        print(note)
