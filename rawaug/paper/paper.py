"""``rawaug run paper``: the paper's tables, its ablation and its cycle in one run, with its figures next to ours.

Each part is a separate recipe, which runs in a subfolder of the whole run's folder and resumes by itself. In the end,
one page, ``report.html``, and one file, ``paper.json``, have all of them.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from rawaug.evaluation.page import Figure, Page, command_line
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.experiment.folder import claim, require_free
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.experiment.run import run
from rawaug.experiment.settings import Recipe
from rawaug.experiment.task import find_classical
from rawaug.files import write_json
from rawaug.paper import published
from rawaug.paper.ablation import SPACES, Ablation, ablate
from rawaug.paper.ablation import TITLES as STAGES
from rawaug.paper.order import compare_order, order_sentence
from rawaug.paper.reconstruction import Comparison, compare

PARTS = ("table1", "table2_nikon", "table2_canon", "table3", "few", "unsupervised", "ablation")
TITLES = {
    "table1": "Table 1: RAW reconstruction",
    "table2": "Table 2: RAW reconstruction, two DSLRs",
    "table3": "Table 3: RAW denoising",
    "ablation": "Ablation: PSNR against RAW after each stage",
}
SHORTEST_CROP = 64
"""Side in pixels of the part of a test frame that a dry run scores."""
Table = dict[str, dict[str, Any]]
"""A figure, or None, by row and column."""


@dataclass
class Paper:
    """The settings of the paper's tables; a part that is null is left out.

    Args:
        name: of the output folder within ``out``.
        data: the pairs of all parts but table 2, in place of those that the parts name; null leaves them.
        test: the test pairs of these parts; null leaves those that they name.
        pictures: their sRGB pictures; null leaves those that they name.
        parts: the parts to run now, in this order; the page has every part that was run before.
        table1: RAW reconstruction, PSNR_d and the cycle.
        table2_nikon: RAW reconstruction of one DSLR.
        table2_canon: RAW reconstruction of the other one.
        table3: denoising with all pairs; its arms are named tnrd, dncnn, dhdn, cycleisp and ours.
        few: the arm ours_f, with few pairs.
        unsupervised: the arm ours_u, from noisy frames alone.
        ablation: the ablation, after each stage.
        out: folder of all runs.
    """

    name: str = "paper"
    data: str | None = None
    test: str | None = None
    pictures: str | None = None
    parts: list[str] = field(default_factory=lambda: list(PARTS))
    table1: Comparison | None = None
    table2_nikon: Comparison | None = None
    table2_canon: Comparison | None = None
    table3: Recipe | None = None
    few: Recipe | None = None
    unsupervised: Recipe | None = None
    ablation: Ablation | None = None
    out: str = "runs"

    def __post_init__(self) -> None:
        for part in self.parts:
            if part not in PARTS:
                raise ValueError(f"parts: {part} is none; choose from {', '.join(PARTS)}")

    def shortest(self) -> Paper:
        """Shorten all parts, with small test frames, since some filters take minutes for a whole one."""
        parts: dict[str, Any] = {}
        for name in PARTS:
            settings = getattr(self, name)
            if settings is None:
                continue
            short = settings.shortest()
            if isinstance(short, Recipe):
                short = replace(short, data=replace(short.data, test_crop=SHORTEST_CROP))
            parts[name] = short
        return replace(self, **parts)

    def part(self, name: str) -> Any:
        """Give the settings of a part the data and a subfolder of the whole; return None without the part."""
        settings = getattr(self, name)
        if settings is None:
            return None

        settings = replace(settings, name=f"{self.name}/{name}", out=self.out)
        if isinstance(settings, Recipe):
            return replace(settings, data=replace(settings.data, **self._own(pairs=self.data)))
        if isinstance(settings, Ablation):
            return replace(settings, data=self.data or settings.data)
        if name != "table1":
            return settings

        settings = replace(settings, **self._own(data=self.data))
        if settings.downstream is not None and self.test is not None:
            settings = replace(settings, downstream=replace(settings.downstream, test=[self.test]))
        return settings

    def _own(self, **data: str | None) -> dict[str, Any]:
        settings = {**data, "test": self.test, "pictures": self.pictures}
        return {key: value for key, value in settings.items() if value is not None}


@EXPERIMENTS.register("paper")
def run_paper(paper: Paper, overwrite: bool = False) -> dict[str, Any]:
    """Run the parts and write the page; ``overwrite`` replaces another run of its name.

    Returns:
        The rows of each table (``table1``, ``table2``, ``table3``, ``ablation``), as ``paper.json`` has them.
    """
    require_free(paper, overwrite)
    for name in paper.parts:
        settings = paper.part(name)
        if isinstance(settings, Recipe):
            find_classical(settings.classical)  # a missing library is named before hours are spent

    folder = claim(paper, overwrite)
    for name in paper.parts:
        settings = paper.part(name)
        if isinstance(settings, Comparison):
            compare(settings, overwrite)
        elif isinstance(settings, Ablation):
            ablate(settings, overwrite)
        elif settings is not None:
            run(settings, overwrite)

    tables = read_tables(folder)
    write_json({"settings": asdict(paper), "tables": tables}, folder / "paper.json")
    page = write_page(folder, tables, asdict(paper))
    for name, table in tables.items():
        print_paper_table(TITLES[name], table)
    print(f"page: {page}")
    return tables


# -- the figures of the parts ------------------------------------------------------------------------------------------


def read_tables(folder: Path) -> dict[str, Table]:
    """Read the tables of the parts that were run in a folder, with our and the paper's figures side by side."""
    tables = {}

    first = read_part(folder, "table1", "table")
    if first is not None:
        tables["table1"] = reconstruction_table(first["rows"])

    nikon = read_part(folder, "table2_nikon", "table")
    canon = read_part(folder, "table2_canon", "table")
    if nikon is not None or canon is not None:
        tables["table2"] = dslr_table((nikon or {}).get("rows", {}), (canon or {}).get("rows", {}))

    runs = []
    curves: dict[str, tuple[int, list[float]]] = {}
    for part in ("table3", "few", "unsupervised"):
        results = read_part(folder, part, "results")
        if results is not None:
            runs.append(results)
            curves |= read_curves(folder / part, results["results"])
    if runs:
        tables["table3"] = denoising_table(runs, curves)

    stages = read_part(folder, "ablation", "ablation")
    if stages is not None:
        tables["ablation"] = ablation_table(stages["stages"])
    return tables


def read_part(folder: Path, part: str, stem: str) -> Any:
    """Read the figures that a part left in its folder; return None if it was not run to its end."""
    path = folder / part / f"{stem}.json"
    if not path.is_file():
        return None
    return json.loads(path.read_text())


def read_curves(folder: Path, arms: Iterable[str]) -> dict[str, tuple[int, list[float]]]:
    """Read the last step and the mean losses of a recipe's arms with their first seed; none of arms without a log."""
    curves = {}
    for arm in arms:
        logs = sorted(folder.glob(f"seed*/{arm}/log.csv"))
        if not logs:
            continue

        with logs[0].open(newline="") as file:
            rows = list(csv.DictReader(file))
        if rows:
            losses = [float(row["loss"]) for row in rows]
            curves[arm] = int(rows[-1]["step"]), losses

    return curves


def reconstruction_table(rows: Mapping[str, Mapping[str, Any]]) -> Table:
    """Make table 1 from the rows of a comparison."""
    none = (None, None, None, None, None)
    cycles = {"dictionary-encoders": published.CYCLE}
    table: Table = {}

    for name, row in rows.items():
        figures = {
            "PSNR_r": row.get("psnr_r"),
            "worst 25%": row.get("worst25"),
            "best 25%": row.get("best25"),
            "PSNR_d": row.get("psnr_d"),
            "M parameters": row["parameters"] / 1e6,
        }
        paper = published.TABLE_1.get(published.ISP_NAMES.get(name, ""), none)
        cells: dict[str, Any] = {}
        for (column, ours), theirs in zip(figures.items(), paper, strict=True):
            cells[column] = ours
            cells[f"{column}, paper"] = theirs

        cells["cycle"] = row.get("cycle")
        cells["cycle, paper"] = cycles.get(name)
        cells["steps"] = row.get("steps")
        cells["loss still falling"] = still_falling(row.get("curve"))
        table[row_name(name)] = cells
    return table


def dslr_table(nikon: Mapping[str, Mapping[str, Any]], canon: Mapping[str, Mapping[str, Any]]) -> Table:
    """Make table 2 from the rows of two comparisons, one of which may be empty."""
    table: Table = {}
    for name in {**nikon, **canon}:
        paper = published.TABLE_2.get(published.ISP_NAMES.get(name, ""), (None, None))
        cells: dict[str, Any] = {}
        for camera, rows, figure in (("Nikon", nikon, paper[0]), ("Canon", canon, paper[1])):
            if not rows:
                continue
            row = rows.get(name, {})
            cells[f"{camera} PSNR_r"] = row.get("psnr_r")
            cells[f"{camera} PSNR_r, paper"] = figure
            cells[f"{camera} balanced"] = row.get("balanced")
        table[row_name(name)] = cells
    return table


def denoising_table(runs: Sequence[Mapping[str, Any]], curves: Mapping[str, tuple[int, list[float]]]) -> Table:
    """Make table 3 from the results of the recipes that train, with the self-ensemble if there is one.

    Args:
        runs: the results of the recipes.
        curves: by arm, how its training went.
    """
    table: Table = {}
    for results in runs:
        for arm, seeds in results["results"].items():
            psnr, ssim = [], []
            for scores in seeds:
                summary = scores.get("self_ensemble", scores["plain"])
                psnr.append(summary.get("psnr"))
                ssim.append(summary.get("ssim"))
            add_denoiser(table, arm, psnr, ssim, curves.get(arm))

            noisy = seeds[0]["plain"]
            if "Noisy" not in table:
                add_denoiser(table, "noisy", [noisy.get("psnr_noisy")], [noisy.get("ssim_noisy")])

        for name, scores in results["others"].items():
            add_denoiser(table, name, [scores.get("psnr")], [scores.get("ssim")])

    ordered: Table = {}
    for name in (*published.TABLE_3, *table):
        if name in table:
            ordered[name] = table[name]
    return ordered


def add_denoiser(
    table: Table, name: str, psnr: Sequence[float], ssim: Sequence[float], curve: tuple[int, list[float]] | None = None
) -> None:
    """Add a row of table 3 under the paper's name, if it has one; the first figures of a name stay."""
    names = {**published.DENOISER_NAMES, "noisy": "Noisy"}
    label = names.get(name, name)
    paper = published.TABLE_3.get(label, (None, None))
    figures: dict[str, Any] = {
        "PSNR": list(psnr),
        "PSNR, paper": paper[0],
        "SSIM": list(ssim),
        "SSIM, paper": paper[1],
    }
    if curve is not None:
        figures["steps"], losses = curve
        figures["loss still falling"] = still_falling(losses)
    table.setdefault(label, figures)


def ablation_table(stages: Mapping[str, Sequence[Sequence[float]]]) -> Table:
    """Make the ablation's table, by what is known of a frame and space, blind and with as-shot gains."""
    table: Table = {}
    for setting, rows in stages.items():
        for space, curve in zip(SPACES, zip(*rows, strict=True), strict=True):
            table[f"{space}, {setting}"] = dict(zip(STAGES, curve, strict=True))

    for space, figures in published.ABLATION.items():
        table[f"{space}, paper"] = {**dict.fromkeys(STAGES), **figures}
    return table


def row_name(name: str) -> str:
    """Append the paper's name to a row's own name."""
    if name not in published.ISP_NAMES:
        return name
    return f"{name} ({published.ISP_NAMES[name]})"


def still_falling(curve: Sequence[float] | None) -> float | None:
    """Compute by how many percent the loss of a training's last part is below that of the part before."""
    if curve is None or len(curve) < 2:
        return None
    return 100.0 * (curve[-2] - curve[-1]) / curve[-2]


# -- the page ----------------------------------------------------------------------------------------------------------


def cell(column: str, value: Any) -> str:
    """Write a figure as text."""
    if value is None or value == [None]:
        return ""
    if column == "steps":
        return str(value)
    if column == "loss still falling":
        return f"{value:.1f} %"

    figures = value
    if not isinstance(figures, list):
        figures = [figures]
    return mean_and_spread(figures, 3 if "SSIM" in column else 2)


def table_columns(table: Table) -> list[str]:
    """List the columns that have a figure in any row."""
    columns: list[str] = []
    for cells in table.values():
        for column, value in cells.items():
            if value not in (None, [None]) and column not in columns:
                columns.append(column)
    return columns


def text_rows(table: Table) -> dict[str, list[str]]:
    """Write the cells of a table as text, by row."""
    columns = table_columns(table)
    rows = {}
    for name, cells in table.items():
        rows[name] = [cell(column, cells.get(column)) for column in columns]
    return rows


def print_paper_table(title: str, table: Table) -> None:
    """Print a table with the paper's figures."""
    rows = []
    for name, cells in text_rows(table).items():
        rows.append([name, *cells])
    print_rows(title, ["", *table_columns(table)], rows)


NOTES = {
    "table1": "Figures without a paper's row stand beside its own. A loss that is still falling by more than a few "
    "percent says that the training was too short.",
    "table2": "Rows 'own rendering' are InvISP's protocol: RAW from the picture that the network itself rendered, "
    "stored as a JPEG. 'Balanced' is InvISP's figure, of demosaiced, white-balanced, gamma-compressed RAW.",
    "table3": "Networks are averaged over the views of the self-ensemble, as in the paper. A loss that is still "
    "falling by more than a few percent says that the training was too short.",
    "ablation": "Images between the stages of the way from sRGB to RAW, each frame by a fit to the others.",
}
ORDERED_BY = {"table1": ["PSNR_r", "PSNR_d"], "table2": ["Nikon PSNR_r", "Canon PSNR_r"], "table3": ["PSNR"]}


PARTS_OF = {
    "table1": ("table1",),
    "table2": ("table2_nikon", "table2_canon"),
    "table3": ("table3", "few", "unsupervised"),
    "ablation": ("ablation",),
}
"""The parts that a table is made of."""


def add_pictures(page: Page, folder: Path, part: str) -> None:
    """Add the pictures that a part left in its folder: RAW of each method and samples, or those of its run."""
    shown = folder / part / "shown"
    rows = (read_part(folder, part, "table") or {}).get("rows", {})
    captions = {"RGB": "RGB", "RAW": "RAW"}
    for name, row in rows.items():
        captions[name] = row_name(name)
        if "frames" in row:
            first_frame, *_ = row["frames"].values()
            captions[name] += f", {first_frame[0]:.2f} dB"

    side_by_side = read_figures(shown, "{}.png", captions, "window")
    if side_by_side:
        page.add(texts=[f"{part}: the most detailed part of its first test frame."], figures=side_by_side)
    samples = read_figures(shown, "{}-samples.png", captions)
    if samples:
        page.add(texts=["RAWs that are drawn of this one picture."], figures=samples)

    of_run = read_figures(folder / part, "{}.png", {"picture": f"{part}: crops", "ablation": "the same as curves"})
    if of_run:
        page.add(figures=of_run)


def read_figures(folder: Path, form: str, captions: Mapping[str, str], style: str = "") -> list[Figure]:
    """Read the pictures whose names, put into ``form``, are files of the folder."""
    figures = []
    for name, caption in captions.items():
        file = folder / form.format(name.replace("/", "_"))
        if file.is_file():
            figures.append(Figure(file.read_bytes(), caption, style, caption))
    return figures


def write_page(folder: Path, tables: Mapping[str, Table], settings: Mapping[str, Any]) -> Path:
    """Write ``report.html`` and return its path."""
    page = Page("The paper's tables", "The figures of Conde et al., AAAI 2022, beside those of this run.")
    if command_line():
        page.add(terms={"Command": command_line()})

    for name, table in tables.items():
        texts = [NOTES[name]]
        for column in ORDERED_BY.get(name, []):
            sentence = order_sentence(*compare_order(table, column))
            if sentence:
                texts.append(f"{column}: {sentence}")

        page.add(TITLES[name], texts=texts, head=["", *table_columns(table)], rows=text_rows(table))
        for part in PARTS_OF[name]:
            add_pictures(page, folder, part)
    return page.write(folder / "report.html", settings)
