"""The page of a run: one self-contained HTML file with curves, tables and pictures.

RAW is shown by the same fixed development as in :mod:`rawaug.evaluation.scores`. Each frame is shown
whole and clean, with its most detailed window at twice the size: noisy, from every arm, and clean.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch.nn.functional as F
from torch import Tensor

from denoisers.network import PACKED
from rawaug.evaluation.scores import (
    ENSEMBLE,
    PLAIN,
    QUARTERS,
    Panels,
    Runs,
    first_runs,
    join_figures,
    levels_note,
    new_figure,
    table_of,
)
from rawaug.evaluation.table_files import write_tables
from rawaug.evaluation.trials import Trial, own_noise_note
from rawaug.evaluation.verdict import verdict
from rawaug.io.pictures import encode_png

WINDOW = 64
"""Side in packed pixels of the enlarged windows."""

WHOLE = 640
"""Largest width of a whole frame on the page, in pixels."""

ON_PAGE = 12
"""Largest number of frames on the page."""

CURVES = {"loss": "loss", "psnr": "validation PSNR (dB)", "psnr_srgb": "validation PSNR, sRGB (dB)"}
"""Columns of a log that are plotted, with the titles of their plots."""


class Figure(NamedTuple):
    """A picture on the page.

    Attributes:
        png: the file.
        alt: what stands in its place where it cannot be shown.
        style: a class of the template: window, curve, or none for a whole frame.
        caption: below it.
    """

    png: bytes
    alt: str
    style: str = ""
    caption: str = ""


class Page:
    """A page, to which parts are added from top to bottom; frames are encoded as they come and not kept.

    Args:
        title: of the page.
    """

    def __init__(self, title: str) -> None:
        self.title, self.lead = title, ""
        self.parts: list[dict[str, Any]] = []

    def add(self, heading: str = "", **content: Any) -> None:
        """Add a part.

        Args:
            heading: of a chapter; without one the part belongs to the chapter before.
            content: what stands below it, as far as there is any: ``name``, a smaller heading; ``texts``, paragraphs;
                ``terms``, explanations by term; ``head`` and ``rows`` of a table, the names of columns and the cells by
                name, with the set ``best`` of (row, column) in bold; ``figures``, :class:`Figure` beside each other.
        """
        self.parts.append({"heading": heading, "best": (), **content})

    @classmethod
    def of_scores(
        cls,
        title: str,
        results: Runs,
        others: Mapping[str, Mapping[str, Any]],
        facts: Mapping[str, Any] | None = None,
        arms: Mapping[str, str] | None = None,
    ) -> Page:
        """A page with scores, which opens with the verdict.

        Args:
            title: of the page.
            results: by arm, one entry a seed.
            others: summaries of other denoisers, by name.
            facts: what else is stated, by term; ``Noise`` as a recipe has it.
            arms: what the methods are, by name.
        """
        first = next(iter(results.values()))[0]["plain"]
        about = {"Command": command_line(), **(facts or {}), "Own noise": own_noise_note(first_runs(results, others))}
        if noise := about.pop("Noise", None):
            named = noise if isinstance(noise, str) else json.dumps(noise)
            about["Noise"] = f"as captured with the frames, else {named}; {levels_range(first)}".rstrip("; ")
        page = cls(title)
        page.lead = verdict(results, others).sentence
        page.add(terms={name: text for name, text in about.items() if text})
        if arms:
            page.add("Methods", terms=arms)
        note = levels_note(first)
        for heading, columns in (("Scores", PLAIN), ("Self-ensemble", ENSEMBLE), ("Worst and best frames", QUARTERS)):
            table = table_of(results, others, columns)
            texts = [note] if note and columns is PLAIN else []
            if table.rows:
                page.add(heading, texts=texts, head=["", *table.columns], rows=table.rows, best=table.best)
        page.add("Every image", **_every_image(first_runs(results, others)))
        return page

    def add_curves(self, pngs: Mapping[str, bytes]) -> None:
        """Add pictures of the curves of a training, by title."""
        self.add("Training", figures=[Figure(png, title, "curve") for title, png in pngs.items()])

    def add_frame(self, row: Panels, crop: int | None = None) -> None:
        """Add a frame: its most detailed window in every image, and the whole of the clean one.

        Args:
            row: the images of the frame.
            crop: the side in pixels of the middle to which larger frames were cut; None if none was.
        """
        first = not any(part["heading"] == "Pictures" for part in self.parts)
        clean = row.trial.clean
        side = WINDOW if clean.shape[1] == PACKED else 2 * WINDOW
        top, left = find_detail(clean, side)
        whole, pixels = row.show(clean), 2 * WINDOW // side
        figures = []
        for name, image in row.images.items():
            png = encode_png(row.show(image[..., top : top + side, left : left + side]))
            figures.append(Figure(png, name, "window", ", ".join(filter(None, [name, row.captions.get(name)]))))
        height, width = whole.shape[-2:]
        part = name_part(height, width, crop)
        scale = min(1.0, WHOLE / whole.shape[-1])
        if scale < 1.0:
            whole = F.interpolate(whole[None], scale_factor=scale, mode="area")[0]
        caption = f"{part}, clean; window at row {pixels * top}, column {pixels * left}"
        figures.append(Figure(encode_png(whole), part, caption=caption))
        self.add("Pictures" if first else "", name=row.trial.frame, figures=figures)

    def write(self, path: Path, settings: Mapping[str, Any]) -> Path:
        """Write the page, which ends with the settings of the run, and its tables beside it; the path of the page."""
        import yaml
        from jinja2 import Environment, PackageLoader

        templates = Environment(loader=PackageLoader(__package__, ""), autoescape=True, trim_blocks=True)
        templates.filters["b64"] = lambda png: base64.b64encode(png).decode()
        template = templates.get_template("page.html")
        shown = yaml.safe_dump(json.loads(json.dumps(settings)), sort_keys=False, allow_unicode=True)
        text = template.render(title=self.title, lead=self.lead, parts=self.parts, settings=shown)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", errors="backslashreplace")
        write_tables(path, self.parts)
        return path


def name_part(height: int, width: int, crop: int | None) -> str:
    """How much of a frame is shown, with its size in pixels.

    Example:
        >>> name_part(512, 512, crop=512)
        'middle, 512 x 512'
        >>> name_part(288, 448, crop=512)
        'whole frame, 448 x 288'
    """
    cut = crop is not None and max(height, width) >= crop
    return f"{'middle' if cut else 'whole frame'}, {width} x {height}"


def command_line() -> str:
    """The command that runs, as it was typed; empty in another program."""
    return shlex.join(["rawaug", *sys.argv[1:]]) if Path(sys.argv[0]).stem in ("rawaug", "__main__") else ""


def levels_range(summary: Mapping[str, Any]) -> str:
    """The lowest and highest noise levels of the images of a summary, in words; empty if none is known."""
    said = []
    for key in ("shot_var", "read_var"):
        values = [image[key] for image in summary["images"] if key in image]
        said += [f"{key} {min(values):.2g} to {max(values):.2g}"] if values else []
    return ", ".join(said)


def select_for_page(trials: Sequence[Trial]) -> Iterator[Trial]:
    """At most :data:`ON_PAGE` of the trials, evenly spaced."""
    count = min(ON_PAGE, len(trials))
    return (trials[k * len(trials) // count] for k in range(count))


def find_detail(image: Tensor, side: int = WINDOW) -> tuple[int, int]:
    """Top and left of the window of ``side`` in which green is steepest, of ``(1, 4, h, w)`` or ``(1, 3, H, W)``."""
    green = image[:, 1:-1].mean(1, keepdim=True).clamp_min(0.0).sqrt()
    steep = (green[..., 1:, :-1] - green[..., :-1, :-1]).abs() + (green[..., :-1, 1:] - green[..., :-1, :-1]).abs()
    size = [min(side, length) for length in steep.shape[-2:]]
    scores = F.avg_pool2d(steep, size, stride=4)
    row, column = divmod(int(scores.argmax()), scores.shape[-1])
    return 4 * row, 4 * column


def plot_curves(logs: Mapping[str, Sequence[Path]]) -> dict[str, bytes]:
    """Loss and validation PSNR over the steps as PNG files by title, from the ``log.csv`` of every seed of every arm.

    The loss is the mean since the row before. A curve of one point is a dot. What no log has is left out.
    """
    rows = {(arm, k): read_log(path) for arm, paths in logs.items() for k, path in enumerate(paths)}
    colours = {arm: f"C{k % 10}" for k, arm in enumerate(logs)}
    drawn = {key: title for key, title in CURVES.items() if any(row.get(key) for log in rows.values() for row in log)}
    return {title: _plot_curve(key, title, rows, colours) for key, title in drawn.items()}


Log = Sequence[Mapping[str, str]]


def read_log(path: Path) -> Log:
    """The rows of a training's ``log.csv``."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _plot_curve(key: str, title: str, logs: Mapping[tuple[str, int], Log], colours: Mapping[str, str]) -> bytes:
    figure = new_figure(5.2, 3.6)
    axis = figure.subplots()
    for (arm, k), rows in logs.items():
        points = [(int(row["step"]), float(row[key])) for row in rows if row.get(key)]
        if points:
            marker, label = "o" if len(points) == 1 else "", None if k else arm
            axis.plot(*zip(*points, strict=True), marker=marker, color=colours[arm], linewidth=1.4, label=label)
    axis.set(xlabel="step", ylabel=title, yscale="log" if key == "loss" else "linear")
    axis.locator_params(axis="x", integer=True)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8)
    return _png(figure)


def plot_costs(rows: Mapping[str, tuple[float | None, float, float]]) -> bytes:
    """A PNG file with the PSNR of RAW and sRGB over GMAC a megapixel; a filter, which has none, is a dashed line.

    ``rows`` has GMAC and the two PSNR by the name of a denoiser.
    """
    figure = new_figure(8.4, 3.6)
    for k, (axis, title) in enumerate(zip(figure.subplots(1, 2), ("RAW", "developed sRGB"), strict=True)):
        for colour, (name, (gmac, *psnr)) in enumerate(rows.items()):
            style: dict[str, Any] = {"color": f"C{colour % 10}", "label": name}
            if gmac is None:
                axis.axhline(psnr[k], linestyle="--", **style)
            else:
                axis.plot(gmac, psnr[k], "o", **style)
        axis.set(xlabel="GMAC a megapixel", xscale="log", title=f"PSNR, {title} (dB)")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return _png(figure)


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=130)
    return file.getvalue()


def _every_image(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """PSNR / SSIM of every image by every method, on the mosaic."""
    rows: dict[str, list[str]] = {}
    for summary in summaries.values():
        for image in summary["images"]:
            cells = rows.setdefault(image["name"], [join_figures(image, "psnr_noisy", "ssim_noisy")])
            cells.append(join_figures(image, "psnr", "ssim"))
    return {"head": ["image: PSNR (dB) / SSIM", "noisy input", *summaries], "rows": rows}
