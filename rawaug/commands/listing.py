"""Commands by name with a line on each, found without importing them: ``rawaug --help`` needs no PyTorch.

A module of this package registers a command by ``@COMMANDS.register("name")`` above a function; name and docstring are
read from its source.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from rawaug.registry import COMMANDS


def listed() -> dict[str, str]:
    """Every command with the first line of its docstring; of another package's the place of its function."""
    built_in = {name: summary for name, _, summary in _in_source()}
    return dict(sorted({**COMMANDS.known(), **built_in}.items()))


def command(name: str) -> Callable[..., Any]:
    """The function behind ``rawaug NAME``; of this package the module that registers it is imported, and no other."""
    for known, module, _ in _in_source():
        if known == name:
            import_module(f"{__package__}.{module}")
    function: Callable[..., Any] = COMMANDS[name]
    return function


@cache
def _in_source() -> tuple[tuple[str, str, str], ...]:
    """Name, module and summary of each command of this package, by file."""
    return tuple(_registered())


def _registered() -> Iterator[tuple[str, str, str]]:
    for file in sorted(Path(__file__).parent.glob("*.py")):
        body = ast.parse(file.read_text(encoding="utf-8")).body
        for function in (statement for statement in body if isinstance(statement, ast.FunctionDef)):
            for mark in function.decorator_list:
                match mark:
                    case ast.Call(func=ast.Attribute(value=ast.Name(id="COMMANDS")), args=[ast.Constant(value=name)]):
                        summary = (ast.get_docstring(function) or "").partition("\n")[0]
                        yield str(name), file.stem, summary
