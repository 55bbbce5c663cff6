"""The subcommands of ``rawaug``, one file a command."""

from __future__ import annotations

import glob
import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from cyclopts import Parameter

from rawaug.files import require_output, yaml_value
from rawaug.registry import Spec

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

    if report is not None:  # its tables lie beside it
        for table in Path(report).parent.glob(f"{glob.escape(Path(report).stem)}_*"):
            if table.suffix in (".csv", ".tex"):
                require_output(table, overwrite, inputs=files)


def parse_value(text: str) -> Any:
    """Parse a word of the command line as YAML, in which ``demo:`` is a name and not a mapping."""
    value = yaml_value(text)
    if isinstance(value, dict) and not text.lstrip().startswith("{"):
        return text
    return value


YAML = Parameter(converter=lambda _, tokens: parse_value(tokens[0].value), n_tokens=1, json_list=False, metavar="VALUE")
"""One argument may be a name, a list as ``[1e-3, 1e-5]``, or ``{name: ..., settings: {...}}``."""


def network_or_filter(denoiser: str | None, classical: Spec | None, *of_networks: bool) -> Any:
    """Return what ``--denoiser`` or ``--classical`` names; ValueError if both do, or a filter has options of networks.

    ``of_networks`` tells whether options are set that only a network takes: the self-ensemble and ``--linear``.
    """
    if classical is None:
        return denoiser
    if denoiser is not None or any(of_networks):
        raise ValueError("classical=: a filter takes no denoiser=, self_ensemble= or linear=; give one or the other")
    return classical


_ARGUMENT = re.compile(r"""\b([a-z_]+)=(True\b|"[^"]*"|\([^)]*\)|[\w./:~-]*)""")


def as_options(text: str, arguments: Iterable[str]) -> str:
    """Write the arguments of Python that a message names as options of the command line.

    Args:
        text: a message, with arguments as ``noise="estimate"``, ``overwrite=True`` or ``linear=``.
        arguments: the names of the command's arguments; others are left as they are.

    Example:
        >>> as_options('pass noise="estimate" or noise=(a, b), and overwrite=True', ["noise", "overwrite"])
        "pass --noise estimate or --noise '[a, b]', and --overwrite"
    """
    names = set(arguments)

    def replace(match: re.Match[str]) -> str:
        name, value = match.groups()
        if name not in names:
            return match[0]

        option = f"--{name.replace('_', '-')}"
        if value in ("", "True"):
            return option
        if value.startswith("("):
            return f"{option} '[{value[1:-1]}]'"
        return f"{option} {shlex.quote(value.strip(chr(34)))}"

    return _ARGUMENT.sub(replace, text)
