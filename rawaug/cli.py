"""The command line: ``rawaug run | fit | evaluate | synth | denoise | preview | info | data``, by jsonargparse.

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
    kind = "training"
    if argv[:1] == ["run"] and len(argv) > 1 and not argv[1].startswith("-"):
        from rawaug.experiment.kinds import kind_of
        from rawaug.experiment.recipe import find_recipe

        recipe = find_recipe(argv[1])
        kind = kind_of(recipe)
        argv = ["run", "--recipe", str(recipe), *argv[2:]]
    parser = _parser(kind)
    if not argv:
        parser.print_help()
        return 0
    parsed = parser.parse_args(argv)
    command: str = parsed.command
    commands = {
        "fit": _fit,
        "evaluate": _evaluate,
        "synth": _synth,
        "denoise": _denoise,
        "preview": _preview,
        "info": _info,
        "data": _data,
    }
    if command == "run":
        _run(kind, parser.instantiate(parsed)[command])
    else:
        commands[command](parser.instantiate(parsed)[command])
    return 0


def _parser(kind: str) -> Any:
    from jsonargparse import ArgumentParser

    from rawaug.experiment.kinds import KINDS
    from rawaug.isp.fit import FitConfig

    def new(description: str) -> Any:
        return ArgumentParser(exit_on_error=False, description=description)

    run = new("Every stage of a recipe, resumable: rawaug run RECIPE.yaml [--key value ...]; writes runs/NAME/.")
    run.add_argument("--recipe", action="config", help="a YAML file, or the name of a recipe in the package")
    run.add_argument("--smoke", action="store_true", help="every stage in seconds on tiny built-in data")
    run.add_class_arguments(KINDS[kind].settings)

    fit = new("Fit a dictionary ISP to RAW files (and the camera's JPEGs of the same stems, where there are any).")
    fit.add_argument("data", type=str, nargs="+", help="folders of RAW files, files, or one kind:path")
    jpeg_help = "take the camera's JPEG of the same stem for the sRGB; false takes LibRaw's rendering always"
    fit.add_argument("--camera-jpeg", type=bool, default=True, help=jpeg_help)
    held_out_help = "frames that the fit does not see: their PSNR_r is shown while it runs"
    fit.add_argument("--held-out", type=str | None, default=None, help=held_out_help)
    fit.add_argument("--out", type=str, required=True, help="the .safetensors file to write")
    noise_help = "also measure the camera's noise, for noise: camera; auto goes on where the frames do not show it"
    fit.add_argument("--noise", type=Literal["auto", "on", "off"], default="auto", help=noise_help)
    fit.add_argument("--dark", type=str | None, default=None, help="folder of dark frames: they tell the read variance")
    fit.add_class_arguments(FitConfig)

    evaluate = new("PSNR and SSIM of an ISP or a denoiser; the file says which.")
    evaluate.add_argument("weights", type=str, help="a .safetensors file of rawaug fit or rawaug run")
    evaluate.add_argument("--data", type=str, required=True, help="folder of RAW files, one file, or kind:path")
    evaluate.add_argument("--self-ensemble", action="store_true", help="average a denoiser over eight views, besides")
    noise_help = "for frames without a noisy capture: a preset, a measured camera, or [shot_var, read_var]"
    evaluate.add_argument("--noise", type=tuple[float, float] | str | None, default=None, help=noise_help)
    evaluate.add_argument("--seed", type=int, default=0, help="of that noise")
    classical = "also score NonLocalMeans, Wavelet, TotalVariation or BM3D on the same noise"
    evaluate.add_argument("--classical", type=list[str], default=[], help=classical)
    evaluate.add_argument("--device", type=str, default="cpu", help="where a denoiser runs: cpu, cuda, ...")
    page_help = "also write a page with the scores and with crops of the frames of a denoiser to this HTML file"
    evaluate.add_argument("--report", type=str | None, default=None, help=page_help)
    evaluate.add_argument("--json", type=str | None, default=None, help="also write the result to this file")

    preview = new("Two figures: the stages and augmented RAWs of a picture, and the atoms of the dictionaries.")
    preview.add_argument("picture", type=str, help="an sRGB picture")
    preview.add_argument("--out", type=str, required=True, help="the PNG to write; the atoms go to NAME-atoms.png")
    preview.add_argument("--isp", type=str, default="universal", help="an ISP's file, or the name of a shipped one")
    preview.add_argument("--count", type=int, default=4, help="augmented RAWs to draw")
    preview.add_argument("--seed", type=int, default=0, help="of these")

    synth = new("RAW pairs on disk from a folder of sRGB pictures; stopped, the same command goes on from there.")
    _add_synth(synth)
    denoise = new("Denoise a RAW file, or a folder of them, to DNG; in a folder what is there is skipped.")
    _add_denoise(denoise)

    info = new("What is in a file of weights.")
    info.add_argument("weights", type=str, help="a .safetensors file, or the name of a shipped ISP")

    data = new("About data: rawaug data check PATH.")
    check = new("What is in a folder: which dataset, how many, sizes, patterns, levels, and what is broken.")
    check.add_argument("path", type=str, help="a folder, a RAW file, or a submission to SIDD")
    check.add_argument("--first", type=int | None, default=None, help="read only so many of each kind")

    parser = ArgumentParser(prog="rawaug", exit_on_error=False, version=__version__, description=__doc__)
    subcommands = parser.add_subcommands(dest="command")
    parsers = {"run": run, "fit": fit, "evaluate": evaluate, "synth": synth, "denoise": denoise}
    parsers |= {"preview": preview, "info": info, "data": data}
    for name, subparser in parsers.items():
        subcommands.add_subcommand(name, subparser, help=subparser.description)
    data.add_subcommands(dest="action").add_subcommand("check", check, help=check.description)  # the outer ones first
    return parser


def _add_synth(synth: Any) -> None:
    from rawaug.commands.pair_files import Format
    from rawaug.plugin.augment import Sampling

    synth.add_argument("pictures", type=str, help="folder of sRGB pictures")
    synth.add_argument("out", type=str, help="folder to write")
    synth.add_argument("--format", type=Format, default="dng", help="16-bit DNG, packed float32 NPZ or float32 TIFF")
    synth.add_argument("--per-image", type=int, default=1, help="pairs a picture")
    synth.add_argument("--isp", type=str, default="universal", help="an ISP's file, or the name of a shipped one")
    noise_help = "a preset, a measured camera, camera (as fitted), or [shot_var, read_var]"
    synth.add_argument("--noise", type=tuple[float, float] | str, default="cycleisp_sidd", help=noise_help)
    synth.add_argument("--sampling", type=Sampling, default="convex", help="how camera settings are drawn")
    synth.add_argument("--seed", type=int, default=0, help="of all draws")
    synth.add_argument("--workers", type=int | None, default=None, help="processes; as many as cores by default")


def _add_denoise(denoise: Any) -> None:
    denoise.add_argument("source", type=str, help="a RAW file, or a folder of them")
    denoise.add_argument("out", type=str, help="the DNG to write, or a folder")
    denoise.add_argument("--denoiser", type=str, required=True, help="a .safetensors file of rawaug run")
    noise_help = "auto (NoiseProfile, else estimate), profile, estimate, a measured camera, or [shot_var, read_var]"
    denoise.add_argument("--noise", type=tuple[float, float] | str, default="auto", help=noise_help)
    denoise.add_argument("--self-ensemble", action="store_true", help="average eight views: eight times the work")


def _run(kind: str, arguments: Any) -> None:
    from rawaug.experiment.kinds import KINDS

    experiment, settings = KINDS[kind], vars(arguments)
    settings.pop("recipe")
    quick = settings.pop("smoke")
    recipe = experiment.settings(**settings)
    experiment.run(experiment.smoke(recipe) if quick else recipe)


def _fit(arguments: Any) -> None:
    from rawaug.commands.fit import fit

    settings = vars(arguments)
    data, out = settings.pop("data"), settings.pop("out")
    _require_safetensors(out)
    figure = Path(out).with_name(f"{Path(out).stem}-noise.png")
    figure.parent.mkdir(parents=True, exist_ok=True)
    isp = fit(data, noise_figure=figure, state=f"{out}.state", **settings)
    isp.info["data"] = data
    isp.save(out)
    print(f"fitted {len(isp.info['frames'])} frames in {isp.info['seconds']} s: {out}")
    for score in isp.info.get("held_out", [])[-1:]:
        print(f"held out: {score['blind']:.2f} dB blind, {score['as_shot']:.2f} dB with the as-shot white balance")
    if "noise_not_measured" in isp.info:
        print(f"noise not measured: {isp.info['noise_not_measured']}")
    if "noise" in isp.info:
        noise = isp.info["noise"]
        levels = f"shot_var {noise['shot_var']:.3g}, read_var {noise['read_var']:.3g}"
        print(f"noise: {levels}, R^2 {noise['r2']:.3f}: {figure}")


def _evaluate(arguments: Any) -> None:
    from rawaug.evaluation.scores import evaluate, write_json
    from rawaug.evaluation.tables import print_scores

    a = arguments
    result = evaluate(a.weights, a.data, a.self_ensemble, a.noise, a.seed, a.classical, a.device, a.report)
    print_scores(result)
    if a.json:
        write_json(result, a.json)
    if a.report:
        print(f"page: {a.report}")


def _preview(arguments: Any) -> None:
    from rawaug.commands.preview import preview

    a = arguments
    for path in preview(a.picture, a.isp, a.out, a.count, a.seed):
        print(path)


def _synth(arguments: Any) -> None:
    from rawaug.commands.synth import print_synthesis, synth

    settings = vars(arguments)
    print_synthesis(synth(settings.pop("pictures"), settings.pop("out"), **settings))


def _denoise(arguments: Any) -> None:
    from rawaug.commands.denoise import DenoisedFolder, denoise_file, denoise_folder, print_denoised

    a = arguments
    if Path(a.source).is_dir():
        print_denoised(denoise_folder(a.source, a.out, a.denoiser, a.noise, a.self_ensemble))
    else:
        print_denoised(DenoisedFolder([denoise_file(a.source, a.out, a.denoiser, a.noise, a.self_ensemble)]))


def _info(arguments: Any) -> None:
    from rawaug.commands.info import describe

    print(describe(arguments.weights))


def _data(arguments: Any) -> None:
    from rawaug.data import check

    path, first = arguments.check.path, arguments.check.first
    report = check(path, first)
    print(report)
    if report.broken:
        raise ValueError(f"{path}: {len(report.broken)} broken, listed above")


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
