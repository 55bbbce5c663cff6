"""Whether the rows of a table are ordered as in the paper: pair by pair, found again, refuted, or not decided."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from statistics import fmean, stdev
from typing import Any

TENTH = 0.1
"""Least difference in dB that a table of one seed is believed."""


def compare_order(table: Mapping[str, Mapping[str, Any]], column: str) -> tuple[int, list[str], list[str]]:
    """Compare the order of the rows by a column with that of the paper's figures.

    A pair of rows is open if these differ by no more than two standard errors over the seeds, or by less than
    :data:`TENTH` where there is one seed, of which no spread is known.

    Returns:
        The number of pairs that are ordered alike, the pairs that are refuted, and those that are open.
    """
    figures = {}
    for name, cells in table.items():
        ours, paper = as_mean(cells.get(column)), cells.get(f"{column}, paper")
        if ours is not None and paper is not None:
            figures[name] = (ours, _standard_error(cells[column]), paper)

    alike = 0
    refuted: list[str] = []
    undecided: list[str] = []
    for (first, (a, error_a, b)), (second, (c, error_c, d)) in combinations(figures.items(), 2):
        pair = f"{first} above {second}" if b > d else f"{second} above {first}"
        margin = TENTH
        if error_a is not None and error_c is not None:
            margin = 2.0 * math.hypot(error_a, error_c)

        if abs(a - c) <= margin:
            undecided.append(pair)
        elif (a - c) * (b - d) > 0:
            alike += 1
        else:
            refuted.append(pair)
    return alike, refuted, undecided


def order_sentence(alike: int, refuted: Sequence[str], undecided: Sequence[str]) -> str:
    """Say in a sentence whether the paper's order is found again; the figures are :func:`compare_order`'s."""
    total = alike + len(refuted) + len(undecided)
    if not total:
        return ""
    if alike == total:
        return f"The paper's order is found again in all {total} pairs of rows."

    sentence = f"The paper's order is found again in {alike} of {total} pairs of rows"
    for answer, pairs in (("refuted", refuted), ("not decided", undecided)):
        if pairs:
            sentence += f"; {answer}: {', '.join(pairs)}"
    return f"{sentence}."


def _standard_error(value: Any) -> float | None:
    """Compute the standard error of a figure that is given for several seeds; None of one."""
    if not isinstance(value, list):
        return None

    numbers = [number for number in value if number is not None]
    if len(numbers) < 2:
        return None
    return stdev(numbers) / math.sqrt(len(numbers))


def as_mean(value: Any) -> float | None:
    """Average a figure, which may be one for each seed; return None without it."""
    if not isinstance(value, list):
        return value

    numbers = [number for number in value if number is not None]
    if not numbers:
        return None
    return fmean(numbers)
