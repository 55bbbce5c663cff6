"""What becomes of a hostile file: every reader of its kind is tried, and on request the commands, as a user types them.

:func:`attempt` runs in the helper process of :mod:`rawaug.io.isolated`, which says what crashed or hung.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import resource
import shutil
import signal
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import torch

import denoisers
from rawaug import DictionaryISP
from rawaug.cli import main
from rawaug.commands.info import describe
from rawaug.commands.run import with_values
from rawaug.data.mat import read_value
from rawaug.data.published import read_packed
from rawaug.data.sidd import colour_of, mosaic_of
from rawaug.experiment.plan import settings_of
from rawaug.experiment.recipe import Recipe, kind_of, read_recipe
from rawaug.io import RawFrame, read_picture, read_raw, read_raw_and_develop, write_dng
from rawaug.plugin.params import load_params
from rawaug.training.state import first_network

SECONDS, MEBIBYTES = 10, 2048
"""Of a processor, and of memory, that a file may take."""
COMMANDS_COST = 6
"""So many times the seconds where commands read it too."""


def readers(kind: str, path: Path) -> list[Callable[[], object]]:
    """Every reader in the package for this kind of file."""

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
    content = read_recipe(path)
    recipe = with_values(settings_of(kind_of(content, path)), content, path)
    try:
        if isinstance(recipe, Recipe):
            with torch.device("meta"):
                for arm in recipe.arms:
                    first_network(recipe.network_of(arm), seed=0)
    except (ValueError, FileNotFoundError) as error:  # the command line has named the file already
        raise ValueError(f"{path}: {' '.join(str(error).split())}") from error


def read(kind: str, path: Path) -> tuple[str, str]:
    """``read``, ``refused`` or ``fault``, and why: what became of a file by its readers."""
    outcome = "read", ""
    for reader in readers(kind, path):
        try:
            reader()
        except (ValueError, OSError) as error:
            text = str(error)
            if "\n" in text or path.stem not in text:
                return "fault", f"{type(error).__name__} without name, or of many lines: {text!r}"
            outcome = "refused", text
        except Exception as error:
            return "fault", _described(error)
    return outcome


def _described(error: Exception) -> str:
    last = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}: {error}"


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
    """Likewise, of one command line: status 0, or status 2 and one line on stderr."""
    said, wrong = io.StringIO(), io.StringIO()
    command = " ".join(argv[:2])
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(wrong):
            status = main([*argv, "--quiet"])
    except SystemExit as end:
        return "fault", f"{command}: exits with {end.code}: {wrong.getvalue()[-200:]!r}"
    except Exception as error:
        return "fault", f"{command}: {_described(error)}"
    lines = [line for line in wrong.getvalue().splitlines() if line.startswith("rawaug: ")]
    if status == 2 and len(lines) == 1:
        return "refused", lines[0]
    if status:
        return "fault", f"{command}: status {status}, {len(lines)} lines: {wrong.getvalue()[-200:]!r}"
    if number := NOT_A_NUMBER.search(said.getvalue()):
        return "fault", f"{command}: {number.group()} in a result, and status 0"
    return "read", ""


def _out(path: Path) -> Path:
    return path.parents[1] / f"{path.stem}-out"


# -- in the helper process ---------------------------------------------------------------------------------------------


def attempt(path: Path, kind: str, by_commands: bool) -> tuple[str, str]:
    """The worst of what became of a file: :func:`read`, :func:`run`, or too much of a processor or of memory."""
    _silence()
    seconds, before = SECONDS * (COMMANDS_COST if by_commands else 1), time.process_time()
    resource.setrlimit(resource.RLIMIT_CPU, (int(before) + 2 * seconds, resource.RLIM_INFINITY))  # SIGXCPU ends a hang
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak
    found = [read(kind, path)]
    for argv in commands(kind, path) if by_commands and found[0][0] != "fault" else ():
        _out(path).mkdir()
        found.append(run(argv))
        shutil.rmtree(_out(path))
    status = Path("/proc/self/status").read_text()
    peak = int(re.findall(r"VmHWM:\s*(\d+)", status)[0]) / 1024
    if peak > MEBIBYTES:
        return "memory", f"{peak:.0f} MiB"
    if time.process_time() - before > seconds:
        return "hung", f"more than {seconds} s of a processor"
    return min(found, key=lambda one: ("fault", "refused", "read").index(one[0]))


@cache
def _silence() -> None:
    """What decoders print is not of interest."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGXCPU, signal.SIG_DFL)
