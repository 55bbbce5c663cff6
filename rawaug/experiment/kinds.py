"""The kinds of experiment that the key ``experiment`` of a recipe names; without it denoisers are trained."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rawaug.experiment.denoiser_sweep import DenoiserSweep, smoke_sweep, sweep
from rawaug.experiment.denoising import dry_run, run
from rawaug.experiment.plain_yaml import read_yaml
from rawaug.experiment.recipe import Recipe, smoke
from rawaug.experiment.tables_rehearsed import (
    rehearse_ablation,
    rehearse_comparison,
    rehearse_learned,
    rehearse_sweep,
)
from rawaug.paper.ablation import Ablation, ablate, smoke_ablation
from rawaug.paper.component_ablation import LearnedParts, smoke_learned, weigh_parts
from rawaug.paper.reconstruction import Comparison, compare, smoke_comparison


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


_DATA = ("data", "test", "pictures")
"""Keys of data, and what those below begin with."""

KINDS = {
    "training": Kind(Recipe, run, smoke, dry_run),
    "reconstruction": Kind(Comparison, compare, smoke_comparison, rehearse_comparison),
    "ablation": Kind(Ablation, ablate, smoke_ablation, rehearse_ablation),
    "learned": Kind(LearnedParts, weigh_parts, smoke_learned, rehearse_learned),
    "denoisers": Kind(DenoiserSweep, sweep, smoke_sweep, rehearse_sweep),
}


def quickly(kind: str, settings: Any, given: set[str]) -> Any:
    """Settings in a form of seconds, on built-in data; of what was given, that which they replace is printed.

    Args:
        kind: of the experiment.
        settings: its settings.
        given: keys that were set on the command line.

    Raises:
        ValueError: if one of them names data.
    """
    quick = KINDS[kind].smoke(settings)
    replaced = {key: _value(quick, key) for key in sorted(given) if _value(settings, key) != _value(quick, key)}
    for key in replaced:
        if key.partition(".")[0] in _DATA and isinstance(_value(settings, key), (str, list)):
            option = f"--{key.replace('_', '-')}"
            raise ValueError(f"{option}: --smoke runs on built-in data; rehearse a run on your own with --dry-run")
    replaced.pop("name", None)
    if replaced:
        print(f"--smoke sets {', '.join(f'{key} to {value}' for key, value in replaced.items())}")
    return quick


def _value(settings: Any, key: str) -> Any:
    """Of a dotted key; None where there is no such key."""
    for name in key.split("."):
        settings = settings.get(name) if isinstance(settings, dict) else getattr(settings, name, None)
    return settings


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
