"""The page of a run: one self-contained HTML file with curves, tables and pictures.

RAW is shown by the same fixed development as in :mod:`rawaug.evaluation.tables`. Each frame is shown
whole and clean, with its most detailed window at twice the size: noisy, from every arm, and clean.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA
from rawaug.data.development import develop_packed, exposure_of
from rawaug.data.pairs import Pair
from rawaug.errors import extra
from rawaug.evaluation.tables import COLUMNS, QUARTERS, Row, Runs, levels_note, table_rows

WINDOW = 64
"""Side in packed pixels of the enlarged windows."""

WHOLE = 640
"""Largest width of a whole frame on the page, in pixels."""

ON_PAGE = 12
"""Largest number of frames on the page."""

PICTURES = "<h2>Pictures</h2>"

CURVES = {"loss": "loss", "psnr": "validation PSNR, RAW (dB)", "psnr_srgb": "validation PSNR, sRGB (dB)"}
"""Columns of a log that are drawn, with what they are."""
LINES = {"": "-", "_low": ":", "_middle": "--", "_high": "-."}

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 90rem; padding: 0 1rem; color: #222; }
h1, h3, figcaption { overflow-wrap: anywhere; }
.table { overflow-x: auto; margin: 1rem 0; } table { border-collapse: collapse; }
th, td { padding: .25rem .8rem; border-bottom: 1px solid #ddd; text-align: right; font-variant-numeric: tabular-nums; }
td + td { white-space: nowrap; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
.frame { display: flex; flex-wrap: wrap; gap: .6rem; align-items: flex-start; margin-bottom: 2rem; }
figure { margin: 0; } figcaption { font-size: 13px; }
.window { width: 256px; } .window img { width: 100%; image-rendering: pixelated; }
.curve { flex: 1 1 20rem; max-width: 36rem; } .curve img { width: 100%; }
.two .curve { flex-basis: max(20rem, 40%); }
img { max-width: 100%; } pre { background: #f4f4f4; padding: 1rem; overflow-x: auto; }
@media (max-width: 40rem) {
  body { margin: 1rem auto; padding: 0 .6rem; font-size: 14px; } h1 { font-size: 1.3rem; }
  th, td { padding: .2rem .4rem; } th { vertical-align: bottom; } .table { font-size: 13px; }
  td:first-child { max-width: 45vw; overflow-wrap: break-word; }
  .window { width: calc(50% - .3rem); }
}
"""


class Page:
    """Collects the parts of the page; frames are encoded as they come and not kept.

    Args:
        title: of the page.
        results: by arm, one entry a seed.
        classical: summaries of the classical denoisers, by name.
    """

    def __init__(self, title: str, results: Runs, classical: Mapping[str, Mapping[str, Any]]) -> None:
        self.title = title
        self.parts = [f"<h1>{html.escape(title)}</h1>", "<h2>Scores</h2>"]
        for columns in (COLUMNS, QUARTERS):
            rows = table_rows(results, classical, columns)
            filled = [k for k in range(len(columns)) if any(cells[k] for cells in rows.values())]
            kept = {name: [cells[k] for k in filled] for name, cells in rows.items()}
            self.parts.append(_table(["", *(list(columns)[k] for k in filled)], kept))
        if note := levels_note(next(iter(results.values()))[0]["plain"]):
            self.parts.append(f"<p>{html.escape(note)}</p>")
        self.parts += ["<h2>Every image</h2>", _images_table(results, classical)]

    def add_curves(self, pngs: Mapping[str, bytes]) -> None:
        """Figures as :func:`draw_curves` makes them."""
        self.parts += ["<h2>Training</h2>", _curves(pngs)]

    def add_frame(self, row: Row, cfa: CFA) -> None:
        """One test frame."""
        if PICTURES not in self.parts:
            self.parts.append(PICTURES)
        clean = list(row.panels.values())[-1]
        exposure = exposure_of(clean, row.pair)
        top, left = most_detailed(clean)
        whole = develop_packed(clean, cfa, row.pair, exposure)
        figures = []
        for name, packed in row.panels.items():
            window = packed[..., top : top + WINDOW, left : left + WINDOW]
            png = encode_png(develop_packed(window, cfa, row.pair, exposure))
            caption = html.escape(name if name == "clean" else f"{name}, {row.captions.get(name, '')}")
            figures.append(f'<figure class="window">{_picture(png, name)}<figcaption>{caption}</figcaption></figure>')
        scale = min(1.0, WHOLE / whole.shape[-1])
        if scale < 1.0:
            whole = F.interpolate(whole[None], scale_factor=scale, mode="area")[0]
        caption = f"<figcaption>whole frame, clean; window at row {2 * top}, column {2 * left}</figcaption>"
        figures.append(f"<figure>{_picture(encode_png(whole), 'whole frame')}{caption}</figure>")
        self.parts.append(f'<h3>{html.escape(row.pair.name)}</h3><div class="frame">{"".join(figures)}</div>')

    def write(self, path: Path, settings: Mapping[str, Any]) -> Path:
        """The file, with ``settings`` at its end."""
        return _write(path, self.title, self.parts, settings)


def write_figure_page(
    path: Path,
    title: str,
    pngs: Mapping[str, bytes],
    head: Sequence[str],
    rows: Mapping[str, Sequence[str]],
    settings: Mapping[str, Any],
) -> Path:
    """A page of figures, by title, and one table."""
    parts = [f"<h1>{html.escape(title)}</h1>", _curves(pngs), _table(head, rows)]
    return _write(path, title, parts, settings)


def _write(path: Path, title: str, parts: Sequence[str], settings: Mapping[str, Any]) -> Path:
    shown = html.escape(json.dumps(settings, indent=1))
    body = "\n".join([*parts, f"<h2>Settings</h2><pre>{shown}</pre>"])
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{html.escape(title)}</title>"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    text = f'<!doctype html>\n<html lang="en"><head>{head}<style>{_STYLE}</style></head>\n<body>\n{body}\n'
    path.write_text(f"{text}</body></html>\n", encoding="utf-8", errors="backslashreplace")
    return path


def shown_on_page(pairs: Sequence[Pair]) -> Iterator[Pair]:
    """At most :data:`ON_PAGE` of the frames, evenly spaced."""
    count = min(ON_PAGE, len(pairs))
    return (pairs[k * len(pairs) // count] for k in range(count))


def most_detailed(packed: Tensor) -> tuple[int, int]:
    """Top and left, in packed pixels, of the window of a clean frame ``(1, 4, h, w)`` with the steepest green."""
    green = packed[:, 1:3].mean(1, keepdim=True).clamp_min(0.0).sqrt()
    steep = (green[..., 1:, :-1] - green[..., :-1, :-1]).abs() + (green[..., :-1, 1:] - green[..., :-1, :-1]).abs()
    size = [min(WINDOW, side) for side in steep.shape[-2:]]
    scores = F.avg_pool2d(steep, size, stride=4)
    place = int(scores.argmax())
    return 4 * (place // scores.shape[-1]), 4 * (place % scores.shape[-1])


def encode_png(srgb: Tensor) -> bytes:
    """sRGB ``(3, H, W)`` in [0, 1] as a PNG file."""
    with extra("train"):
        from PIL import Image

    file = io.BytesIO()
    Image.fromarray((srgb * 255.0).round().to(torch.uint8).permute(1, 2, 0).numpy()).save(file, "PNG")
    return file.getvalue()


def draw_curves(logs: Mapping[str, Sequence[Path]]) -> dict[str, bytes]:
    """Loss and validation PSNR over the steps as PNG files by title, from the ``log.csv`` of every seed of every arm.

    The loss is the mean since the row before. Thin lines are the thirds of the validation frames with least (dotted),
    middling and most noise (dash-dotted). A curve of one point is a dot. What no log has is left out.
    """
    rows = {(arm, k): _read_log(path) for arm, paths in logs.items() for k, path in enumerate(paths)}
    colours = {arm: f"C{k % 10}" for k, arm in enumerate(logs)}
    return {title: _draw_curve(key, title, rows, colours) for key, title in CURVES.items() if _has(key, rows.values())}


Log = Sequence[Mapping[str, str]]


def _read_log(path: Path) -> Log:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _has(key: str, logs: Iterable[Log]) -> bool:
    return any(row.get(key) for rows in logs for row in rows)


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
    file = io.BytesIO()
    figure.savefig(file, dpi=130)
    return file.getvalue()


def _curves(pngs: Mapping[str, bytes]) -> str:
    """Figures side by side, or one below the other on a phone."""
    figures = (f'<figure class="curve">{_picture(png, title)}</figure>' for title, png in pngs.items())
    return f'<div class="frame{" two" if len(pngs) == 4 else ""}">{"".join(figures)}</div>'


def _picture(png: bytes, alt: str) -> str:
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


def _table(head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> str:
    def line(tag: str, cells: Sequence[str]) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(line("td", [name, *cells]) for name, cells in rows.items())
    return f'<div class="table"><table><thead>{line("th", head)}</thead><tbody>{body}</tbody></table></div>'


def _images_table(results: Runs, classical: Mapping[str, Mapping[str, Any]]) -> str:
    """PSNR / SSIM of every image by every method, on the mosaic; an arm's first seed."""
    summaries = {**classical, **{arm: runs[0]["plain"] for arm, runs in results.items()}}
    rows: dict[str, list[str]] = {}
    for summary in summaries.values():
        for image in summary["images"]:
            cells = rows.setdefault(image["name"], [_both(image, "_noisy")])
            cells.append(_both(image, ""))
    return _table(["image: PSNR (dB) / SSIM", "noisy input", *summaries], rows)


def _both(image: Mapping[str, Any], suffix: str) -> str:
    """PSNR / SSIM, a dash for what is no number."""
    figures = ((image.get(f"psnr{suffix}"), 2), (image.get(f"ssim{suffix}"), 4))
    return " / ".join("-" if value is None else f"{value:.{digits}f}" for value, digits in figures)
