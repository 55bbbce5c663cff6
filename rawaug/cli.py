"""The command line: ``rawaug run | fit | evaluate | synth | denoise | export | preview | info | data`` (jsonargparse).

Bad input ends in one line on stderr that names the file or key and what to do, with exit status 2.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from rawaug._version import __version__

BAD_INPUT = 2

COMMANDS = {
    "fit": "Fit a dictionary ISP to RAW files (and the camera's JPEGs of the same stems, where there are any).",
    "evaluate": "PSNR and SSIM of an ISP or a denoiser; the file says which.",
    "synth": "RAW pairs on disk from a folder of sRGB pictures; stopped, the same command goes on from there.",
    "denoise": "Denoise a RAW file, or a folder of them, to DNG; in a folder what is there is skipped.",
    "export": "A denoiser as an ONNX file, compared with PyTorch.",
    "preview": "Two figures: the stages and augmented RAWs of a picture, and the atoms of the dictionaries.",
    "info": "What is in a file of weights.",
}
"""By name, what each does; its module, with ``add_arguments`` and ``run``, is loaded when the parser is made, for a
worker process of a command loads this module too."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit status."""
    from jsonargparse import ArgumentError

    argv = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return _dispatch(argv)
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        return 0
    except (ValueError, OSError, ArgumentError) as error:
        print(f"rawaug: {_one_line(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("rawaug: stopped; the same command goes on from here", file=sys.stderr)
        return 130


def _dispatch(argv: list[str]) -> int:
    from rawaug.experiment.kinds import kind_of
    from rawaug.experiment.recipe import find_recipe

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
    elif command == "data":
        _module("check_data").run(arguments.check)
    else:
        _module(command).run(arguments)
    return 0


def _parser(kind: str) -> Any:
    from jsonargparse import ArgumentParser

    from rawaug.experiment.kinds import KINDS

    def new(description: str) -> Any:
        return ArgumentParser(exit_on_error=False, description=description)

    run = new("Every stage of a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.")
    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a recipe in the package")
    run.add_argument("--smoke", action="store_true", help="every stage in seconds on tiny built-in data")
    run.add_class_arguments(KINDS[kind].settings)
    parsers = {"run": run}
    for name, description in COMMANDS.items():
        parsers[name] = new(description)
        _module(name).add_arguments(parsers[name])
    data = parsers["data"] = new("About data: rawaug data check PATH.")
    check = new("What is in a folder: which dataset, how many, sizes, patterns, levels, and what is broken.")
    _module("check_data").add_arguments(check)

    parser = ArgumentParser(prog="rawaug", exit_on_error=False, version=__version__, description=__doc__)
    subcommands = parser.add_subcommands(dest="command")
    for name, subparser in parsers.items():
        subcommands.add_subcommand(name, subparser, help=subparser.description)
    data.add_subcommands(dest="action").add_subcommand("check", check, help=check.description)  # the outer ones first
    return parser


def _module(command: str) -> Any:
    return import_module(f"rawaug.commands.{command}")


def _run(kind: str, arguments: Any) -> None:
    from rawaug.experiment.kinds import KINDS

    experiment, settings = KINDS[kind], vars(arguments)
    settings.pop("recipe")
    quick = settings.pop("smoke")
    recipe = experiment.settings(**settings)
    experiment.run(experiment.smoke(recipe) if quick else recipe)


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
