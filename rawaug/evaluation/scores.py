"""PSNR and SSIM of denoisers on trials: flat rows, their means as the JSON that others read, their tables and pictures.

Scores are those of the whole mosaic, and once more of sRGB, after one fixed development of result and clean frame:
bilinear demosaic, the frame's white balance and colour matrix, one exposure taken from the clean frame, the sRGB curve
of IEC 61966-2-1. Pictures show the same development. What is developed already is compared as it is, cut to [0, 1].
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from denoisers.network import PACKED
from rawaug import bayer
from rawaug.data.pairs import centre
from rawaug.denoising.denoiser import Noisy
from rawaug.errors import escape, extra
from rawaug.evaluation.trials import Trial
from rawaug.metrics import psnr, ssim, worst_and_best_quarter
from rawaug.progress import progress

METRICS = ("psnr", "ssim", "psnr_srgb", "ssim_srgb")
QUARTER_OF = 4
"""Images at least, of which the worst and the best quarter are told."""
SHOWN_FAULTS = 5
"""Scores without a number that an error names."""


class Denoiser(Protocol):
    """A denoiser that can be scored: :class:`rawaug.RawDenoiser`, and whatever denoises developed pictures.

    Attributes:
        name: in tables.
        takes: ``"raw"`` or ``"srgb"``, or ``""`` for any image.
    """

    @property
    def name(self) -> str:
        """Its name in tables."""

    @property
    def takes(self) -> str:
        """The kind of image that it takes."""

    def __call__(self, given: Noisy) -> Tensor: ...


@dataclass(frozen=True)
class NoisyInput:
    """The input itself, as a denoiser that changes nothing."""

    name: str = "noisy input"
    takes: str = ""

    def __call__(self, given: Noisy) -> Tensor:
        return given.image


NOISY = NoisyInput()


class Row(NamedTuple):
    """One denoiser on one trial.

    Attributes:
        denoiser: its name, with the way that follows it if there is one.
        frame: of the trial, as ``condition``, ``strength`` and ``domain`` are.
        psnr: in dB in the trial's domain.
        ssim: in the trial's domain.
        psnr_srgb: in dB after development; None for what is developed already.
        ssim_srgb: after development; None for what is developed already.
        own_noise: the reference's own noise as a share of the squared error, if it is known.
        levels: (shot_var, read_var) that the denoiser was told, if any.
        levels_from_clean: whether these were measured against the clean frame.
        seconds: time that the denoiser took for each megapixel of its input.
    """

    denoiser: str
    frame: str
    condition: str
    strength: str
    domain: str
    psnr: float
    ssim: float | None = None
    psnr_srgb: float | None = None
    ssim_srgb: float | None = None
    own_noise: float | None = None
    levels: tuple[float, float] | None = None
    levels_from_clean: bool = False
    seconds: float = 0.0


def score(denoisers: Sequence[Denoiser], trials: Iterable[Trial], label: str = "") -> Iterator[Row]:
    """Every denoiser on every trial, one trial in memory at a time.

    Args:
        denoisers: what is compared, see :meth:`rawaug.RawDenoiser.of`; :data:`NOISY` is the input itself.
        trials: see :func:`rawaug.evaluation.trials.trial_of`.
        label: of the progress.

    Example:
        >>> from rawaug import RawDenoiser
        >>> from rawaug.data import demo_pairs
        >>> from rawaug.evaluation.trials import trial_of
        >>> from rawaug.noise import noise_model
        >>> trial = trial_of(demo_pairs("test", count=1)[0].middle(64), noise_model("cycleisp_sidd"))
        >>> noisy, denoised = score([NOISY, RawDenoiser.of("NonLocalMeans")], [trial])
        >>> denoised.psnr > noisy.psnr
        True
    """
    for trial in progress(trials, label=label, unit="image") if label else trials:
        for denoiser in denoisers:
            yield from _rows(denoiser, trial)


def _rows(denoiser: Denoiser, trial: Trial) -> Iterator[Row]:
    given = trial.input_for(denoiser)
    start = time.perf_counter()
    found = denoiser(given)
    seconds = (time.perf_counter() - start) / (given.image.numel() / 1e6)
    for name, image in to_domain(denoiser.name, found, trial):
        figures = compare(image, trial)
        error = 10.0 ** (-figures[0] / 10.0)
        share = None if trial.own is None or not error > 0 else trial.own / error
        row = Row(name, trial.frame, trial.condition, trial.strength, trial.domain, *figures, share, given.levels)
        yield row._replace(levels_from_clean=trial.levels_from_clean, seconds=seconds)


def to_domain(name: str, denoised: Tensor, trial: Trial) -> Iterator[tuple[str, Tensor]]:
    """A denoiser's result in the trial's domain, by name.

    RAW ``(1, 4, h, w)`` goes all of the trial's ways there, whose names follow that of the denoiser.
    """
    if denoised.shape[1] == trial.clean.shape[1]:
        yield name, denoised
        return
    for way, follow in trial.ways.items():
        yield f"{name}, {way}", follow(denoised)


def compare(image: Tensor, trial: Trial) -> tuple[float, float, float | None, float | None]:
    """PSNR in dB and SSIM of an image against the clean one of the same shape, and both again after development.

    ``image`` has the form of the trial's domain: ``(1, 4, h, w)`` or ``(1, 3, H, W)``.
    """
    own = [_as_compared(x, trial) for x in (image, trial.clean)]
    first = psnr(*own).item(), ssim(*own).item()
    if trial.develop is None or trial.domain == "srgb":
        return *first, None, None
    shown = [trial.develop(x)[None] for x in (image, trial.clean)]
    return *first, psnr(*shown).item(), ssim(*shown).item()


def _as_compared(image: Tensor, trial: Trial) -> Tensor:
    if trial.domain == "raw":
        return image if image.shape[1] == 1 else bayer.unpack(image, trial.cfa)
    return image.clamp(0.0, 1.0) if trial.domain == "srgb" else image


@dataclass
class Panels:
    """One trial in pictures.

    Attributes:
        trial: of which these are.
        images: ``(1, 4, h, w)`` or ``(1, 3, H, W)``, like the trial's noisy or clean one, by title; the clean one last.
        captions: by title.
    """

    trial: Trial
    images: dict[str, Tensor] = field(default_factory=dict)
    captions: dict[str, str] = field(default_factory=dict)

    def show(self, image: Tensor) -> Tensor:
        """An image, or a part of one, ``(1, C, H, W)``, as sRGB ``(3, H, W)`` in [0, 1]."""
        return image[0].clamp(0.0, 1.0) if self.trial.develop is None else self.trial.develop(image)


def panels_of(denoisers: Sequence[Denoiser], trial: Trial, noisy: Denoiser = NOISY) -> Panels:
    """The trial noisy, denoised by each, and clean; captions say the PSNR. ``noisy`` shows the noisy input."""
    panels = Panels(trial)
    for title, denoiser in {"noisy": noisy, **{one.name: one for one in denoisers}}.items():
        for name, image in to_domain(title, denoiser(trial.input_for(denoiser)), trial):
            panels.images[name] = image
            panels.captions[name] = f"{psnr(*(_as_compared(x, trial) for x in (image, trial.clean))).item():.2f} dB"
    panels.images["clean"] = trial.clean
    panels.captions["clean"] = trial.frame
    return panels


def group_rows(rows: Iterable[Row], key: str = "denoiser") -> dict[str, list[Row]]:
    """Rows by their denoiser, or by another of their attributes, in their order."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        found.setdefault(getattr(row, key), []).append(row)
    return found


def summary(rows: Iterable[Row], noisy: Iterable[Row] = ()) -> dict[str, Any]:
    """The scores of one denoiser as JSON.

    Args:
        rows: one a trial.
        noisy: the rows of the input on the same trials, in the same order.

    Returns:
        ``images``, the scores of each; the mean of each of :data:`METRICS`, and of its worst and best 25%; the same of
        the noisy input; ``own_noise``; ``levels_from_clean``, the number of images whose noise levels were
        measured against the clean frame; and ``no_numbers``, which names scores that are infinite or NaN, such as the
        PSNR of two equal frames. What does not apply is left out.
    """
    rows, noisy = list(rows), list(noisy)
    images = [_image(row) for row in rows]
    result: dict[str, Any] = {"images": images}
    if flagged := sum(row.levels_from_clean for row in rows):
        result["levels_from_clean"] = flagged
    wrong: list[str] = []
    for key, scored in ((f"{metric}{end}", of) for end, of in (("", rows), ("_noisy", noisy)) for metric in METRICS):
        known = []
        for image, row in zip(images, scored, strict=False):
            value = getattr(row, key.removesuffix("_noisy"))
            if value is not None and math.isfinite(value):
                image[key] = value
                known.append(value)
            elif value is not None:
                wrong.append(f"{row.frame}: {key} is {value}")
        if known:
            result[key] = sum(known) / len(known)
        if len(known) >= QUARTER_OF:
            result[f"{key}_worst25"], result[f"{key}_best25"] = worst_and_best_quarter(known)
    return result | _own_noise(rows, images) | ({"no_numbers": wrong} if wrong else {})


def _image(row: Row) -> dict[str, Any]:
    levels = {} if row.levels is None else dict(zip(("shot_var", "read_var"), row.levels, strict=True))
    return {"name": row.frame, **levels, **({"levels_from_clean": True} if row.levels_from_clean else {})}


def _own_noise(rows: Sequence[Row], images: Sequence[dict[str, Any]]) -> dict[str, float]:
    """The references' own noise as a share of the squared error: of each image, in place, and of all together."""
    errors, own = [], []
    for row, image in zip(rows, images, strict=True):
        if row.own_noise is not None and "psnr" in image:
            errors.append(10.0 ** (-row.psnr / 10.0))
            own.append(row.own_noise * errors[-1])
            image["own_noise"] = row.own_noise
    return {"own_noise": sum(own) / sum(errors)} if own else {}


def require_numbers(summaries: Iterable[Mapping[str, Any]]) -> None:
    """Raise ValueError if summaries left out scores; called once all else is printed and written."""
    faults = [fault for one in summaries for key in ("broken", "no_numbers") for fault in one.get(key, ())]
    if faults:
        more = f"; and {len(faults) - SHOWN_FAULTS} more" if len(faults) > SHOWN_FAULTS else ""
        raise ValueError(f"left out of the means: {'; '.join(faults[:SHOWN_FAULTS])}{more}")


# -- tables and pictures -----------------------------------------------------------------------------------------------

PANEL = 256
"""Largest side of a panel in mosaic pixels: larger frames are shown as a crop of the centre."""

ACROSS = 4
"""Panels side by side, at most: more make captions too small to read on a page."""
WIDTH = 140
"""Columns of a printed table where stdout is no terminal."""

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
