"""Train and evaluate RAW denoisers and camera ISPs.

Errors are one line on stderr that names the file or key and what to do; the exit status is then 2.
"""

from __future__ import annotations

import io
import json
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rawaug._version import __version__
from rawaug.errors import MissingExtra, printable, shortage, without_traceback

BAD_INPUT = 2
OWN = {
    "run": "Run a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.",
    "completion": "Print a script that completes commands and options in a shell.",
}
"""Commands that need the parser itself, beside those of ``rawaug.commands``."""
SHELLS = ("bash", "zsh", "fish")
WHOLE_FRAMES = ("denoise", "evaluate")
"""Commands that put whole frames through a network. They take memory in huge pages, where Linux has them: a third of
their time went into page faults. PyTorch reads the variable when it first takes memory."""


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
    except (RuntimeError, MemoryError) as error:
        if (reason := shortage(error)) is None:
            raise
        print(f"rawaug: {reason}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("rawaug: stopped; run the same command again to resume", file=sys.stderr)
        return 130


def _dispatch(argv: list[str]) -> int:
    from rawaug.commands.arguments import call
    from rawaug.commands.listing import command, listed
    from rawaug.commands.parser_errors import require_known_command
    from rawaug.commands.spelling import given_keys, require_known_options
    from rawaug.progress import quiet

    if argv == ["run"]:
        from rawaug.experiment.recipe import recipe_list

        print(f"rawaug run RECIPE [--key value ...], where RECIPE is a YAML file or one of\n\n{recipe_list()}\n")
        print("rawaug run RECIPE --help explains its keys; --dry-run rehearses it on your data.")
        return 0
    argv, kind, recipe = _recipe_of(argv)
    names = [*OWN, *listed()]
    require_known_command(argv, names)
    chosen = next((name for name in names if argv[: len(name.split())] == name.split()), None)
    if chosen in WHOLE_FRAMES:
        os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    parser, leaves = _parser(kind, names if chosen == "completion" else [chosen])
    if not argv:
        parser.print_help()
        return 0
    if chosen is not None:
        require_known_options(chosen, leaves[chosen], argv)
    if recipe is not None:
        _require_known_keys(recipe, kind, leaves["run"], helps=bool({"-h", "--help"} & set(argv)))
    parsed = _parsed(parser, argv, chosen, leaves.get(str(chosen)))
    if chosen == "run":
        from rawaug.experiment.kinds import settings_of
        from rawaug.experiment.recipe import require_values

        require_values(settings_of(kind), parsed.run.as_dict())
    values = vars(parser.instantiate(parsed)[parsed.command])
    values = vars(values[values["action"]]) if "action" in values else values  # a command of two words
    with quiet(values["quiet"]):
        if chosen == "run":
            _run(kind, values, given_keys(argv))
        elif chosen == "completion":
            print(parser.get_completion_script(f"shtab-{values['shell']}"))
        else:
            call(command(str(chosen)), values)
    return 0


def _parsed(parser: Any, argv: list[str], chosen: str | None, leaf: Any) -> Any:
    """The arguments as the parser of the chosen command takes them; errors in plain words."""
    from jsonargparse import ArgumentError

    from rawaug.commands.parser_errors import in_plain_words

    try:
        return parser.parse_args(argv)
    except ArgumentError as error:
        raise ValueError(in_plain_words(_one_line(error), chosen, leaf)) from None


def _recipe_of(argv: list[str]) -> tuple[list[str], str, Path | None]:
    """The arguments with the recipe's path in place of its name, its kind and its path; of ``run`` alone."""
    if argv[:2] == ["run", "--recipe"]:
        argv = ["run", *argv[2:]]
    if argv[:1] != ["run"] or len(argv) < 2 or argv[1].startswith("-"):
        return argv, "training", None
    from rawaug.experiment.recipe import find_recipe, kind_of, read_recipe

    recipe = find_recipe(argv[1])
    return ["run", "--recipe", str(recipe), *argv[2:]], kind_of(read_recipe(recipe), recipe), recipe


def _require_known_keys(recipe: Path, kind: str, run: Any, helps: bool) -> None:
    """Refuse a recipe with a key that its kind does not have; the help shows the values of the recipe."""
    from rawaug.commands.spelling import require_known_keys
    from rawaug.experiment.kinds import settings_of
    from rawaug.experiment.recipe import defaults_of, read_recipe, require_values

    content = read_recipe(recipe)
    require_known_keys(recipe, content, run)
    require_values(settings_of(kind), content)
    if helps:
        run.set_defaults(defaults_of(recipe, settings_of(kind)))


def _parser(kind: str, wanted: Sequence[str | None]) -> tuple[Any, dict[str, Any]]:
    """The parser of every command, and by name those of the ``wanted`` ones, which alone have their arguments."""
    from jsonargparse import ArgumentParser

    from rawaug.commands.arguments import add_arguments
    from rawaug.commands.listing import command, listed
    from rawaug.commands.spelling import spell_with_hyphens

    def new(description: str, **settings: Any) -> Any:
        return ArgumentParser(exit_on_error=False, allow_abbrev=False, description=description, **settings)

    parser = new(str(__doc__), prog="rawaug", version=__version__)
    subcommands = parser.add_subcommands(dest="command")
    leaves: dict[str, Any] = {}
    groups: dict[str, Any] = {}
    for name, about in {**OWN, **listed()}.items():
        group, _, action = name.partition(" ")
        leaves[name] = new(about)
        if not action:
            subcommands.add_subcommand(name, leaves[name], help=about)
            continue
        if group not in groups:
            above = new(f"Commands about {group}.")
            subcommands.add_subcommand(group, above, help=above.description)  # the outer one first
            groups[group] = above.add_subcommands(dest="action")
        groups[group].add_subcommand(action, leaves[name], help=about)
    for name, leaf in leaves.items():
        if name in wanted:
            if name == "run":
                _add_run_arguments(leaf, kind)
            elif name == "completion":
                leaf.add_argument("shell", choices=SHELLS)
            else:
                add_arguments(leaf, command(name))
        if "--quiet" not in leaf._option_string_actions:  # a command may have its own
            leaf.add_argument("--quiet", action="store_true", help="do not print progress")
        spell_with_hyphens(leaf)
    return parser, leaves


def _add_run_arguments(run: Any, kind: str) -> None:
    from rawaug.experiment.kinds import settings_of

    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a shipped recipe")
    run.add_argument("--dry-run", action="store_true", help="try every stage once on the run's data, write nothing")
    run.add_argument("--overwrite", action="store_true", help="replace a run of this name with other settings")
    run.add_class_arguments(settings_of(kind))


def _run(kind: str, settings: dict[str, Any], given: set[str]) -> None:
    from rawaug.experiment.kinds import dry_run, settings_of
    from rawaug.experiment.plan import with_own_pairs
    from rawaug.experiment.recipe import Recipe, read_recipe
    from rawaug.registry import EXPERIMENTS

    file, _ = settings.pop("recipe"), settings.pop("quiet")
    dry, overwrite = (settings.pop(flag) for flag in ("dry_run", "overwrite"))
    recipe = settings_of(kind)(**settings)
    if isinstance(recipe, Recipe) and file:
        recipe = with_own_pairs(recipe, read_recipe(str(file[0])), given)
    if dry:
        dry_run(kind, recipe, overwrite)
    else:
        EXPERIMENTS[kind](recipe, overwrite)


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    text = re.sub(r"<class '([\w.]+)'>", r"\1", " ".join(without_traceback(str(error)).split()))
    return re.sub(r'^Parser key "([^"]+)"', r"\1", text)


if __name__ == "__main__":
    sys.exit(main())
