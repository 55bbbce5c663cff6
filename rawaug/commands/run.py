"""``rawaug run``: a recipe's file with the keys of the command line in it, as the settings of its experiment."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

from cyclopts import Parameter
from docstring_parser import parse
from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from rawaug.commands import value_of
from rawaug.experiment import plan
from rawaug.experiment.plan import settings_of, use_all_pairs
from rawaug.experiment.recipe import EXPERIMENTS, Recipe, find_recipe, kind_of, read_recipe, recipe_list
from rawaug.registry import suggest

SHARED = ("channels", "variance_map", "deviation", "domain")
"""Settings that all networks have: they say what a recipe's network is for."""


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
    kind = kind_of(content, file)
    if keys:
        print_keys(settings_of(kind), content)
        return
    given = [_in_full(key, value) for key, value in _given(changes)]
    whole = _without_old_settings(content, given)
    for key, value in given:
        if key == "arms" and isinstance(value, (str, list)):
            whole["arms"] = keep_arms(whole.get("arms") or {}, value)
            continue
        whole = _with(whole, settings_of(kind), key.split("."), value)
    settings = with_values(settings_of(kind), whole, file)
    if isinstance(settings, Recipe):
        settings = use_all_pairs(settings, content, {key.replace("-", "_") for key, _ in given})
    if dry_run:
        plan.dry_run(kind, settings, overwrite)
    else:
        EXPERIMENTS[kind](settings, overwrite)


def keep_arms(arms: Mapping[str, Any], names: str | Sequence[str]) -> dict[str, Any]:
    """The arms of a recipe that ``--arms NAME`` or ``--arms '[NAME, NAME]'`` keeps, in the recipe's order.

    Raises:
        ValueError: if a name is none of the recipe's arms.
    """
    wanted = [names] if isinstance(names, str) else list(names)
    for name in wanted:
        if name not in arms:
            raise ValueError(f"arms: {name} is none of {', '.join(arms)}{suggest(name, arms)}")

    return {name: arm for name, arm in arms.items() if name in wanted}


def with_values(settings: type[Any], content: Mapping[str, Any], source: object) -> Any:
    """An instance of the dataclass ``settings`` with the values of ``content``, which its types decide on."""
    content = {key: value for key, value in content.items() if key != "experiment" or key in get_type_hints(settings)}
    try:
        _require_known(settings, content, [key.name for key in keys_of(settings)])
        return TypeAdapter(settings).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{source}: {_reason(first, content)}") from None
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


class Key(NamedTuple):
    """A key of a recipe: its dotted name, what it is where the recipe does not set it, and what it means."""

    name: str
    default: Any
    meaning: str


def keys_of(settings: type[Any], above: str = "") -> Iterator[Key]:
    """The keys of a dataclass and of those in it, as their docstrings explain them."""
    hints = get_type_hints(settings)
    documented = (parse(base.__doc__ or "").params for base in reversed(settings.__mro__))
    meanings = {part.arg_name: part.description or "" for params in documented for part in params}
    for field in fields(settings):
        part, named = _part(hints[field.name])
        name = f"{above}{field.name}"
        if part is None or named:
            default = field.default if field.default_factory is MISSING else field.default_factory()
            among = field.metadata.get("registry", ())
            listed = f" One of {', '.join(among)}." if among else ""
            yield Key(name, default, meanings.get(field.name, "") + listed)
        if part is not None:
            yield from keys_of(part, f"{name}.NAME." if named else f"{name}.")


def print_keys(settings: type[Any], content: Mapping[str, Any]) -> None:
    """The keys of a recipe by section, each with its value in ``content``."""
    console = Console(soft_wrap=False)
    sections: dict[str, list[Key]] = {}
    for key in keys_of(settings):
        sections.setdefault(key.name.rpartition(".")[0], []).append(key)
    for section, keys in sections.items():
        console.print(Text(f"{section or 'recipe'}:", style="bold"))
        table = Table.grid(padding=(0, 2))
        for key in keys:
            value: Any = content
            for name in key.name.split("."):
                value = value.get(name, key.default) if isinstance(value, Mapping) else key.default
            shown = "" if value is MISSING else json.dumps(value)
            shown = "by NAME, below" if key.name == "arms" else shown
            option = f"--{key.name.replace('_', '-')}"
            meaning = re.sub(r"(:\w+:)?`+([^`]*)`+", r"\2", " ".join(key.meaning.split()))  # without markup
            table.add_row(Text(option, style="cyan"), Text(meaning), Text(shown))
        console.print(Padding(table, (0, 0, 1, 2)))


def _given(words: Sequence[str]) -> Iterator[tuple[str, Any]]:
    rest = iter(words)
    for word in rest:
        key, equals, value = word.partition("=")
        if not key.startswith("--"):
            raise ValueError(f"{word}: too many arguments; keys of the recipe are set by --key value")
        found = value if equals else next(rest, None)
        if found is None:
            raise ValueError(f"{key} needs a value")
        yield key.removeprefix("--"), value_of(found)


def _in_full(key: str, value: Any) -> tuple[str, Any]:
    """``--denoiser DnCNN`` is short for ``--denoiser.name DnCNN``."""
    return (f"{key}.name", value) if key.split(".")[-1] == "denoiser" and isinstance(value, str) else (key, value)


def _without_old_settings(content: Mapping[str, Any], given: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """The recipe without the settings of a network in whose place another is named; what all networks have stays."""
    result = deepcopy(dict(content))
    for key, name in given:
        path = key.split(".")
        if path[-2:] != ["denoiser", "name"]:
            continue
        place: Any = result
        for part in path[:-1]:
            place = place.get(part) if isinstance(place, Mapping) else None
        if not isinstance(place, dict) or not place.get("settings") or place.get("name", "UNet") == name:
            continue
        kept = {setting: value for setting, value in place["settings"].items() if setting in SHARED}
        dropped = {setting: value for setting, value in place["settings"].items() if setting not in SHARED}
        place["settings"] = kept
        if dropped:
            of = place.get("name", "UNet")
            said = f"{'.'.join(path[:-1])}: the settings of {of} are dropped for {name}'s own: {json.dumps(dropped)}"
            print(f"{said}; others: --{'.'.join(path[:-1])}.settings.KEY VALUE")
    return result


def _with(content: Any, settings: type[Any] | None, path: Sequence[str], value: Any) -> Any:
    """``content`` with a value at a dotted path; fields of a dataclass may be spelt with hyphens."""
    if not path:
        return value
    hints = get_type_hints(settings) if settings else {}
    key = path[0].replace("-", "_") if path[0].replace("-", "_") in hints else path[0]
    part, named = _part(hints.get(key))
    before = dict(content) if isinstance(content, Mapping) else {}
    if named and len(path) > 1:
        below = before.get(key) or {}
        return before | {key: below | {path[1]: _with(below.get(path[1]), part, path[2:], value)}}
    return before | {key: _with(before.get(key), part, path[1:], value)}


def _part(hint: Any) -> tuple[type[Any] | None, bool]:
    """The dataclass that a key's value is, and whether there are several of it, by name."""
    for inside in (hint, *get_args(hint)):
        if is_dataclass(inside):
            return inside, getattr(hint, "__origin__", None) is dict  # type: ignore[return-value]
    return None, False


def _require_known(settings: type[Any], content: Any, known: Sequence[str], above: str = "") -> None:
    hints = get_type_hints(settings)
    for key, value in content.items():
        if key not in hints:
            raise ValueError(f"{above}{key}: no such key{suggest(f'{above}{key}', known)}")
        part, named = _part(hints[key])
        parts = value.items() if named and isinstance(value, Mapping) else [("", value)]
        for name, one in parts if part else ():
            if isinstance(one, Mapping):
                _require_known(part, one, known, f"{above}{key}.{name}{'.' if name else ''}")  # type: ignore[arg-type]


def _reason(error: Any, content: Any) -> str:
    """One error of pydantic in a line; its location goes on into the types of a union, which are no keys."""
    keys = []
    for key in error["loc"]:
        if not isinstance(content, Mapping) or key not in content:
            break
        keys.append(key)
        content = content[key]
    name = ".".join(map(str, keys))
    if error["type"] == "value_error":
        text = str(error["ctx"]["error"])
        return text if not keys or text.startswith(str(keys[0])) else f"{name}: {text}"
    return f"{name}: {error['msg'][0].lower()}{error['msg'][1:]}, got {content!r:.80}"
