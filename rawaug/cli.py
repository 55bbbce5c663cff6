"""Train and evaluate RAW denoisers and camera ISPs.

Errors are one line on stderr that names the file or key and what to do; the exit status is then 2.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rawaug._version import __version__
from rawaug.extras import MissingExtra
from rawaug.printable import printable

BAD_INPUT = 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    from jsonargparse import ArgumentError

    argv = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files need not fit the terminal's encoding
            stream.reconfigure(errors="backslashreplace")
    try:
        return _dispatch(argv)
    except BrokenPipeError:  # the reader has closed the pipe, as with `| head`
        return 0
    except (ValueError, OSError, ArgumentError, MissingExtra) as error:
        print(f"rawaug: {printable(_one_line(error))}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("rawaug: stopped; run the same command again to resume", file=sys.stderr)
        return 130


def _dispatch(argv: list[str]) -> int:
    from rawaug.commands.arguments import call
    from rawaug.experiment.kinds import kind_of
    from rawaug.experiment.recipe import find_recipe, recipe_list
    from rawaug.registry import COMMANDS

    if argv == ["run"]:
        print(f"rawaug run RECIPE [--key value ...], where RECIPE is a YAML file or one of\n\n{recipe_list()}\n")
        print("rawaug run RECIPE --help explains its keys; --dry-run tries it on your data.")
        return 0
    kind, shown = "training", None
    if argv[:2] == ["run", "--recipe"]:
        argv = ["run", *argv[2:]]
    if argv[:1] == ["run"] and len(argv) > 1 and not argv[1].startswith("-"):
        recipe = find_recipe(argv[1])
        kind = kind_of(recipe)
        shown = recipe if {"-h", "--help"} & set(argv) else None
        argv = ["run", "--recipe", str(recipe), *argv[2:]]
    parser = _parser(kind, shown)
    if not argv:
        parser.print_help()
        return 0
    parsed = parser.parse_args(argv)
    command: str = parsed.command
    arguments = parser.instantiate(parsed)[command]
    if command == "run":
        _run(kind, arguments, {word.partition("=")[0].removeprefix("--") for word in argv if word.startswith("--")})
    else:
        name, values = command, vars(arguments)
        if "action" in values:  # a command of two words
            name, values = f"{command} {values['action']}", vars(values[values["action"]])
        call(COMMANDS[name], values)
    return 0


def _parser(kind: str, recipe: Path | None = None) -> Any:
    """The parser of every command; ``run`` takes the keys of ``kind``, in whose help stand the values of ``recipe``."""
    from jsonargparse import ArgumentParser

    from rawaug.commands.arguments import add_arguments, summary
    from rawaug.experiment.kinds import KINDS
    from rawaug.experiment.recipe import defaults_of
    from rawaug.registry import COMMANDS

    def new(description: str) -> Any:
        return ArgumentParser(exit_on_error=False, description=description)

    run = new("Run a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.")
    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a shipped recipe")
    run.add_argument("--smoke", action="store_true", help="run every stage in seconds on tiny built-in data")
    run.add_argument("--dry-run", action="store_true", help="only say what is used of what, and try it in seconds")
    run.add_class_arguments(KINDS[kind].settings)
    if recipe is not None:
        run.set_defaults(defaults_of(recipe, KINDS[kind].settings))
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


def _run(kind: str, arguments: Any, given: set[str]) -> None:
    from rawaug.experiment.kinds import KINDS
    from rawaug.experiment.plan import with_own_pairs
    from rawaug.experiment.recipe import Recipe

    experiment, settings = KINDS[kind], vars(arguments)
    file = settings.pop("recipe")
    quick, dry = settings.pop("smoke"), settings.pop("dry_run")
    recipe = experiment.settings(**settings)
    if isinstance(recipe, Recipe) and file:
        recipe = with_own_pairs(recipe, str(file[0]), given)
    recipe = experiment.smoke(recipe) if quick else recipe
    if not dry:
        experiment.run(recipe)
    elif experiment.dry_run is None:
        raise ValueError(f"--dry-run: an experiment of the kind {kind} has none; use --smoke")
    else:
        experiment.dry_run(recipe)


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
