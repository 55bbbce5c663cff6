"""The kinds of experiment that the key ``experiment`` of a recipe names; without it denoisers are trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, get_type_hints

from rawaug.experiment.denoiser_sweep import smoke_sweep
from rawaug.experiment.denoising import dry_run
from rawaug.experiment.plain_yaml import read_yaml
from rawaug.experiment.recipe import smoke
from rawaug.experiment.run_folder import require_free
from rawaug.experiment.tables_rehearsed import rehearse_sweep
from rawaug.registry import EXPERIMENTS, UnknownName


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

_QUICK = {"training": (smoke, dry_run), "denoisers": (smoke_sweep, rehearse_sweep)}


def kind_named(name: str) -> Kind:
    """The kind of experiment of this name.

    Raises:
        UnknownName: if there is none.
    """
    run = EXPERIMENTS[name]
    settings = next(iter(get_type_hints(run).values()))
    return Kind(settings, run, *(_QUICK[name] if name in _QUICK else (settings.smoke, _shortest_run)))  # noqa: SIM401, two lack it


def _shortest_run(settings: Any, overwrite: bool = False) -> None:
    """The run itself in its shortest form, in a temporary folder."""
    folder = require_free(settings, overwrite)
    with TemporaryDirectory() as elsewhere:
        EXPERIMENTS[settings.experiment](replace(settings.shortest(), out=elsewhere))
    print(f"dry run: nothing wrong found, nothing written to {folder}")


def quickly(kind: str, settings: Any, given: set[str]) -> Any:
    """Settings in a form of seconds, on built-in data; of what was given, that which they replace is printed.

    Args:
        kind: of the experiment.
        settings: its settings.
        given: keys that were set on the command line.

    Raises:
        ValueError: if one of them names data.
    """
    quick = kind_named(kind).smoke(settings)
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
    try:
        kind_named(str(kind))
    except UnknownName as error:
        raise ValueError(f"{recipe}: {error}") from None
    return str(kind)
