"""Pictures of results: one trial through every denoiser, its most detailed window, and the curves of a training.

RAW is shown by the fixed development of :mod:`rawaug.evaluation.scores`. Files are drawn by matplotlib.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.data.pairs import centre
from rawaug.errors import escape, extra
from rawaug.evaluation.scores import NOISY, ScoredDenoiser, to_domain
from rawaug.evaluation.trials import Trial
from rawaug.files import write_bytes
from rawaug.metrics import psnr

FIGURE_FORMATS = (".png", ".jpg", ".pdf", ".svg")
"""Extensions of the files of figures."""

WINDOW = 64
"""Side of an enlarged window, in packed pixels."""

PANEL = 256
"""Largest side of a panel, in mosaic pixels; larger frames are shown as a crop of the centre."""

_CROP = 192
"""Side of a crop at 100 %, in pixels."""

_ACROSS = 4
"""Maximum number of panels side by side; more would make the captions too small."""

CURVES = {"loss": "loss", "psnr": "validation PSNR (dB)", "psnr_srgb": "validation PSNR, sRGB (dB)"}
"""Columns of a log that are plotted, with the titles of their plots."""

LINE_STYLES = ("-", "--", "-.", ":")
"""Line styles of the arms of a training, so that a curve below another one can still be seen."""

Log = Sequence[Mapping[str, str]]
"""The rows of a training's ``log.csv``."""


@dataclass
class Panels:
    """The pictures of one trial.

    Attributes:
        trial: the trial.
        images: ``(1, 4, h, w)`` or ``(1, 3, H, W)``, like the trial's noisy or clean one, by title; the clean one last.
        captions: captions by title.
    """

    trial: Trial
    images: dict[str, Tensor] = field(default_factory=dict)
    captions: dict[str, str] = field(default_factory=dict)

    def show(self, image: Tensor) -> Tensor:
        """Develop an image, or a part of one, ``(1, C, H, W)``, to sRGB ``(3, H, W)`` in [0, 1]."""
        if self.trial.develop is None:
            return image[0].clamp(0.0, 1.0)

        return self.trial.develop(image)


def make_panels(denoisers: Sequence[ScoredDenoiser], trial: Trial, noisy: ScoredDenoiser = NOISY) -> Panels:
    """Make the pictures of a trial: noisy, denoised by each denoiser, and clean.

    Captions state the PSNR. That of the clean image states its own noise, as the PSNR of a perfect denoiser. ``noisy``
    gives the picture of the noisy input.
    """
    panels = Panels(trial)
    clean = trial.compared(trial.clean)

    titles: dict[str, ScoredDenoiser] = {"noisy": noisy}
    for denoiser in denoisers:
        titles[denoiser.name] = denoiser

    for title, denoiser in titles.items():
        denoised = denoiser(trial.input_for(denoiser))
        for name, image in to_domain(title, denoised, trial):
            panels.images[name] = image
            panels.captions[name] = f"{psnr(trial.compared(image), clean).item():.2f} dB"

    panels.images["clean"] = trial.clean
    panels.captions["clean"] = trial.frame
    if trial.own:
        panels.captions["clean"] += f", own noise {-10.0 * math.log10(trial.own):.2f} dB"
    return panels


def find_detail(image: Tensor, side: int = WINDOW) -> tuple[int, int]:
    """Find top and left of the window of ``side`` with the steepest green, in ``(1, 4, h, w)`` or ``(1, 3, H, W)``."""
    green = image[:, 1:-1].mean(1, keepdim=True).clamp_min(0.0).sqrt()
    down = (green[..., 1:, :-1] - green[..., :-1, :-1]).abs()
    right = (green[..., :-1, 1:] - green[..., :-1, :-1]).abs()
    steep = down + right

    height, width = steep.shape[-2:]
    means = F.avg_pool2d(steep, (min(side, height), min(side, width)), stride=4)
    row, column = divmod(int(means.argmax()), means.shape[-1])
    return 4 * row, 4 * column


def detail_window(image: Tensor, side: int = WINDOW) -> tuple[Any, slice, slice]:
    """Make the index of the window of :func:`find_detail` in an image."""
    y, x = find_detail(image, side)
    return ..., slice(y, y + side), slice(x, x + side)


def crops_at_100(rows: Sequence[Panels]) -> Tensor:
    """Make a row of crops of each trial, all where its clean image has most detail; sRGB ``(3, h, w)``."""
    strips = []
    for row in rows:
        window = detail_window(row.trial.clean, _CROP)
        crops = [row.show(image[window]) for image in row.images.values()]
        strips.append(torch.cat(crops, dim=-1))

    return torch.cat(strips, dim=-2)


def new_figure(width: float, height: float) -> Any:
    """Make an empty matplotlib figure, with its sides in inches; no display is needed."""
    with extra("train"):
        from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def save_picture(rows: Sequence[Panels], path: Path) -> Path:
    """Write the panels of each row as a picture, at most :data:`_ACROSS` side by side; return the path."""
    counts = [len(row.images) for row in rows]
    columns = min(_ACROSS, max(counts))
    heights = [math.ceil(count / columns) for count in counts]

    figure = new_figure(2.1 * columns, 2.5 * sum(heights))
    axes = figure.subplots(sum(heights), columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()

    first = 0
    for row, height in zip(rows, heights, strict=True):
        for axis, (title, image) in zip(axes[first:].flat, row.images.items(), strict=False):
            side = PANEL // bayer.sites_per_value(image)
            panel = row.show(centre(image, side, side, step=1))
            axis.imshow(panel.permute(1, 2, 0).numpy(), interpolation="nearest")
            caption = f"{escape(title)}\n{escape(row.captions.get(title, ''))}"
            axis.set_title(caption, fontsize=9, parse_math=False)
        first += height

    save_figure(figure, path)
    return path


# -- curves ------------------------------------------------------------------------------------------------------------


def read_log(path: Path) -> Log:
    """Read the rows of a training's ``log.csv``."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def plot_curves(logs: Mapping[str, Sequence[Path]]) -> dict[str, bytes]:
    """Plot loss and validation PSNR over the steps, from the ``log.csv`` of every seed and arm, as PNG files by title.

    The loss is the mean since the previous row. A curve of one point is a dot. Values that no log has are left out.
    """
    rows: dict[tuple[str, int], Log] = {}
    styles = {}
    for k, (arm, paths) in enumerate(logs.items()):
        styles[arm] = {"color": f"C{k % 10}", "linestyle": LINE_STYLES[k % len(LINE_STYLES)]}
        for seed, path in enumerate(paths):
            rows[arm, seed] = read_log(path)

    pictures = {}
    for key, title in CURVES.items():
        png = _plot_curve(key, title, rows, styles)
        if png:
            pictures[title] = png

    return pictures


def _plot_curve(
    key: str, title: str, logs: Mapping[tuple[str, int], Log], styles: Mapping[str, Mapping[str, Any]]
) -> bytes:
    """Plot a curve for each log, with the arms in the legend; empty if no log has the key."""
    figure = new_figure(5.2, 3.6)
    axis = figure.subplots()

    arms = set()
    lowest = math.inf
    for (arm, _), rows in logs.items():
        steps = []
        values = []
        for row in rows:
            if row.get(key):
                steps.append(int(row["step"]))
                values.append(float(row[key]))
        if not steps:
            continue
        lowest = min(lowest, *values)

        style: dict[str, Any] = {**styles[arm], "linewidth": 1.4}
        if len(steps) == 1:
            style["marker"] = "o"
        if arm not in arms:
            style["label"] = arm
        axis.plot(steps, values, **style)
        arms.add(arm)

    if not arms:
        return b""

    axis.set(xlabel="step", ylabel=title)
    if key == "loss" and lowest > 0.0:  # log_mse can be below 0
        axis.set_yscale("log")
    axis.locator_params(axis="x", integer=True)
    axis.legend(fontsize=8)
    return _encode(figure, "png")


def plot_costs(rows: Mapping[str, tuple[float | None, float, float]]) -> bytes:
    """Plot the PSNR of RAW and sRGB over GMAC per megapixel as PNG; a filter without GMAC is a dashed line.

    ``rows`` has GMAC and the two PSNR by the name of a denoiser.
    """
    from matplotlib.ticker import LogLocator, NullFormatter

    figure = new_figure(8.4, 3.6)
    axes = figure.subplots(1, 2)

    for k, title in enumerate(("RAW", "developed sRGB")):
        for number, (name, (gmac, *psnr_values)) in enumerate(rows.items()):
            style: dict[str, Any] = {"color": f"C{number % 10}", "label": name}
            if gmac is None:
                axes[k].axhline(psnr_values[k], linestyle="--", **style)
            else:
                axes[k].plot(gmac, psnr_values[k], "o", **style)
        axes[k].set(xlabel="GMAC a megapixel", xscale="log", title=f"PSNR, {title} (dB)")
        axes[k].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes[k].xaxis.set_major_formatter("{x:g}")
        axes[k].xaxis.set_minor_formatter(NullFormatter())

    figure.legend(*axes[-1].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    return _encode(figure, "png")


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format of the path's extension, completely or not at all."""
    write_bytes(_encode(figure, path.suffix.removeprefix(".")), path)


def _encode(figure: Any, extension: str) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=130, format=extension)
    return file.getvalue()
