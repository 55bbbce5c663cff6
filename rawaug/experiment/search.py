"""A setting of an estimator that is chosen on validation: one candidate is trained for each value, the best is named.

No test frame has a say. The score is the one by which a training keeps its weights: the best of ``log.csv``, or the
last where there are no validation frames.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean


def chosen(candidates: Mapping[str, str], folders: Sequence[Path], best: bool) -> dict[str, dict[str, float]]:
    """Of every arm with a search its candidates and their mean validation PSNR over the runs, the highest first.

    Args:
        candidates: by name, the arm whose they are.
        folders: of the runs, each with a folder for each candidate.
        best: weights are those of the best score, else those of the last.
    """
    scores: dict[str, dict[str, float]] = {}
    for label, arm in candidates.items():
        found = [_score(folder / label / "log.csv", best) for folder in folders]
        scores.setdefault(arm, {})[label] = fmean(found)
    return {arm: dict(sorted(found.items(), key=lambda one: -one[1])) for arm, found in scores.items()}


def _score(log: Path, best: bool) -> float:
    with log.open(newline="") as file:
        scores = [float(row["psnr"]) for row in csv.DictReader(file)]
    return max(scores) if best else scores[-1]
