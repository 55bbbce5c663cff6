"""Every figure of the README and of the model cards stands in the ledger, docs/results.md and the pages beside it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [page.read_text() for page in sorted((ROOT / "docs").glob("results*.md"))]
LEDGER = "\n".join(PAGES)
CARDS = sorted([*(ROOT / "denoisers" / "weights").glob("*.md"), *(ROOT / "rawaug" / "weights").glob("*.md")])
DECIMALS = re.compile(r"(?<![\w.-])\d+\.\d+(?![\w.])(?!e-)")
"""Figures have decimals; an exponent makes one a noise level, a hyphen before it the version of a licence."""


@pytest.mark.parametrize("page", [ROOT / "README.md", *CARDS], ids=lambda page: page.stem)
def test_every_figure_stands_in_the_ledger(page: Path) -> None:
    claimed = set(DECIMALS.findall(re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)))
    missing = sorted(figure for figure in claimed if not re.search(rf"(?<![\d.]){re.escape(figure)}(?!\d)", LEDGER))
    assert not missing, f"{page.name} has figures that the ledger does not: {', '.join(missing)}"


def test_the_pages_have_figures_to_look_for() -> None:
    assert len(DECIMALS.findall((ROOT / "README.md").read_text())) > 40
    assert len(CARDS) >= 8


def test_the_readme_is_read_in_two_minutes() -> None:
    words = [word for word in re.split(r"[\s|]+", (ROOT / "README.md").read_text()) if re.search(r"\w", word)]
    assert len(words) <= 700


def test_the_pages_of_the_ledger_are_short_enough_to_be_read() -> None:
    assert max(len(page.splitlines()) for page in PAGES) <= 1000
