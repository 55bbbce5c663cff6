"""Pages show the figures of docs/figures.json and of the ledger, docs/results.md; they are those of shipped networks.

``python .ci/figures.py`` fills the pages, ``python -m benchmarks.figures`` the file.
"""

from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest

from denoisers.files import find_denoiser
from rawaug.files import sha256

ROOT = Path(__file__).parents[1]
PAGES = [page.read_text() for page in sorted((ROOT / "docs").glob("results*.md"))]
LEDGER = "\n".join(PAGES)
CARDS = sorted([*(ROOT / "denoisers" / "weights").glob("*.md"), *(ROOT / "rawaug" / "weights").glob("*.md")])
DECIMALS = re.compile(r"(?<![\w.-])\d+\.\d+(?![\w.])(?!e-)")
"""Figures have decimals; an exponent makes one a noise level, a hyphen before it the version of a licence."""

FILLING = runpy.run_path(str(ROOT / ".ci" / "figures.py"))
SETS = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("page", FILLING["PAGES"], ids=lambda page: page.stem)
def test_a_page_shows_the_figures_that_were_measured(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text == FILLING["fill"](text, FILLING["read_figures"]()), "run python .ci/figures.py"
    assert not re.search(r"^ *<!-- .*: ", text, re.MULTILINE), "a comment at the start of a line ends the paragraph"


@pytest.mark.parametrize("name", SETS)
def test_a_figure_is_of_the_network_that_ships(name: str) -> None:
    measured = SETS[name]
    assert measured["command"] and measured["commit"] and measured["frames"]
    for network, digest in measured["networks"].items():
        assert sha256(find_denoiser(network)) == digest, f"{name}: {network} has changed; measure it again"
    for row in measured["figures"].values():
        shipped = {column.partition(", ")[0] for column in row if column.startswith("rawaug-")}
        assert shipped <= measured["networks"].keys()


def test_filling_a_page() -> None:
    fill, figures = (
        FILLING["fill"],
        {"real": {"1/640 s": {"noisy": "55.84", "`a`": "0", "a": "62.36"}, "best": {"a": "3"}}},
    )
    table = "| | `a` | noisy | old |\n|---|---|---|---|\n| shot <!-- real: 1/640 s --> | 1 | 2 | 9 |"
    assert fill(table, figures).endswith("| shot <!-- real: 1/640 s --> | 62.36 | 55.84 | 9 |")
    turned = "| | 1/640 s | best |\n|---|---|---|\n| a <!-- real: a --> | | |"
    assert fill(turned, figures).endswith("| 62.36 | 3 |")
    assert fill("by <!-- real: best: a -->2<!-- --> dB", figures) == "by <!-- real: best: a -->3<!-- --> dB"
    with pytest.raises(KeyError):
        fill("<!-- real: best: b -->2<!-- -->", figures)
    with pytest.raises(KeyError):
        fill(table.replace("1/640 s", "1/2 s"), figures)


@pytest.mark.parametrize("page", [ROOT / "README.md", *CARDS], ids=lambda page: page.stem)
def test_every_figure_stands_in_the_ledger(page: Path) -> None:
    claimed = set(DECIMALS.findall(re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)))
    missing = sorted(figure for figure in claimed if not re.search(rf"(?<![\d.]){re.escape(figure)}(?!\d)", LEDGER))
    assert not missing, f"{page.name} has figures that the ledger does not: {', '.join(missing)}"


def test_denoise_says_how_far_apart_the_ledger_has_the_shipped_denoisers() -> None:
    table = LEDGER[LEDGER.index("| frames, strength | noisy |") :]
    heads, _, *rows = table[: table.index("\n\n")].splitlines()
    columns = [head.strip(" `") for head in heads.split("|")]

    gains: dict[str, list[float]] = {"rawaug-small": [], "rawaug-best": []}
    for row in rows:
        cells = dict(zip(columns, row.replace("*", "").split("|"), strict=True))
        raw = {name: float(cells[name].split("/")[0]) for name in ("rawaug-base", *gains)}
        for name, of_rows in gains.items():
            of_rows.append(abs(raw[name] - raw["rawaug-base"]))

    page = " ".join((ROOT / "docs" / "denoise.md").read_text().split())
    small, best = (f"{min(of_rows):.1f} to {max(of_rows):.1f} dB" for of_rows in gains.values())
    assert len(rows) == 28
    assert f"worse at every strength, by {small}" in page and f"{best} better under drawn noise" in page


def test_the_pages_have_figures_to_look_for() -> None:
    assert len(DECIMALS.findall((ROOT / "README.md").read_text())) > 40
    assert len(CARDS) >= 8


def test_the_readme_is_read_in_two_minutes() -> None:
    shown = re.sub(r"<!--.*?-->", "", (ROOT / "README.md").read_text())
    words = [word for word in re.split(r"[\s|]+", shown) if re.search(r"\w", word)]
    assert len(words) <= 700


def test_the_pages_of_the_ledger_are_short_enough_to_be_read() -> None:
    assert max(len(page.splitlines()) for page in PAGES) <= 1000
