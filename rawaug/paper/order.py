"""Whether the rows of a table are ordered as in the paper: pair by pair, found again, refuted, or not decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from statistics import fmean
from typing import Any

from rawaug.evaluation.verdict import paired_interval

TENTH = 0.1
"""Least difference in dB that a table of one seed is believed."""


def compare_order(table: Mapping[str, Mapping[str, Any]], column: str) -> tuple[int, list[str], list[str]]:
    """Compare the order of the rows by a column with that of the paper's figures.

    A pair of rows is open if the interval of their differences, seed by seed, holds 0
    (:func:`rawaug.evaluation.verdict.paired_interval`), or if they differ by less than :data:`TENTH` where there is one
    seed, of which no spread is known.

    Returns:
        The number of pairs that are ordered alike, the pairs that are refuted, and those that are open.
    """
    figures = {}
    for name, cells in table.items():
        ours, paper = cells.get(column), cells.get(f"{column}, paper")
        if as_mean(ours) is not None and paper is not None:
            figures[name] = ours, paper

    alike = 0
    refuted: list[str] = []
    undecided: list[str] = []
    for (first, (ours, paper)), (second, (other, other_paper)) in combinations(figures.items(), 2):
        pair = f"{first} above {second}" if paper > other_paper else f"{second} above {first}"
        side = _compare(ours, other)
        if side == 0:
            undecided.append(pair)
        elif side * (paper - other_paper) > 0:
            alike += 1
        else:
            refuted.append(pair)
    return alike, refuted, undecided


def _compare(ours: Any, other: Any) -> int:
    """Say which of two figures is higher, 1 or -1, or 0 if that is not decided."""
    difference = (as_mean(ours) or 0.0) - (as_mean(other) or 0.0)
    low, high = difference - TENTH, difference + TENTH

    if isinstance(ours, list) and isinstance(other, list):
        by_seed = [a - b for a, b in zip(ours, other, strict=False) if a is not None and b is not None]
        if len(by_seed) > 1:
            low, high = paired_interval(by_seed)

    if low <= 0.0 <= high:
        return 0
    return 1 if difference > 0 else -1


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


def as_mean(value: Any) -> float | None:
    """Average a figure, which may be one for each seed; return None without it."""
    if not isinstance(value, list):
        return value

    numbers = [number for number in value if number is not None]
    if not numbers:
        return None
    return fmean(numbers)
