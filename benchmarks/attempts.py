"""What a worker of benchmarks/fuzz.py does: read a file by every reader of its kind, and say what became of it.

On request the commands read it too, as a user would type them: status 0, or status 2 and one line on stderr.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shutil
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path


def readers(kind: str, path: Path) -> list[Callable[[], object]]:
    """Every reader in the package for this kind of file."""
    import torch

    import denoisers
    from rawaug import DictionaryISP
    from rawaug.commands.info import describe
    from rawaug.data.mat import read_value
    from rawaug.data.published import read_packed
    from rawaug.data.sidd.frames import colour_of, mosaic_of
    from rawaug.io import RawFrame, read_picture, read_raw, read_raw_and_develop, write_dng
    from rawaug.plugin.params import load_params

    def frame_of() -> RawFrame:
        frame = read_raw(path)
        numbers = [*frame.white_balance, *frame.daylight, *(frame.noise_profile or ()), frame.white, *frame.black]
        for tensor in (frame.mosaic, frame.color_matrix, frame.shading_gains, torch.tensor(numbers)):
            if not tensor.isfinite().all():
                raise ArithmeticError(f"not finite: {tensor.flatten()[:20].tolist()}")
        return frame

    def isp_of(path: Path) -> None:
        raw = DictionaryISP.from_pretrained(path).reverse(torch.linspace(0, 1, 192).reshape(1, 3, 8, 8)).raw
        if not raw.isfinite().all():
            raise ArithmeticError("not finite: RAW of this ISP")

    def rewritten() -> None:
        frame = frame_of()
        write_dng(path.with_name(f"{path.stem}.out.dng"), frame, source=path)

    if kind == "raw":
        return [frame_of]
    if kind == "dng":
        return [lambda: read_raw_and_develop(path), rewritten]
    if kind in ("jpeg", "picture"):
        return [lambda: read_picture(path)]
    if kind == "recipe":
        return [lambda: _set_up(path)]
    if kind == "npy":
        return [lambda: read_packed(path, path.with_suffix(".png"), None)]
    if kind != "safetensors":
        values = [lambda name=name: read_value(path, name) for name in ("cells", "text")]
        return [lambda: mosaic_of(path), lambda: colour_of(path), *values]
    load = {"isp": isp_of, "denoiser": denoisers.load, "params": load_params}
    kept = path.stem.split("-")[0]
    return [lambda: load[kept](path), *([lambda: describe(path)] if kept != "params" else [])]


def _set_up(path: Path) -> None:
    """A recipe as the command line sets it up, its networks without their memory."""
    import torch

    from rawaug.commands.run import with_values
    from rawaug.experiment.kinds import settings_of
    from rawaug.experiment.recipe import Recipe, kind_of, read_recipe
    from rawaug.training.state import first_network

    content = read_recipe(path)
    recipe = with_values(settings_of(kind_of(content, path)), content, path)
    try:
        if isinstance(recipe, Recipe):
            with torch.device("meta"):
                for arm in recipe.arms:
                    first_network(recipe.network_of(arm), seed=0)
    except (ValueError, FileNotFoundError) as error:  # the command line has named the file already
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def attempt(kind: str, path: Path) -> tuple[str, str]:
    """``read``, ``refused`` or ``fault``, and why."""
    outcome = "read", ""
    for read in readers(kind, path):
        try:
            read()
        except (ValueError, OSError) as error:
            text = str(error)
            if "\n" in text or path.stem not in text:
                return "fault", f"{type(error).__name__} without name, or of many lines: {text!r}"
            outcome = "refused", text
        except Exception as error:
            import traceback

            last = traceback.extract_tb(error.__traceback__)[-1]
            return "fault", f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"
    return outcome


# -- commands ----------------------------------------------------------------------------------------------------------

NOT_A_NUMBER = re.compile(r"(?<![\w.])[-+]?(nan|inf)(?![\w.])", re.IGNORECASE)
_FIT = ["--steps", "2", "--curve-steps", "2", "--pixels", "1024", "--batch", "64"]
_SYNTH = ["--workers", "0", "--noise", "[0.001, 1e-5]"]


def commands(kind: str, path: Path) -> list[list[str]]:
    """The command lines that read a file of this kind; the whole files that they need too are two folders above."""
    whole, out, file = path.parents[1], _out(path), str(path)
    isp, denoiser, dng = (f"{whole / name}" for name in ("isp.safetensors", "denoiser.safetensors", "own.dng"))
    if kind == "dng":
        return [
            ["fit", file, "--out", f"{out}/camera.safetensors", *_FIT],
            ["evaluate", isp, "--data", file],
            ["denoise", file, f"{out}/denoised.dng", "--denoiser", denoiser],
        ]
    if kind in ("jpeg", "picture"):
        return [["synth", f"{path.parent}", f"{out}/pairs", *_SYNTH]]
    if kind == "npy":
        return [["data", "check", f"{path.parent}"], ["evaluate", isp, "--data", f"rawir:{path.parent}"]]
    if kind == "safetensors" and path.stem.startswith("denoiser"):
        evaluate = ["evaluate", file, "--data", dng, "--noise", "[0.001, 1e-5]"]
        return [["info", file, "--json"], evaluate, ["denoise", dng, f"{out}/d.dng", "--denoiser", file]]
    if kind == "safetensors" and path.stem.startswith("isp"):
        return [["info", file, "--json"], ["evaluate", file, "--data", dng]]
    return []


def run(argv: Sequence[str]) -> tuple[str, str]:
    """``read``, ``refused`` or ``fault``, and why: what became of one command line."""
    from rawaug.cli import main

    said, wrong = io.StringIO(), io.StringIO()
    command = " ".join(argv[:2])
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = main([*argv, "--quiet"])
    except SystemExit as end:
        return "fault", f"{command}: exits with {end.code}: {wrong.getvalue()[-200:]!r}"
    except Exception as error:
        import traceback

        last = traceback.extract_tb(error.__traceback__)[-1]
        return "fault", f"{command}: {type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"
    lines = [line for line in wrong.getvalue().splitlines() if line.startswith("rawaug: ")]
    if status == 2 and len(lines) == 1:
        return "refused", lines[0]
    if status:
        return "fault", f"{command}: status {status}, {len(lines)} lines: {wrong.getvalue()[-200:]!r}"
    if number := NOT_A_NUMBER.search(said.getvalue()):
        return "fault", f"{command}: {number.group()} in a result, and status 0"
    return "read", ""


def run_all(kind: str, path: Path) -> tuple[str, str]:
    """The worst of what became of every command on this file."""
    found = []
    for argv in commands(kind, path):
        _out(path).mkdir()
        found.append(run(argv))
        shutil.rmtree(_out(path))
    return min(found, key=lambda one: ("fault", "refused", "read").index(one[0]), default=("read", ""))


def _out(path: Path) -> Path:
    return path.parents[1] / f"{path.stem}-out"


# -- the worker --------------------------------------------------------------------------------------------------------


def work(asked: Connection, log: str) -> None:
    """Read what is asked for, ``(kind, path, by_commands)``, and answer each; a first answer says that all is there.

    What decoders print goes to ``log``, and where Python was if one of them crashes.
    """
    import faulthandler
    import warnings

    file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (1, 2):
        os.dup2(file, stream)
    faulthandler.enable(file)
    warnings.simplefilter("ignore")
    os.environ["RAWAUG_READ_SECONDS"] = "0"  # this process is what a decoder may take down
    for kind in ("dng", "recipe"):  # imports are no part of reading
        attempt(kind, Path("none"))
    asked.send(None)
    with contextlib.suppress(EOFError):
        while True:
            kind, name, by_commands = asked.recv()
            outcome, why = attempt(kind, Path(name))
            if by_commands and outcome != "fault":
                said = run_all(kind, Path(name))
                outcome, why = said if said[0] == "fault" or outcome == "read" else (outcome, why)
            asked.send((outcome, why))
