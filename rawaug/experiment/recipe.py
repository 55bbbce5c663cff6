"""Recipe files: where they are, how they are read, and which kind of experiment one is for."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, get_type_hints

from rawaug.files import read_yaml
from rawaug.registry import Registry, suggest
from rawaug.tasks.base import TASKS

EXPERIMENTS = Registry("experiment", "rawaug.experiments", "rawaug.paper")
"""The experiments that are no tasks, by the name in a recipe's key ``experiment``.

They are functions ``run(settings, overwrite)``. ``settings`` is a dataclass of the recipe's keys, whose method
``shortest()`` gives the settings of a dry run.
"""

DEFAULT_KIND = "raw"
"""The kind of a recipe without the key ``experiment``."""


def read_recipe(file: str | Path) -> dict[str, Any]:
    """The keys and values of a YAML file; ValueError if it is no recipe, or has aliases or too many bytes."""
    content = read_yaml(file, "recipe") or {}
    if not isinstance(content, dict):
        raise ValueError(f"{file}: not a recipe: it must hold keys and values")
    return content


def kind_of(content: Mapping[str, Any], file: str | Path = "recipe") -> str:
    """The kind of experiment that a recipe is for; ValueError, which names the file, if there is no such kind."""
    kind = content.get("experiment", DEFAULT_KIND)
    known = kinds()
    if kind not in known:
        raise ValueError(f"{file}: unknown experiment {kind!r:.80}; use one of {', '.join(known)}")

    return str(kind)


def kinds() -> list[str]:
    """The kinds of experiment: the tasks and the comparisons of methods, each named after its file."""
    return [*TASKS, *EXPERIMENTS]


def settings_of(kind: str) -> type[Any]:
    """The dataclass with the keys of a kind of experiment: a task's, or the type of a function's first argument."""
    if kind in TASKS:
        settings: type[Any] = TASKS[kind].settings
        return settings

    return next(iter(get_type_hints(EXPERIMENTS[kind]).values()))


def shipped_recipes() -> dict[str, Path]:
    """The recipes that travel with the package, by name."""
    shipped = Path(str(resources.files("rawaug"))) / "recipes"
    folder = shipped if shipped.is_dir() else Path(__file__).parents[2] / "recipes"
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in sorted(folder.rglob("*.yaml"))}


def recipe_list() -> str:
    """The names of the shipped recipes and the first lines of their files, a line each."""
    shipped = sorted(shipped_recipes().items(), key=lambda item: ("/" in item[0], item[0]))  # those at the top first
    known = {name: file.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ") for name, file in shipped}
    width = max(map(len, known)) + 2
    return "\n".join(f"  {name:<{width}}{title}" for name, title in known.items())


def find_recipe(name: str) -> Path:
    """The path of a recipe: a file, or one that travels with the package, by its name with or without ``.yaml``.

    Raises:
        FileNotFoundError: if there is no such recipe.
    """
    path, known = Path(name), shipped_recipes()
    if path.is_file():
        return path
    wanted = path.with_suffix("").as_posix() if path.suffix == ".yaml" else path.as_posix()
    if wanted in known:
        return known[wanted]
    shipped = f"{', '.join(known)}{suggest(wanted, known)}"
    raise FileNotFoundError(f"{name}: no such recipe; give a YAML file or a shipped recipe: {shipped}")
