"""Whether the rows of a table are ordered as in the paper: pair by pair, found again, refuted, or not decided."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations
from statistics import fmean, stdev
from typing import Any, NamedTuple

TENTH = 0.1
"""Least difference in dB that a table of one seed is believed."""


class Order(NamedTuple):
    """How the rows of a table are ordered in the paper and here: pairs of rows that are alike, refuted, and open.

    A pair is open if its rows differ by no more than two standard errors over the seeds, or by less than
    :data:`TENTH` where there is one seed, of which no spread is known.
    """

    same: int
    reversed: list[str]
    undecided: list[str]

    def sentence(self) -> str:
        """Say in a sentence whether the paper's order is found again."""
        total = self.same + len(self.reversed) + len(self.undecided)
        if not total:
            return ""
        if self.same == total:
            return f"The paper's order is found again in all {total} pairs of rows."

        sentence = f"The paper's order is found again in {self.same} of {total} pairs of rows"
        for answer, pairs in (("refuted", self.reversed), ("not decided", self.undecided)):
            if pairs:
                sentence += f"; {answer}: {', '.join(pairs)}"
        return f"{sentence}."


def compare_order(table: Mapping[str, Mapping[str, Any]], column: str) -> Order:
    """Compare the order of the rows by a column with that of the paper's figures."""
    figures = {}
    for name, cells in table.items():
        ours, paper = mean_of(cells.get(column)), cells.get(f"{column}, paper")
        if ours is not None and paper is not None:
            figures[name] = (ours, _standard_error(cells[column]), paper)

    order = Order(0, [], [])
    for (first, (a, error_a, b)), (second, (c, error_c, d)) in combinations(figures.items(), 2):
        pair = f"{first} above {second}" if b > d else f"{second} above {first}"
        margin = TENTH
        if error_a is not None and error_c is not None:
            margin = 2.0 * math.hypot(error_a, error_c)

        if abs(a - c) <= margin:
            order.undecided.append(pair)
        elif (a - c) * (b - d) > 0:
            order = order._replace(same=order.same + 1)
        else:
            order.reversed.append(pair)
    return order


def _standard_error(value: Any) -> float | None:
    """Compute the standard error of a figure that is given for several seeds; None of one."""
    if not isinstance(value, list):
        return None

    numbers = [number for number in value if number is not None]
    if len(numbers) < 2:
        return None
    return stdev(numbers) / math.sqrt(len(numbers))


def mean_of(value: Any) -> float | None:
    """Average a figure, which may be one for each seed; return None without it."""
    if not isinstance(value, list):
        return value

    numbers = [number for number in value if number is not None]
    if not numbers:
        return None
    return fmean(numbers)
