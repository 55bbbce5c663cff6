"""Decoding in a helper process, so that a damaged or hostile file cannot crash or hang the main process.

LibRaw, OpenImageIO, SciPy and HDF5 are C and C++ code. :func:`isolated` calls their readers in a process managed by
loky. If the process dies, or needs more than ``RAWAUG_READ_SECONDS`` (60 by default), the caller gets an OSError that
names the file, and the next file gets a new process. ``data check``, ``denoise``, ``hdr`` and the reader of MATLAB
files use it. Training reads in the workers of its DataLoader, at full speed.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

LIMIT, SECONDS = "RAWAUG_READ_SECONDS", 60.0
_IDLE_SECONDS = 60
_ADVICE = "leave it out, or copy it again"
_one_at_a_time = threading.Lock()


def isolated(read: Callable[..., T], *arguments: Any, name: object = None) -> T:
    """Call ``read(*arguments)`` in a helper process, or directly in a worker process or if the limit is 0."""
    seconds = time_limit()
    is_worker = multiprocessing.parent_process() is not None
    if not seconds or is_worker:
        return read(*arguments)

    if name is None and arguments:
        name = arguments[0]

    with _one_at_a_time:
        try:
            _helper().submit(_import_module, read).result()  # imports do not count towards the limit
            value: T = _helper().submit(_call_in_folder, Path.cwd(), read, arguments).result(seconds)
        except TimeoutError:
            _stop_helper()
            raise OSError(f"{name}: cannot be read within {seconds:g} s ({LIMIT}); {_ADVICE}") from None
        except BrokenProcessPool as error:
            _stop_helper()
            raise OSError(f"{name}: crashes the decoder{_exit_code(error)}; {_ADVICE}") from None
    return value


def _exit_code(error: BrokenProcessPool) -> str:
    """Find the exit code in loky's message, in brackets after a space; the text is empty if it has none."""
    match = re.search(r"exit codes? .*\{(.*)\}", str(error))
    if match is None:
        return ""
    return f" ({match[1]})"


@contextmanager
def damage_as_os_error(path: Path, what: str, *passed: type[Exception]) -> Iterator[None]:
    """Turn any exception of a decoder into an OSError that names the file, except those in ``passed``."""
    try:
        yield
    except (ImportError, *passed):  # type: ignore[misc]
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise OSError(f"{path}: {what} ({reason}); copy it again") from error


def time_limit() -> float:
    """Read the maximum number of seconds for reading a file; 0 means that files are read in this process."""
    text = os.environ.get(LIMIT, str(SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0

    if not 0 <= seconds < float("inf"):
        raise ValueError(f"{LIMIT}={text}: must be a number of seconds, or 0 to read in the same process")
    return seconds


@cache
def _helper() -> Any:
    """Start the helper by loky, which does not import the user's script again, unlike multiprocessing's forkserver."""
    from loky import ProcessPoolExecutor

    # the helper has no helper itself, and the parent reports a crash, so no traceback is printed
    env = {LIMIT: "0", "PYTHONFAULTHANDLER": "", "OPENBLAS_NUM_THREADS": "1"}

    # only the parent handles Ctrl-C
    ignore_interrupts = (signal.SIGINT, signal.SIG_IGN)
    return ProcessPoolExecutor(
        max_workers=1, timeout=_IDLE_SECONDS, initializer=signal.signal, initargs=ignore_interrupts, env=env
    )


def _stop_helper() -> None:
    _helper().shutdown(kill_workers=True)
    _helper.cache_clear()


def _import_module(read: Callable[..., Any]) -> None:
    """Import the module of a function, which unpickling the argument does."""


def _call_in_folder(folder: Path, read: Callable[..., T], arguments: tuple[Any, ...]) -> T:
    os.chdir(folder)  # for relative paths
    return read(*arguments)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helper.cache_clear)
