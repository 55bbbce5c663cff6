r"""The tables of a page as separate files: CSV for a spreadsheet or a script, LaTeX for a paper.

``report.html`` has ``report_scores.csv`` and ``report_scores.tex`` beside it, and so on for each of its tables. The
LaTeX needs no package; the best figures are bold.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rawaug.errors import escape
from rawaug.files import write_text

_ESCAPES = {
    "\\": r"\textbackslash{}",
    "&": r"\&",
    "%": r"\%",
    "$": r"\$",
    "#": r"\#",
    "_": r"\_",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
}
_FORMULA = ("=", "+", "-", "@")
"""Spreadsheets take a cell that begins with one of these for a formula."""
_LATEX = str.maketrans(_ESCAPES)


def write_tables(page: Path, parts: Iterable[Mapping[str, Any]]) -> list[Path]:
    """Write each table of a page as CSV and as LaTeX beside it.

    Args:
        page: the path of the page, which gives the files their names.
        parts: the parts of the page, see :meth:`rawaug.evaluation.page.Page.add`. Parts without ``rows`` are no tables.

    Returns:
        The paths of the files.
    """
    paths = []
    for part in parts:
        if not part.get("rows"):
            continue

        name = re.sub(r"[^a-z0-9]+", "_", part["heading"].lower()).strip("_") or "table"
        path = page.with_name(f"{page.stem}_{name}.csv")
        _write_csv(path, part["head"], part["rows"])
        paths.append(path)

        path = path.with_suffix(".tex")
        write_text(latex_table(part["head"], part["rows"], part["best"]), path)
        paths.append(path)

    return paths


def _write_csv(path: Path, head: Sequence[str], rows: Mapping[str, Sequence[str]]) -> None:
    """Write a table with the names of its columns in ``head`` and its cells by the name of a row."""
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(map(_plain, head))
    for name, cells in rows.items():
        writer.writerow([_plain(name), *cells])
    write_text(table.getvalue(), path)


def _plain(name: str) -> str:
    """Put an apostrophe before a name that a spreadsheet would take for a formula."""
    text = escape(name)
    if text.startswith(_FORMULA):
        return f"'{text}"
    return text


def latex_table(head: Sequence[str], rows: Mapping[str, Sequence[str]], best: Collection[tuple[str, int]] = ()) -> str:
    r"""Format a table as a LaTeX ``tabular``.

    Args:
        head: the names of the columns.
        rows: the cells by the name of a row.
        best: (row, column) of the cells in bold; columns are counted from 0 after the name.

    Example:
        >>> print(latex_table(["", "PSNR"], {"my_arm": ["40.1 ± 0.2"]}, {("my_arm", 0)}))
        \begin{tabular}{lr}
        \hline
         & PSNR \\
        \hline
        my\_arm & \textbf{40.1 $\pm$ 0.2} \\
        \hline
        \end{tabular}
        <BLANKLINE>
    """
    lines = [rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\hline", _line(head), r"\hline"]
    for name, cells in rows.items():
        texts = [_escape_latex(name)]
        for column, cell in enumerate(cells):
            text = _escape_latex(cell)
            if (name, column) in best:
                text = rf"\textbf{{{text}}}"
            texts.append(text)
        lines.append(" & ".join(texts) + r" \\")

    lines += [r"\hline", r"\end{tabular}", ""]
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return " & ".join(map(_escape_latex, cells)) + r" \\"


def _escape_latex(text: str) -> str:
    return escape(text).translate(_LATEX)
