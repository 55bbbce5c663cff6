"""A setting of an estimator that is chosen on validation: one candidate is trained for each value, the best is named.

No test frame has a say. The score is the one by which a training keeps its weights: the best of ``log.csv``, or the
last where there are no validation frames.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING

from rawaug.registry import name_and_settings

if TYPE_CHECKING:
    from rawaug.experiment.recipe import ArmConfig


def expanded(arms: Mapping[str, ArmConfig]) -> dict[str, ArmConfig]:
    """The arms; in place of one with a search its candidates, ``ARM_KEYVALUE``.

    Raises:
        ValueError: if a search has not one key with values, or one is no setting of the estimator.
    """
    found: dict[str, ArmConfig] = {}
    for label, arm in arms.items():
        if not arm.search:
            found[label] = arm
            continue
        name, settings = name_and_settings(arm.estimator)
        ((key, values),) = arm.search.items() if len(arm.search) == 1 else [("", [])]
        if not values:
            raise ValueError(f"arms: {label}: search needs one setting with values, such as {{gamma: [2, 8, 16]}}")
        for value in values:
            estimator = {"name": name, "settings": {**settings, key: value}}
            found[f"{label}_{key}{value:g}"] = replace(arm, estimator=estimator, search=None, candidate_of=label)
    return found


def chosen(arms: Mapping[str, ArmConfig], folders: Sequence[Path], best: bool) -> dict[str, dict[str, float]]:
    """Of every search its candidates with their mean validation PSNR over the runs, the highest first.

    Args:
        arms: with candidates.
        folders: of the runs, each with a folder for each arm.
        best: weights are those of the best score, else those of the last.
    """
    scores: dict[str, dict[str, float]] = {}
    for label, arm in arms.items():
        if arm.candidate_of is not None:
            found = [_score(folder / label / "log.csv", best) for folder in folders]
            scores.setdefault(arm.candidate_of, {})[label] = fmean(found)
    return {arm: dict(sorted(found.items(), key=lambda one: -one[1])) for arm, found in scores.items()}


def _score(log: Path, best: bool) -> float:
    with log.open(newline="") as file:
        scores = [float(row["psnr"]) for row in csv.DictReader(file)]
    return max(scores) if best else scores[-1]
