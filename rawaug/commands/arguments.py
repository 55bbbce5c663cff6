"""A command's arguments from the signature of its function: types, defaults and, from the docstring, help.

Parameters before the ``*`` are positional, a list takes one or more, one with a default may be left out; those after
it are options. A ``bool`` that is False by default is a flag. The fields of a dataclass are options themselves.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any, get_type_hints


def add_arguments(parser: Any, function: Callable[..., Any]) -> None:
    """Add the arguments of ``function`` to a parser of jsonargparse."""
    from docstring_parser import parse

    explained = {param.arg_name: param.description for param in parse(function.__doc__ or "").params}
    hints = get_type_hints(function)
    for name, parameter in inspect.signature(function).parameters.items():
        hint, default = hints[name], parameter.default
        about: dict[str, Any] = {"help": explained.get(name)}
        if is_dataclass(hint):
            parser.add_class_arguments(hint)
        elif parameter.kind is not parameter.KEYWORD_ONLY:
            several: dict[str, Any] = {"type": str, "nargs": "+"} if hint == list[str] else {"type": hint}
            optional = {} if default is parameter.empty else {"nargs": "?", "default": default}
            parser.add_argument(name, **several, **optional, **about)
        elif default is False:
            parser.add_argument(_flag(name), action="store_true", **about)
        elif default is parameter.empty:
            parser.add_argument(_flag(name), type=hint, required=True, **about)
        else:
            parser.add_argument(_flag(name), type=hint, default=default, **about)


def call(function: Callable[..., Any], values: dict[str, Any]) -> Any:
    """Call ``function`` with what its arguments were parsed to."""
    arguments: dict[str, Any] = {}
    for name, hint in get_type_hints(function).items():
        if is_dataclass(hint):
            settings: Callable[..., Any] = hint  # type: ignore[assignment]
            arguments[name] = settings(**{field.name: values[field.name] for field in fields(hint)})
        elif name in values:
            arguments[name] = values[name]
    return function(**arguments)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
