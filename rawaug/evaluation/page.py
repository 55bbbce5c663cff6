"""The page of a run: one self-contained HTML file with curves, tables and pictures.

RAW is shown by the same fixed development as in :mod:`rawaug.evaluation.scores`. Each frame is shown
whole and clean, with its most detailed window at twice the size: noisy, from every arm, and clean.
"""

from __future__ import annotations

import base64
import json
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch.nn.functional as F

from rawaug import bayer
from rawaug.evaluation.figures import WINDOW, Panels, detail_window
from rawaug.evaluation.table_files import write_tables
from rawaug.evaluation.tables import (
    ENSEMBLE,
    PLAIN,
    QUARTERS,
    Runs,
    first_runs,
    join_figures,
    levels_note,
    make_table,
)
from rawaug.evaluation.trials import Trial, evenly_spaced
from rawaug.files import write_text
from rawaug.io.pictures import encode_png

_WHOLE = 640
"""Largest width of a whole frame on the page, in pixels."""

ON_PAGE = 12
"""Largest number of frames on the page."""


class Figure(NamedTuple):
    """A picture on the page.

    Attributes:
        png: the file.
        alt: text to show if the picture cannot be shown.
        style: a class of the template: window, curve, or none for a whole frame.
        caption: text below the picture.
    """

    png: bytes
    alt: str
    style: str = ""
    caption: str = ""


class Page:
    """A page, to which parts are added from top to bottom; frames are encoded as they come and not kept.

    Args:
        title: title of the page.
        lead: the sentence below the title.
    """

    def __init__(self, title: str, lead: str = "") -> None:
        self.title = title
        self.lead = lead
        self.parts: list[dict[str, Any]] = []

    def add(self, heading: str = "", **content: Any) -> None:
        """Add a part.

        Args:
            heading: heading of a chapter; without one the part belongs to the previous chapter.
            content: the content below it, as far as there is any: ``name``, a smaller heading; ``texts``, paragraphs;
                ``terms``, explanations by term; ``head`` and ``rows`` of a table, the names of columns and the cells by
                name, with the set ``best`` of (row, column) in bold; ``figures``, :class:`Figure` side by side.
        """
        self.parts.append({"heading": heading, "best": (), **content})

    def add_facts(self, facts: Mapping[str, Any], results: Runs) -> None:
        """Add the command and other facts by term, unless they are empty; ``Noise`` is in the form of a recipe."""
        terms = {"Command": command_line(), **facts}
        noise = terms.pop("Noise", None)
        if noise:
            if not isinstance(noise, str):
                noise = json.dumps(noise)
            first_arm = next(iter(results.values()))
            levels = _levels_range(first_arm[0]["plain"])
            terms["Noise"] = f"as captured with the frames, else {noise}; {levels}".rstrip("; ")

        self.add(terms={term: text for term, text in terms.items() if text})

    def add_scores(self, results: Runs, others: Mapping[str, Mapping[str, Any]], of: str = "") -> None:
        """Add the tables of scores: plain, self-ensemble, quarters, and every image.

        Args:
            results: by arm, one entry per seed.
            others: summaries of other denoisers, by name.
            of: the subject of these scores, for the headings, such as a pattern.
        """
        end = ""
        if of:
            end = f", {of}"

        first_arm = next(iter(results.values()))
        notes = list(filter(None, [levels_note(first_arm[0]["plain"])]))
        for heading, columns in (("Scores", PLAIN), ("Self-ensemble", ENSEMBLE), ("Worst and best frames", QUARTERS)):
            heads, rows, best = make_table(results, others, columns)
            if not rows:
                continue
            self.add(heading + end, texts=notes, head=["", *heads], rows=rows, best=best)
            notes = []  # stated once, with the first table

        self.add(f"Every image{end}", **_every_image(first_runs(results, others)))

    def add_curves(self, pngs: Mapping[str, bytes], *notes: str) -> None:
        """Add pictures of the curves of a training, by title, below notes on them."""
        figures = [Figure(png, title, "curve") for title, png in pngs.items()]
        self.add("Training", texts=notes, figures=figures)

    def add_frame(self, row: Panels, crop: int | None = None) -> None:
        """Add a frame: its most detailed window in every image, and the whole of the clean one.

        Args:
            row: the images of the frame.
            crop: the side in pixels to which larger frames were cut around the middle; None if none was.
        """
        clean = row.trial.clean
        pixels = bayer.sites_per_value(clean)
        window = detail_window(clean, 2 * WINDOW // pixels)
        _, lines, columns = window

        figures = []
        for name, image in row.images.items():
            png = encode_png(row.show(image[window]))
            caption = ", ".join(filter(None, [name, row.captions.get(name)]))
            figures.append(Figure(png, name, "window", caption))

        picture = row.show(clean)
        height, width = picture.shape[-2:]
        part = name_part(height, width, crop)
        if width > _WHOLE:
            picture = F.interpolate(picture[None], scale_factor=_WHOLE / width, mode="area")[0]

        caption = f"{part}, clean; window at row {pixels * lines.start}, column {pixels * columns.start}"
        figures.append(Figure(encode_png(picture), part, caption=caption))

        heading = "Pictures"
        if any(part["heading"] == heading for part in self.parts):
            heading = ""
        name = ", ".join(filter(None, [row.trial.frame, row.trial.condition]))
        self.add(heading, name=name, figures=figures)

    def write(self, path: Path, settings: Mapping[str, Any]) -> Path:
        """Write the page, ending with the run's settings, and its tables beside it; return the path of the page."""
        import yaml
        from jinja2 import Environment, PackageLoader

        templates = Environment(loader=PackageLoader(__package__, ""), autoescape=True, trim_blocks=True)
        templates.filters["b64"] = lambda png: base64.b64encode(png).decode()
        template = templates.get_template("page.html")

        as_yaml = yaml.safe_dump(json.loads(json.dumps(settings)), sort_keys=False, allow_unicode=True)
        text = template.render(title=self.title, lead=self.lead, parts=self.parts, settings=as_yaml)

        write_text(text, path)
        write_tables(path, self.parts)
        return path


def name_part(height: int, width: int, crop: int | None) -> str:
    """Say how much of a frame is shown, with its size in pixels.

    Example:
        >>> name_part(512, 512, crop=512)
        'middle, 512 x 512'
        >>> name_part(288, 448, crop=512)
        'whole frame, 448 x 288'
    """
    part = "whole frame"
    if crop is not None and max(height, width) >= crop:
        part = "middle"

    return f"{part}, {width} x {height}"


def command_line() -> str:
    """The running command as it was typed; empty in another program."""
    if Path(sys.argv[0]).stem not in ("rawaug", "__main__"):
        return ""

    return shlex.join(["rawaug", *sys.argv[1:]])


def _levels_range(summary: Mapping[str, Any]) -> str:
    """Describe the lowest and highest noise levels of a summary's images; empty if none is known."""
    ranges = []
    for key in ("shot_var", "read_var"):
        values = []
        for image in summary["images"]:
            if key in image:
                values.append(image[key])
        if values:
            bounds = dict.fromkeys([f"{min(values):.2g}", f"{max(values):.2g}"])
            ranges.append(f"{key} {' to '.join(bounds)}")

    return ", ".join(ranges)


def select_for_page(trials: Sequence[Trial]) -> Iterator[Trial]:
    """Choose at most :data:`ON_PAGE` of the trials, evenly spaced."""
    for k in evenly_spaced(len(trials), ON_PAGE):
        yield trials[k]


def _every_image(summaries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Make the table of PSNR / SSIM of every image by every method, on the mosaic."""
    rows: dict[str, list[str]] = {}
    for summary in summaries.values():
        for image in summary["images"]:
            cells = rows.setdefault(image["name"], [join_figures(image, "psnr_noisy", "ssim_noisy")])
            cells.append(join_figures(image, "psnr", "ssim"))

    return {"head": ["image: PSNR (dB) / SSIM", "noisy input", *summaries], "rows": rows}
