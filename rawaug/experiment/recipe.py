"""Recipe files: where they are, how they are read, and which kind of experiment one is for."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, get_type_hints

from rawaug.experiment.task import TASKS
from rawaug.files import read_yaml
from rawaug.registry import Registry, suggest

EXPERIMENTS = Registry("experiment", "rawaug.experiments", "rawaug.paper")
"""Experiments that are no tasks, by their name in a recipe's key ``experiment``.

Experiments are functions ``run(settings, overwrite)``. ``settings`` is a dataclass of the recipe's keys, whose method
``shortest()`` gives the settings of a dry run.
"""

_DEFAULT_KIND = "raw"
"""The kind of a recipe without the key ``experiment``."""


def read_recipe(file: str | Path) -> dict[str, Any]:
    """Read a YAML file's keys and values; raise ValueError if it is no recipe, has aliases or is too large."""
    content = read_yaml(file, "recipe") or {}
    if not isinstance(content, dict):
        raise ValueError(f"{file}: not a recipe: it must hold keys and values")

    return content


def find_kind(content: Mapping[str, Any], file: str | Path = "recipe") -> str:
    """Find the kind of experiment that a recipe is for; raise ValueError, with the file's name, if it is unknown."""
    kind = content.get("experiment", _DEFAULT_KIND)
    if kind not in kinds():
        raise ValueError(f"{file}: unknown experiment {kind!r:.80}; use one of {', '.join(kinds())}")

    return str(kind)


def kinds() -> list[str]:
    """List the kinds of experiment: the tasks and the comparisons of methods, each named after its file."""
    return [*TASKS, *EXPERIMENTS]


def find_settings(kind: str) -> type[Any]:
    """Find the dataclass with a kind's keys: a task's, or the type of a function's first argument."""
    if kind in TASKS:
        settings: type[Any] = TASKS[kind].settings
        return settings

    return next(iter(get_type_hints(EXPERIMENTS[kind]).values()))


def shipped_recipes() -> dict[str, Path]:
    """List the recipes that are shipped with the package, by name."""
    folder = Path(str(resources.files("rawaug"))) / "recipes"
    if not folder.is_dir():  # this is a clone, where they lie next to the package
        folder = Path(__file__).parents[2] / "recipes"

    recipes = {}
    for file in sorted(folder.rglob("*.yaml")):
        name = file.relative_to(folder).with_suffix("").as_posix()
        recipes[name] = file

    return recipes


def recipe_list() -> str:
    """List the names of the shipped recipes and the first lines of their files, a line each."""
    recipes = shipped_recipes()
    names = sorted(recipes, key=lambda name: ("/" in name, name))  # those at the top come first
    width = max(map(len, names)) + 2

    lines = []
    for name in names:
        first_line, *_ = recipes[name].read_text(encoding="utf-8").partition("\n")
        title = first_line.lstrip("# ")
        lines.append(f"  {name:<{width}}{title}")

    return "\n".join(lines)


def find_recipe(name: str) -> Path:
    """Find a recipe: a file, or a shipped one by its name with or without ``.yaml``.

    Raises:
        FileNotFoundError: if there is no such recipe.
    """
    path = Path(name)
    if path.is_file():
        return path

    if path.suffix == ".yaml":
        path = path.with_suffix("")
    recipes = shipped_recipes()
    if path.as_posix() in recipes:
        return recipes[path.as_posix()]

    choices = f"{', '.join(recipes)}{suggest(path.as_posix(), recipes)}"
    raise FileNotFoundError(f"{name}: no such recipe; give a YAML file or a shipped recipe: {choices}")
