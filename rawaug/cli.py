"""The command line: ``rawaug run | fit | evaluate | preview | info``, by jsonargparse on the dataclasses of recipes.

Bad input ends in one line on stderr that names the file or key and what to do, with exit status 2.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from rawaug._version import __version__

BAD_INPUT = 2


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
    parser = _parser()
    if argv[:1] == ["run"] and len(argv) > 1 and not argv[1].startswith("-"):
        from rawaug.experiment.recipe import find_recipe

        argv = ["run", "--recipe", str(find_recipe(argv[1])), *argv[2:]]
    if not argv:
        parser.print_help()
        return 0
    parsed = parser.parse_args(argv)
    command: str = parsed.command
    commands = {"run": _run, "fit": _fit, "evaluate": _evaluate, "preview": _preview, "info": _info}
    commands[command](parser.instantiate(parsed)[command])
    return 0


def _parser() -> Any:
    from jsonargparse import ArgumentParser

    from rawaug.experiment.recipe import Recipe
    from rawaug.isp.fit import FitConfig

    def new(description: str) -> Any:
        return ArgumentParser(exit_on_error=False, description=description)

    run = new("Every stage of a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.")
    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a recipe in the package")
    run.add_class_arguments(Recipe)

    fit = new("Fit a dictionary ISP to RAW files (and the camera's JPEGs of the same stems, where there are any).")
    fit.add_argument("data", type=str, help="folder of RAW files, one file, or kind:path")
    fit.add_argument("--out", type=str, required=True, help="the .safetensors file to write")
    noise_help = "also measure the camera's noise, for noise: camera; auto goes on where the frames do not show it"
    fit.add_argument("--noise", type=Literal["auto", "on", "off"], default="auto", help=noise_help)
    fit.add_argument("--dark", type=str | None, default=None, help="folder of dark frames: they tell the read variance")
    fit.add_class_arguments(FitConfig)

    evaluate = new("PSNR and SSIM of an ISP or a denoiser; the file says which.")
    evaluate.add_argument("weights", type=str, help="a .safetensors file of rawaug fit or rawaug run")
    evaluate.add_argument("--data", type=str, required=True, help="folder of RAW files, one file, or kind:path")
    evaluate.add_argument("--self-ensemble", action="store_true", help="average a denoiser over eight views")
    evaluate.add_argument("--noise", type=str | None, default=None, help="preset for frames without a noisy capture")
    evaluate.add_argument("--seed", type=int, default=0, help="of that noise")
    evaluate.add_argument("--json", type=str | None, default=None, help="also write the result to this file")

    preview = new("Two figures: the stages and augmented RAWs of a picture, and the atoms of the dictionaries.")
    preview.add_argument("picture", type=str, help="an sRGB picture")
    preview.add_argument("--out", type=str, required=True, help="the PNG to write; the atoms go to NAME-atoms.png")
    preview.add_argument("--isp", type=str, default="universal", help="an ISP's file, or the name of a shipped one")
    preview.add_argument("--count", type=int, default=4, help="augmented RAWs to draw")
    preview.add_argument("--seed", type=int, default=0, help="of these")

    info = new("What is in a file of weights.")
    info.add_argument("weights", type=str, help="a .safetensors file, or the name of a shipped ISP")

    parser = ArgumentParser(prog="rawaug", exit_on_error=False, version=__version__, description=__doc__)
    subcommands = parser.add_subcommands(dest="command")
    parsers = {"run": run, "fit": fit, "evaluate": evaluate, "preview": preview, "info": info}
    for name, subparser in parsers.items():
        subcommands.add_subcommand(name, subparser, help=subparser.description)
    return parser


def _run(arguments: Any) -> None:
    from rawaug.experiment.recipe import Recipe
    from rawaug.experiment.run import run

    settings = vars(arguments)
    settings.pop("recipe")
    run(Recipe(**settings))


def _fit(arguments: Any) -> None:
    from rawaug.experiment.fitting import fit

    settings = vars(arguments)
    data, out = settings.pop("data"), settings.pop("out")
    _require_safetensors(out)
    figure = Path(out).with_name(f"{Path(out).stem}-noise.png")
    figure.parent.mkdir(parents=True, exist_ok=True)
    isp = fit(data, noise_figure=figure, **settings)
    isp.info["data"] = data
    isp.save(out)
    print(f"fitted {len(isp.info['frames'])} frames in {isp.info['seconds']} s: {out}")
    if "noise_not_measured" in isp.info:
        print(f"noise not measured: {isp.info['noise_not_measured']}")
    if "noise" in isp.info:
        noise = isp.info["noise"]
        levels = f"shot_var {noise['shot_var']:.3g}, read_var {noise['read_var']:.3g}"
        print(f"noise: {levels}, R^2 {noise['r2']:.3f}: {figure}")


def _evaluate(arguments: Any) -> None:
    from rawaug.experiment.evaluate import evaluate, write_json
    from rawaug.experiment.report import print_scores

    result = evaluate(arguments.weights, arguments.data, arguments.self_ensemble, arguments.noise, arguments.seed)
    print_scores(result)
    if arguments.json:
        write_json(result, arguments.json)


def _preview(arguments: Any) -> None:
    from rawaug.experiment.preview import preview

    a = arguments
    for path in preview(a.picture, a.isp, a.out, a.count, a.seed):
        print(path)


def _info(arguments: Any) -> None:
    from rawaug.experiment.info import describe

    print(describe(arguments.weights))


def _require_safetensors(path: str) -> None:
    if Path(path).suffix != ".safetensors":
        raise ValueError(f"--out {path}: the file must end in .safetensors")


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
