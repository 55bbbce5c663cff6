"""The subcommands of ``rawaug``, one file a command."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from cyclopts import Parameter

from rawaug.files import require_output, yaml_value

OPTIONS = Parameter(name="*")
"""The fields of a dataclass become options of their own."""


def require_results(json: str | None, report: str | None, overwrite: bool, inputs: Iterable[str] = ()) -> None:
    """Refuse, before any work, files of ``--json`` and ``--report`` that would replace something, or another ending."""
    files = list(inputs)
    for option, path, extensions in (("json", json, (".json",)), ("report", report, (".html", ".htm"))):
        if path == "":
            raise ValueError(f"--{option}: needs the name of a file")
        if path is not None:
            require_output(path, overwrite, extensions, files)


def value_of(text: str) -> Any:
    """Parse a word of the command line as YAML, in which ``demo:`` is a name and not a mapping."""
    value = yaml_value(text)
    if isinstance(value, dict) and not text.lstrip().startswith("{"):
        return text
    return value


YAML = Parameter(converter=lambda _, tokens: value_of(tokens[0].value), n_tokens=1, json_list=False, metavar="VALUE")
"""One argument may be a name, a list as ``[1e-3, 1e-5]``, or ``{name: ..., settings: {...}}``."""
