"""The kinds of experiment that the key ``experiment`` of a recipe names; without it denoisers are trained."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rawaug.experiment.ablation import Ablation, ablate, smoke_ablation
from rawaug.experiment.denoiser_sweep import DenoiserSweep, smoke_sweep, sweep
from rawaug.experiment.denoising import dry_run, run
from rawaug.experiment.learned_parts import LearnedParts, smoke_learned, weigh_parts
from rawaug.experiment.plain_yaml import read_yaml
from rawaug.experiment.recipe import Recipe, smoke
from rawaug.experiment.reconstruction import Comparison, compare, smoke_comparison
from rawaug.experiment.tables_rehearsed import (
    rehearse_ablation,
    rehearse_comparison,
    rehearse_learned,
    rehearse_sweep,
)


class Kind(NamedTuple):
    """One kind of experiment.

    Args:
        settings: dataclass of its keys.
        run: does it; called with the settings and whether another run of the name is replaced.
        smoke: its settings in a form of seconds.
        dry_run: says what would be done and tries what could fail late, without writing; called like ``run``.
    """

    settings: type[Any]
    run: Callable[[Any, bool], Any]
    smoke: Callable[[Any], Any]
    dry_run: Callable[[Any, bool], None]


KINDS = {
    "training": Kind(Recipe, run, smoke, dry_run),
    "reconstruction": Kind(Comparison, compare, smoke_comparison, rehearse_comparison),
    "ablation": Kind(Ablation, ablate, smoke_ablation, rehearse_ablation),
    "learned": Kind(LearnedParts, weigh_parts, smoke_learned, rehearse_learned),
    "denoisers": Kind(DenoiserSweep, sweep, smoke_sweep, rehearse_sweep),
}


def kind_of(recipe: str | Path) -> str:
    """The kind of experiment that a recipe's file names.

    Raises:
        ValueError: if the file cannot be read as YAML, or there is no such kind.
    """
    content = read_yaml(recipe)
    kind = content.get("experiment", "training") if isinstance(content, dict) else "training"
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"{recipe}: unknown experiment {kind!r:.80}; use one of {', '.join(KINDS)}")
    return kind
