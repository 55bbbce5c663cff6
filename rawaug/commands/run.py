"""``rawaug run``: runs the experiment of a recipe's file, with the keys of the command line put into it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, get_args

from annotated_types import Interval
from cyclopts import Parameter
from docstring_parser import parse
from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from rawaug.commands import parse_value
from rawaug.experiment import run as experiment
from rawaug.experiment.data import use_all_pairs
from rawaug.experiment.recipe import find_kind, find_recipe, find_settings, read_recipe, recipe_list
from rawaug.experiment.settings import Recipe
from rawaug.registry import field_types, list_bounds, suggest

SHARED = ("channels", "variance_map", "deviation", "domain")
"""Settings that all networks share."""

_LARGE = 2**31
"""A bound that only keeps memory from being filled: numbers beyond are allowed, but nobody means them."""


def run(
    recipe: str = "",
    /,
    *changes: Annotated[str, Parameter(allow_leading_hyphen=True)],
    keys: bool = False,
    dry_run: bool = False,
    overwrite: bool = False,
) -> None:
    """Run a recipe: rawaug run RECIPE [--key value ...]; resumable, writes runs/NAME.

    Args:
        recipe: a YAML file, or the name of a shipped recipe.
        changes: keys of the recipe and their values, as --train.steps 100; a value is YAML.
        keys: list the keys of the recipe, as --help after its name does.
        dry_run: show which data would be used and try every stage once on it, without keeping results.
        overwrite: replace a run of this name that has other settings.
    """
    if not recipe:
        print(f"rawaug run RECIPE [--key value ...], where RECIPE is a YAML file or one of\n\n{recipe_list()}\n")
        print("rawaug run RECIPE --help lists its keys; --dry-run rehearses it on your data.")
        return

    file = find_recipe(recipe)
    content = read_recipe(file)
    kind = find_kind(content, file)
    if keys:
        print_keys(find_settings(kind), content)
        return

    options = parse_options(changes, find_settings(kind))
    settings = with_values(find_settings(kind), merge_options(content, options), file)
    if isinstance(settings, Recipe):
        settings = use_all_pairs(settings, content, {key for key, _ in options})

    if dry_run:
        experiment.dry_run(kind, settings, overwrite)
    else:
        experiment.run_kind(kind, settings, overwrite)


# -- the command line --------------------------------------------------------------------------------------------------


def parse_options(words: Sequence[str], settings: type[Any]) -> list[tuple[str, Any]]:
    """Parse the words of a command line, ``--key value`` or ``--key=value``, into dotted keys and values.

    ``--denoiser DnCNN`` is short for ``--denoiser.name DnCNN``; a field of the settings may be spelt with hyphens.

    Raises:
        ValueError: if a word is no key, or a key has no value.
    """
    field_names = set()
    for key in list_keys(settings):
        field_names.update(key.split("."))

    options = []
    remaining = iter(words)
    for word in remaining:
        name, equals, text = word.partition("=")
        if not name.startswith("--"):
            raise ValueError(f"{word}: too many arguments; keys of the recipe are set by --key value")
        if not equals:
            following = next(remaining, None)
            if following is None:
                raise ValueError(f"{name} needs a value")
            text = following

        parts = []
        for part in name.removeprefix("--").split("."):
            underscored = part.replace("-", "_")
            parts.append(underscored if underscored in field_names else part)

        value = parse_value(text)
        if parts[-1] == "denoiser" and isinstance(value, str):
            parts.append("name")
        options.append((".".join(parts), value))

    return options


def merge_options(content: Mapping[str, Any], options: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """Put the values of the command line into the content of a recipe's file."""
    merged = deepcopy(dict(content))
    for key, value in options:
        if key.endswith("denoiser.name"):
            drop_old_settings(merged, key, value)

    for key, value in options:
        if key == "arms" and isinstance(value, (str, list)):
            merged["arms"] = keep_arms(merged.get("arms") or {}, value)
        else:
            set_value(merged, key.split("."), value)

    return merged


def set_value(content: dict[str, Any], path: Sequence[str], value: Any) -> None:
    """Set a value at a path of keys; a name on the way there becomes ``{name: ...}``, anything else a mapping."""
    for part in path[:-1]:
        if isinstance(content.get(part), str):
            content[part] = {"name": content[part]}
        elif not isinstance(content.get(part), dict):
            content[part] = {}
        content = content[part]

    content[path[-1]] = value


def keep_arms(arms: Mapping[str, Any], names: str | Sequence[str]) -> dict[str, Any]:
    """Keep the arms of a recipe that ``--arms NAME`` or ``--arms '[NAME, NAME]'`` names, in the recipe's order.

    Raises:
        ValueError: if a name is none of the recipe's arms.
    """
    if isinstance(names, str):
        names = [names]
    for name in names:
        if name not in arms:
            raise ValueError(f"arms: {name} is not an arm; use one of {', '.join(arms)}{suggest(name, arms)}")

    return {name: arm for name, arm in arms.items() if name in names}


def drop_old_settings(content: dict[str, Any], key: str, name: Any) -> None:
    """Drop the settings of a network that another one replaces; settings that all networks have stay.

    Args:
        content: the content of the recipe, which is changed.
        key: the dotted key that names the network.
        name: the other network.
    """
    section: Any = content
    above = key.removesuffix(".name")
    for part in above.split("."):
        section = section.get(part) if isinstance(section, Mapping) else None

    if not isinstance(section, dict) or not section.get("settings") or section.get("name", "UNet") == name:
        return

    shared = {}
    dropped = {}
    for setting, value in section["settings"].items():
        if setting in SHARED:
            shared[setting] = value
        else:
            dropped[setting] = value

    section["settings"] = shared
    if dropped:
        of = section.get("name", "UNet")
        print(
            f"{above}: the settings of {of} are dropped for {name}'s own: {json.dumps(dropped)}; "
            f"others: --{above}.settings.KEY VALUE"
        )


# -- settings ----------------------------------------------------------------------------------------------------------


def with_values(settings: Any, content: Mapping[str, Any], source: object) -> Any:
    """Make an instance of the dataclass ``settings`` with the values of ``content``, which its types validate.

    Args:
        settings: a dataclass.
        content: the values by key; ``experiment`` is no key unless the dataclass has it.
        source: where they come from, which heads an error.

    Raises:
        ValueError: if a key is unknown, or a value is of another type or out of bounds.
    """
    values = dict(content)
    if "experiment" not in field_types(settings):
        values.pop("experiment", None)

    try:
        _require_keys(settings, values, list_keys(settings))
        return TypeAdapter(settings).validate_python(values)
    except ValidationError as error:
        raise ValueError(f"{source}: {_reason(error.errors()[0], values)}") from None
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


def list_keys(settings: Any, above: str = "") -> dict[str, tuple[Any, str]]:
    """List the keys of a dataclass and of those in it, dotted: their defaults, and what docstrings say they mean."""
    hints = field_types(settings)
    meanings = _read_meanings(settings)
    keys: dict[str, tuple[Any, str]] = {}
    bounds = list_bounds(settings)
    for field in fields(settings):
        part, by_name = _part(hints[field.name])
        name = f"{above}{field.name}"

        if part is None or by_name:
            default = field.default
            if field.default_factory is not MISSING:
                default = field.default_factory()
            names = field.metadata.get("registry", ())
            meaning = meanings.get(field.name, "")
            if names:
                meaning += f" One of {', '.join(names)}."
            if field.name in bounds:
                meaning += describe_bounds(bounds[field.name])
            keys[name] = default, meaning

        if part is not None:
            keys |= list_keys(part, f"{name}.NAME." if by_name else f"{name}.")

    return keys


@cache
def _read_meanings(settings: type[Any]) -> dict[str, str]:
    """Read what the docstrings of a dataclass and of its bases say about its fields."""
    meanings: dict[str, str] = {}
    for base in reversed(settings.__mro__):
        for parameter in parse(base.__doc__ or "").params:
            meanings[parameter.arg_name] = parameter.description or ""
    return meanings


def describe_bounds(bounds: Interval) -> str:
    """Write the bounds of a number as a sentence; those that only keep memory from being filled are left out."""
    least: Any = bounds.ge
    if bounds.lt is not None:
        return f" At least {least} and below {bounds.lt}."

    most: Any = bounds.le
    if least < -_LARGE:
        return ""
    if most >= _LARGE:
        return f" At least {least}."

    return f" From {least} to {most}."


def print_keys(settings: type[Any], content: Mapping[str, Any]) -> None:
    """Print the keys of a recipe by section, each with its value in ``content``."""
    console = Console(soft_wrap=False)
    tables: dict[str, Table] = {}
    for key, (default, meaning) in list_keys(settings).items():
        value: Any = content
        for part in key.split("."):
            value = value.get(part, default) if isinstance(value, Mapping) else default

        if key == "arms":
            shown = "by NAME, below"
        else:
            shown = "" if value is MISSING else json.dumps(value)

        option = f"--{key.replace('_', '-')}"
        text = re.sub(r"(:\w+:)?`+([^`]*)`+", r"\2", " ".join(meaning.split()))  # without markup
        table = tables.setdefault(key.rpartition(".")[0], Table.grid(padding=(0, 2)))
        table.add_row(Text(option, style="cyan"), Text(text), Text(shown))

    for section, table in tables.items():
        console.print(Text(f"{section or 'recipe'}:", style="bold"))
        console.print(Padding(table, (0, 0, 1, 2)))


def _part(hint: Any) -> tuple[type[Any] | None, bool]:
    """Find the dataclass of a key's value, and tell whether there are several of it, by name."""
    for inside in (hint, *get_args(hint)):
        if is_dataclass(inside):
            return inside, getattr(hint, "__origin__", None) is dict  # type: ignore[return-value]

    return None, False


def _require_keys(settings: Any, content: Any, names: Iterable[str], above: str = "") -> None:
    """Raise ValueError, with the nearest name, if a key is none of a dataclass or of those in it."""
    if not isinstance(content, Mapping):
        return  # pydantic says what it should be

    hints = field_types(settings)
    for key, value in content.items():
        if key not in hints:
            raise ValueError(f"{above}{key}: no such key{suggest(f'{above}{key}', names)}")

        part, by_name = _part(hints[key])
        if part is None:
            continue
        if not by_name:
            _require_keys(part, value, names, f"{above}{key}.")
        elif isinstance(value, Mapping):
            for name, entry in value.items():
                _require_keys(part, entry, names, f"{above}{key}.{name}.")


def _reason(error: Any, content: Any) -> str:
    """Write one error of pydantic as a line; its location goes on into the types of a union, which are no keys."""
    keys = []
    for key in error["loc"]:
        if not isinstance(content, Mapping) or key not in content:
            break
        keys.append(str(key))
        content = content[key]

    name = ".".join(keys)
    if error["type"] != "value_error":
        return f"{name}: {error['msg'][0].lower()}{error['msg'][1:]}, got {content!r:.80}"

    text = str(error["ctx"]["error"])
    if not keys or text.startswith(keys[0]):
        return text
    return f"{name}: {text}"
