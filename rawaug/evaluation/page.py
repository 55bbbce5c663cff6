"""The page of a run: one self-contained HTML file with curves, tables and pictures.

RAW is shown by the same fixed development as in :mod:`rawaug.evaluation.tables`. Each frame is shown
whole and clean, with its most detailed window at twice the size: noisy, from every arm, and clean.
"""

from __future__ import annotations

import base64
import csv
import io
import json
import shlex
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import torch.nn.functional as F
from torch import Tensor

from denoisers.network import PACKED
from rawaug.errors import extra
from rawaug.evaluation.scores import Panels
from rawaug.evaluation.tables import (
    ENSEMBLE,
    PLAIN,
    QUARTERS,
    Runs,
    both,
    figures_of,
    first_runs,
    levels_note,
    verdict,
)
from rawaug.evaluation.trials import Trial, own_noise_note
from rawaug.io.pictures import encode_png

WINDOW = 64
"""Side in packed pixels of the enlarged windows."""

WHOLE = 640
"""Largest width of a whole frame on the page, in pixels."""

ON_PAGE = 12
"""Largest number of frames on the page."""

CURVES = {"loss": "loss", "psnr": "validation PSNR, RAW (dB)", "psnr_srgb": "validation PSNR, sRGB (dB)"}
"""Columns of a log that are drawn, with what they are."""
LINES = {"": "-", "_low": ":", "_middle": "--", "_high": "-."}


class Figure(NamedTuple):
    """A PNG file on the page; ``style`` is a class of the template: window, curve, or none for a whole frame."""

    png: bytes
    alt: str
    style: str = ""
    caption: str = ""


@dataclass
class Part:
    """What stands under a heading: texts, explained terms, a table, figures; what is empty is left out."""

    heading: str = ""
    name: str = ""
    texts: Sequence[str] = ()
    terms: Mapping[str, str] = field(default_factory=dict)
    head: Sequence[str] = ()
    rows: Mapping[str, Sequence[str]] = field(default_factory=dict)
    best: Collection[tuple[str, int]] = ()
    figures: Sequence[Figure] = ()


class Page:
    """Collects the parts of the page; frames are encoded as they come and not kept."""

    def __init__(self, title: str, parts: Sequence[Part] = (), lead: str = "") -> None:
        self.title, self.parts, self.lead = title, list(parts), lead

    @classmethod
    def of_scores(
        cls,
        title: str,
        results: Runs,
        classical: Mapping[str, Mapping[str, Any]],
        facts: Mapping[str, Any] | None = None,
        arms: Mapping[str, str] | None = None,
    ) -> Page:
        """A page with the scores of ``results``, by arm with one entry a seed, and of classical denoisers, by name.

        It opens with the verdict and the ``facts``, ``Noise`` as in a recipe; ``arms`` says what the methods are.
        """
        first = next(iter(results.values()))[0]["plain"]
        about = {
            "Command": command_line(),
            **(facts or {}),
            "Own noise": own_noise_note(first_runs(results, classical)),
        }
        if noise := about.pop("Noise", None):
            named = noise if isinstance(noise, str) else json.dumps(noise)
            about["Noise"] = f"as captured with the frames, else {named}; {levels_range(first)}".rstrip("; ")
        about = {name: text for name, text in about.items() if text}
        page = cls(title, [Part(terms=about), Part("Methods", terms=arms or {})][: 2 if arms else 1])
        _, page.lead = verdict(results, classical)
        note = levels_note(first)
        for heading, columns in (("Scores", PLAIN), ("Self-ensemble", ENSEMBLE), ("Worst and best frames", QUARTERS)):
            table = figures_of(results, classical, columns)
            texts = [note] if note and columns is PLAIN else []
            if table.rows:
                page.parts.append(
                    Part(heading, texts=texts, head=["", *table.columns], rows=table.rows, best=table.best)
                )
        page.parts.append(_every_image(results, classical))
        return page

    def add_curves(self, pngs: Mapping[str, bytes], heading: str = "Training") -> None:
        self.parts.append(Part(heading, figures=[Figure(png, title, "curve") for title, png in pngs.items()]))

    def add_frame(self, row: Panels) -> None:
        """One frame: its most detailed window in every image, and the whole of the clean one."""
        first = not any(part.heading == "Pictures" for part in self.parts)
        clean = row.trial.clean
        side = WINDOW if clean.shape[1] == PACKED else 2 * WINDOW
        top, left = most_detailed(clean, side)
        whole, pixels = row.shown(clean), 2 * WINDOW // side
        figures = []
        for name, image in row.images.items():
            png = encode_png(row.shown(image[..., top : top + side, left : left + side]))
            figures.append(Figure(png, name, "window", ", ".join(filter(None, [name, row.captions.get(name)]))))
        scale = min(1.0, WHOLE / whole.shape[-1])
        if scale < 1.0:
            whole = F.interpolate(whole[None], scale_factor=scale, mode="area")[0]
        caption = f"whole frame, clean; window at row {pixels * top}, column {pixels * left}"
        figures.append(Figure(encode_png(whole), "whole frame", caption=caption))
        self.parts.append(Part("Pictures" if first else "", row.trial.frame, figures=figures))

    def write(self, path: Path, settings: Mapping[str, Any]) -> Path:
        import yaml
        from jinja2 import Environment, PackageLoader

        templates = Environment(loader=PackageLoader(__package__, ""), autoescape=True, trim_blocks=True)
        templates.filters["b64"] = lambda png: base64.b64encode(png).decode()
        template = templates.get_template("page.html")
        shown = yaml.safe_dump(json.loads(json.dumps(settings)), sort_keys=False, allow_unicode=True)
        text = template.render(title=self.title, lead=self.lead, parts=self.parts, settings=shown)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", errors="backslashreplace")
        return path


def command_line() -> str:
    """The command that runs, as it was typed; empty in another program."""
    return shlex.join(["rawaug", *sys.argv[1:]]) if Path(sys.argv[0]).stem in ("rawaug", "__main__") else ""


def levels_range(summary: Mapping[str, Any]) -> str:
    said = []
    for key in ("shot_var", "read_var"):
        values = [image[key] for image in summary["images"] if key in image]
        said += [f"{key} {min(values):.2g} to {max(values):.2g}"] if values else []
    return ", ".join(said)


def shown_on_page(trials: Sequence[Trial]) -> Iterator[Trial]:
    """At most :data:`ON_PAGE` of the frames, evenly spaced."""
    count = min(ON_PAGE, len(trials))
    return (trials[k * len(trials) // count] for k in range(count))


def most_detailed(image: Tensor, side: int = WINDOW) -> tuple[int, int]:
    """Top and left of the window of ``side`` with the steepest green, of packed RAW or of a picture."""
    green = image[:, 1:-1].mean(1, keepdim=True).clamp_min(0.0).sqrt()
    steep = (green[..., 1:, :-1] - green[..., :-1, :-1]).abs() + (green[..., :-1, 1:] - green[..., :-1, :-1]).abs()
    size = [min(side, length) for length in steep.shape[-2:]]
    scores = F.avg_pool2d(steep, size, stride=4)
    place = int(scores.argmax())
    return 4 * (place // scores.shape[-1]), 4 * (place % scores.shape[-1])


def draw_curves(logs: Mapping[str, Sequence[Path]]) -> dict[str, bytes]:
    """Loss and validation PSNR over the steps as PNG files by title, from the ``log.csv`` of every seed of every arm.

    The loss is the mean since the row before. Thin lines are the thirds of the validation frames with least (dotted),
    middling and most noise (dash-dotted). A curve of one point is a dot. What no log has is left out.
    """
    rows = {(arm, k): read_log(path) for arm, paths in logs.items() for k, path in enumerate(paths)}
    colours = {arm: f"C{k % 10}" for k, arm in enumerate(logs)}
    drawn = {key: title for key, title in CURVES.items() if any(row.get(key) for log in rows.values() for row in log)}
    return {title: _draw_curve(key, title, rows, colours) for key, title in drawn.items()}


Log = Sequence[Mapping[str, str]]


def read_log(path: Path) -> Log:
    """The rows of a training's ``log.csv``."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _draw_curve(key: str, title: str, logs: Mapping[tuple[str, int], Log], colours: Mapping[str, str]) -> bytes:
    with extra("train"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axis = figure.subplots()
    for ((arm, k), rows), (part, line) in product(logs.items(), LINES.items()):
        points = [(int(row["step"]), float(row[key + part])) for row in rows if row.get(key + part)]
        width, label = (0.7, None) if part else (1.4, None if k else arm)
        style: dict[str, Any] = {"color": colours[arm], "linestyle": line, "linewidth": width, "label": label}
        if points:
            axis.plot(*zip(*points, strict=True), marker="o" if len(points) == 1 else "", **style)
    axis.set(xlabel="step", ylabel=title, yscale="log" if key == "loss" else "linear")
    axis.locator_params(axis="x", integer=True)
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8)
    return _png(figure)


def draw_costs(rows: Mapping[str, tuple[float | None, float, float]]) -> bytes:
    """A PNG file of the two PSNR over GMAC a megapixel, by denoiser; one without GMAC, a filter, is a dashed line."""
    with extra("train"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
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


def _every_image(results: Runs, classical: Mapping[str, Mapping[str, Any]]) -> Part:
    """PSNR / SSIM of every image by every method, on the mosaic; an arm's first seed."""
    summaries = first_runs(results, classical)
    rows: dict[str, list[str]] = {}
    for summary in summaries.values():
        for image in summary["images"]:
            cells = rows.setdefault(image["name"], [both(image, "psnr_noisy", "ssim_noisy")])
            cells.append(both(image, "psnr", "ssim"))
    return Part("Every image", head=["image: PSNR (dB) / SSIM", "noisy input", *summaries], rows=rows)
