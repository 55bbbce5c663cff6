"""Put the figures of docs/figures.json into the pages that show them.

    python .ci/figures.py

A page names a figure by set, row and column. Behind the first cell of a table's row, ``<!-- set: row -->`` fills the
other cells by the heads of their columns; in a sentence, ``<!-- set: row: column -->`` fills the text up to the next
``<!-- -->``. What the file has no figure for stays as it is. ``make docs`` runs this first, and a test does the same.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [
    ROOT / "README.md",
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "denoisers" / "weights").glob("*.md")),
    *sorted((ROOT / "rawaug" / "weights").glob("*.md")),
]
ROW = re.compile(r"<!-- ([^:>]+): ([^:>]+) -->")
INLINE = re.compile(r"(<!-- ([^:>]+): ([^:>]+): ([^:>]+) -->).*?(<!-- -->)", re.DOTALL)

Figures = dict[str, dict[str, dict[str, str]]]
"""Texts by set, row and column."""


def read_figures() -> Figures:
    """Read the figures of every set."""
    sets = json.loads((ROOT / "docs" / "figures.json").read_text(encoding="utf-8"))
    return {name: content["figures"] for name, content in sets.items()}


def fill(page: str, figures: Figures) -> str:
    """Return the page with its figures; raise KeyError if it names one that there is not."""
    lines: list[str] = []
    head: list[str] = []
    for line in page.split("\n"):
        cells = line.split("|")
        if not line.startswith("|"):
            head = []
        elif not head:
            head = [re.sub(r"[`*]", "", cell).strip() for cell in cells]
        elif marker := ROW.search(cells[1]):
            row = _find_row(figures[marker[1]], marker[2])
            for column, name in enumerate(head[2:-1], 2):
                if name in row:
                    cells[column] = f" {row[name]} "
        lines.append("|".join(cells))

    return INLINE.sub(lambda mark: mark[1] + figures[mark[2]][mark[3]][mark[4]] + mark[5], "\n".join(lines))


def _find_row(rows: dict[str, dict[str, str]], name: str) -> dict[str, str]:
    """Find a row, or a column where the page's table has the other order."""
    if name in rows:
        return rows[name]

    column = {row: cells[name] for row, cells in rows.items() if name in cells}
    if not column:
        raise KeyError(f"docs/figures.json has neither a row nor a column {name!r}")
    return column


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(fill(path.read_text(encoding="utf-8"), read_figures()), encoding="utf-8")
