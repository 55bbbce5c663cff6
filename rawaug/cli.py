"""The command line: the signature and the docstring of a function are a command's arguments and its help.

Only the module of the command that is called is imported, so that ``rawaug --help`` needs no PyTorch. Other packages
add commands as entry points in the group ``rawaug.commands``. Errors are one line on stderr, with exit status 2.
"""

from __future__ import annotations

import ctypes
import io
import json
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from inspect import signature
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from rawaug.errors import MissingExtra, escape, resource_error, strip_traceback
from rawaug.progress import hide_progress
from rawaug.version import __version__

BAD_INPUT = 2
"""Exit status after a user's error."""

COMMANDS = {
    "benchmark": "Compare denoisers on the same frozen noise over clean references.",
    "defects": "Map a sensor's hot and dead pixels, by RAW files of different scenes.",
    "denoise": "Denoise a RAW file to DNG, a JPEG, PNG or TIFF to another, or a folder of them.",
    "evaluate": "Measure PSNR and SSIM of a denoiser or an ISP.",
    "explore": "Show pictures as RAW of any camera, on a page in the browser.",
    "export": "Write a denoiser as ONNX, or an ISP as a .cube.",
    "fit": "Fit a dictionary ISP to RAW files of a camera.",
    "hdr": "Merge exposures of a scene in RAW, or change the exposure of a single picture.",
    "info": "Describe a weights file, list the known cameras (rawaug info cameras [PART]), or time this machine.",
    "judge": "Estimate the PSNR of denoisers on your own RAW files, without clean ones.",
    "preview": "Draw a picture at every stage of an ISP, and as augmented RAW.",
    "run": "Run a recipe: rawaug run RECIPE [--key value ...]; resumable, writes runs/NAME.",
    "submit": "Denoise the noisy blocks of a benchmark, in the form that its server takes.",
    "synth": "Write noisy and clean RAW pairs made from sRGB pictures.",
}
"""Modules of :mod:`rawaug.commands`, each with a function ``run`` whose docstring opens with the line given here."""

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of glibc's malloc.h."""

NETWORKS = ("benchmark", "denoise", "evaluate", "judge", "run")
"""Commands that run networks: they take huge pages and keep them, as page faults took a third of their time."""

_OWN = {*COMMANDS, "camera", "data", "completion"}
"""Names that commands of other packages cannot have."""

app = App(
    name="rawaug",
    help="Train and evaluate RAW denoisers and camera ISPs.",
    version=f"rawaug {__version__}",
    help_format="rst",
    default_parameter=Parameter(negative=""),
    result_action="return_value",
)
app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False  # main says what to do
data = App(name="data", help="Commands about data.")
app.command(data)
data.command(
    "rawaug.commands.check_data:run", name="check", help="Identify a dataset, count its files and list damaged ones."
)
camera = App(name="camera", help="Commands about cameras.")
app.command(camera)
camera.command("rawaug.commands.measure_camera:run", name="measure", help="Measure a camera on dark and flat frames.")
for _name, _summary in COMMANDS.items():
    app.command(f"rawaug.commands.{_name}:run", name=_name, help=_summary)


@app.command
def completion(shell: Literal["bash", "zsh", "fish"], /) -> None:
    """Print a script that completes commands and options in a shell."""
    print(app.generate_completion(shell=shell))


@app.meta.default
def _launch(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    quiet: bool = False,
    own: Annotated[list[Path] | None, Parameter(name="--import")] = None,
) -> None:
    """Run a command.

    Args:
        quiet: do not print progress.
        own: Python files to import first, whose classes recipes and options can then name.
    """
    for file in own or ():
        _import(file)
    with hide_progress(quiet):
        app(words, exit_on_error=False, print_error=False)


def _import(file: Path) -> None:
    if not file.is_file():
        raise FileNotFoundError(f"--import {file}: no such file")
    spec = spec_from_file_location(file.stem, file)
    if spec is None or spec.loader is None:
        raise ValueError(f"--import {file}: is no Python file")
    sys.modules[file.stem] = module = module_from_spec(spec)
    spec.loader.exec_module(module)


def _keep_memory() -> None:
    """Let PyTorch take memory in huge pages, and the C library keep freed blocks of up to 512 MiB for the next tile."""
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")  # read when PyTorch first takes memory
    with suppress(AttributeError, OSError, TypeError):  # glibc alone has mallopt
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_MMAP_THRESHOLD, 2**29)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status.

    Threads of OpenMP sleep while they wait for each other, unless ``OMP_WAIT_POLICY`` says otherwise. By default they
    would spin, and if other programs want the cores, a spinning thread takes them from the thread that it waits for.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    words.sort(key=lambda word: word != "--quiet")  # comes first, so that run does not take it for a key of a recipe
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # names of files need not fit the terminal's encoding
            stream.reconfigure(errors="backslashreplace")

    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before PyTorch loads OpenMP
    command = _command_at(words)
    if words[command : command + 1] and words[command] in NETWORKS:
        _keep_memory()
    if words[command : command + 1] == ["run"] and {"-h", "--help"} & set(words[command + 2 :]):  # a recipe's keys
        words = [*words[: command + 2], "--keys"]

    try:
        with _stopped_by_sigterm():
            _add_plugins(words[command : command + 1])
            app.meta(words, exit_on_error=False, print_error=False)
        return 0
    except BrokenPipeError:  # the reader has closed the pipe, as with `| head`
        return 0
    except (ValueError, OSError, MissingExtra, CycloptsError) as error:
        text = _one_line(error)
    except (RuntimeError, MemoryError) as error:
        shortage = resource_error(error)
        if shortage is None:
            raise
        text = shortage
    except KeyboardInterrupt as stop:
        print("rawaug: stopped; run the same command again to resume", file=sys.stderr)
        return 128 + (stop.args[0] if stop.args else signal.SIGINT)

    print(f"rawaug: {escape(_in_options(text, words[command : command + 1]))}", file=sys.stderr)
    return BAD_INPUT


@contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Let SIGTERM, as of a job scheduler, end a command in the way that Ctrl-C does."""

    def stop(number: int, _: object) -> None:
        raise KeyboardInterrupt(number)

    if threading.current_thread() is not threading.main_thread():  # which alone receives signals
        yield
        return

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _in_options(text: str, names: Sequence[str]) -> str:
    """Write the arguments of functions that a message names as options of the command; only here are they known."""
    module = sys.modules.get(f"rawaug.commands.{names[0]}") if names else None
    if module is None:
        return text

    from rawaug.commands import as_options

    return as_options(text, signature(module.run).parameters)


def _add_plugins(names: Sequence[str]) -> None:
    """Add the commands of other packages: the one of this name, or all, where there is none or help is asked for.

    Raises:
        ValueError: if the one of this name cannot be loaded; of all, one that cannot be is named and left out.
    """
    lists_all = not names or names[0] in ("-h", "--help", "completion")
    for point in entry_points(group="rawaug.commands"):
        if not lists_all and point.name not in names:
            continue
        if point.name in _OWN or not re.fullmatch(r"[a-z][a-z0-9-]*", point.name):
            print(
                f"rawaug: {escape(point.value)} is ignored: a command cannot be called {point.name!r}", file=sys.stderr
            )
            continue

        try:
            function = point.load()
        except (Exception, SystemExit) as error:  # whatever that module does
            reason = " ".join(f"{type(error).__name__} {error}".split())
            text = f"the command {point.name} of another package, {point.value}, cannot be loaded: {reason}"
            if not lists_all:
                raise ValueError(text) from None
            print(f"rawaug: {escape(text)}", file=sys.stderr)
            continue

        if point.name not in app:
            app.command(function, name=point.name)


def _command_at(words: Sequence[str]) -> int:
    """Find the place of the command, after the options that come before it."""
    place = 0
    while place < len(words) and words[place].startswith("--"):
        place += 2 if words[place] == "--import" else 1
    return place


def _one_line(error: Exception) -> str:
    if isinstance(error, json.JSONDecodeError):
        return f"not valid JSON: {error.msg}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    return " ".join(strip_traceback(str(error)).split())


if __name__ == "__main__":
    sys.exit(main())
