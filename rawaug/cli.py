"""Train and evaluate RAW denoisers and camera ISPs.

Errors are one line on stderr that names the file or key and what to do; the exit status is then 2.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from typing import Any

from rawaug._version import __version__
from rawaug.extras import MissingExtra

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    from jsonargparse import ArgumentError

    argv = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(argv)
    except BrokenPipeError:  # the reader has closed the pipe, as with `| head`
        return 0
    except (ValueError, OSError, ArgumentError, MissingExtra) as error:
        print(f"rawaug: {_one_line(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("rawaug: stopped; run the same command again to resume", file=sys.stderr)
        return 130


def _dispatch(argv: list[str]) -> int:
    from rawaug.commands.arguments import call
    from rawaug.experiment.kinds import kind_of
    from rawaug.experiment.recipe import find_recipe
    from rawaug.registry import COMMANDS

    kind = "training"
    if argv[:1] == ["run"] and len(argv) > 1 and not argv[1].startswith("-"):
        recipe = find_recipe(argv[1])
        kind = kind_of(recipe)
        argv = ["run", "--recipe", str(recipe), *argv[2:]]
    parser = _parser(kind)
    if not argv:
        parser.print_help()
        return 0
    parsed = parser.parse_args(argv)
    command: str = parsed.command
    arguments = parser.instantiate(parsed)[command]
    if command == "run":
        _run(kind, arguments)
    else:
        name, values = command, vars(arguments)
        if "action" in values:  # a command of two words
            name, values = f"{command} {values['action']}", vars(values[values["action"]])
        call(COMMANDS[name], values)
    return 0


def _parser(kind: str) -> Any:
    from jsonargparse import ArgumentParser

    from rawaug.commands.arguments import add_arguments, summary
    from rawaug.experiment.kinds import KINDS
    from rawaug.registry import COMMANDS

    def new(description: str) -> Any:
        return ArgumentParser(exit_on_error=False, description=description)

    run = new("Run a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.")
    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a shipped recipe")
    run.add_argument("--smoke", action="store_true", help="run every stage in seconds on tiny built-in data")
    run.add_argument("--overwrite", action="store_true", help="replace a run of this name with other settings")
    run.add_class_arguments(KINDS[kind].settings)
    parser = ArgumentParser(prog="rawaug", exit_on_error=False, version=__version__, description=__doc__)
    subcommands = parser.add_subcommands(dest="command")
    subcommands.add_subcommand("run", run, help=run.description)
    groups: dict[str, Any] = {}
    for name, function in COMMANDS.items():
        group, _, action = name.partition(" ")
        command = new(summary(function))
        add_arguments(command, function)
        if not action:
            subcommands.add_subcommand(name, command, help=command.description)
            continue
        if group not in groups:
            above = new(f"Commands about {group}.")
            subcommands.add_subcommand(group, above, help=above.description)  # the outer one first
            groups[group] = above.add_subcommands(dest="action")
        groups[group].add_subcommand(action, command, help=command.description)
    return parser


def _run(kind: str, arguments: Any) -> None:
    from rawaug.experiment.kinds import KINDS

    experiment, settings = KINDS[kind], vars(arguments)
    settings.pop("recipe")
    quick, overwrite = settings.pop("smoke"), settings.pop("overwrite")
    recipe = experiment.settings(**settings)
    experiment.run(experiment.smoke(recipe) if quick else recipe, overwrite)


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
