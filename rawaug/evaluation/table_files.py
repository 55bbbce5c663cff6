r"""The tables of a page as separate files: CSV for a spreadsheet or a script, LaTeX for a paper.

``report.html`` has ``report_scores.csv`` and ``report_scores.tex`` beside it, and so on for each of its tables. Their
LaTeX needs no package; the best figures are bold. The table of a benchmark for a paper needs the package booktabs.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from rawaug.errors import count_of, escape
from rawaug.evaluation.benchmark import TOLD, paired_gains
from rawaug.evaluation.verdict import paired_interval
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
        table = io.StringIO(newline="")
        writer = csv.writer(table, lineterminator="\n")
        writer.writerow(map(_plain, part["head"]))
        for row, cells in part["rows"].items():
            writer.writerow([_plain(row), *cells])
        write_text(table.getvalue(), path)
        paths.append(path)

        path = path.with_suffix(".tex")
        write_text(latex_table(part["head"], part["rows"], part["best"]), path)
        paths.append(path)

    return paths


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


def latex_benchmark(result: Mapping[str, Any], command: str) -> str:
    """Format a benchmark at known levels as a LaTeX ``tabular`` with booktabs, RAW and sRGB in columns of their own.

    A cell is the mean PSNR over frames and its standard error. It is bold if the paired difference to every other row,
    frame by frame, has an interval above zero.

    Args:
        result: the result of :func:`rawaug.evaluation.benchmark.benchmark`.
        command: the command line that made it, for a comment.
    """
    rows = result["rows"]
    strengths = list(rows["noisy input"]["scores"][TOLD])
    columns = [(strength, key) for strength in strengths for key in ("psnr", "psnr_srgb")]

    lines = [f"% {command}", f"% hash of the noisy input: {result['hash']}; PSNR in dB, mean and standard error over"]
    lines += [f"% {count_of(len(result['frames']), 'frame')}; bold: ahead of every other row by paired differences"]
    lines += [rf"\begin{{tabular}}{{l{'r' * len(columns)}}}", r"\toprule"]
    heads, rules = [""], []
    for number, strength in enumerate(strengths):
        heads.append(rf"\multicolumn{{2}}{{c}}{{{_escape_latex(strength)}}}")
        rules.append(rf"\cmidrule(lr){{{2 * number + 2}-{2 * number + 3}}}")
    lines += [" & ".join(heads) + r" \\", " ".join(rules)]
    lines += [_line(["PSNR, dB", *["RAW", "sRGB"] * len(strengths)]), r"\midrule"]

    for name, row in rows.items():
        cells = [_escape_latex(name)]
        for strength, key in columns:
            values = [image[key] for image in row["scores"][TOLD][strength]["images"] if key in image]
            text = ""
            if values:
                text = f"{fmean(values):.2f}"
            if len(values) > 1:
                text += rf" $\pm$ {stdev(values) / math.sqrt(len(values)):.2f}"
            if text and _leads(result, name, strength, key):
                text = rf"\textbf{{{text}}}"
            cells.append(text)
        lines.append(" & ".join(cells) + r" \\")

    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _leads(result: Mapping[str, Any], name: str, strength: str, key: str) -> bool:
    """Tell whether a row is ahead of every other one beyond the spread of paired differences."""
    for other in result["rows"]:
        if other == name:
            continue
        gains = paired_gains(result, name, other, strength, key)
        if not gains or paired_interval(gains)[0] <= 0:
            return False
    return True
