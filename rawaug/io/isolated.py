"""Decoding in a helper process, where a file from a stranger must not crash or hang what matters.

LibRaw, OpenImageIO, SciPy and HDF5 are C and C++ code. :func:`isolated` runs a reader of theirs in a process that loky
keeps: one that dies, or takes longer than ``RAWAUG_READ_SECONDS`` (60 by default), ends in an OSError that names the
file, and the next file gets a new process. ``data check``, ``denoise``, ``hdr`` and MATLAB files are read like this;
training reads in the workers of its DataLoader, at full speed.
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
    if not seconds or multiprocessing.parent_process() is not None:
        return read(*arguments)
    if name is None and arguments:
        name = arguments[0]
    with _one_at_a_time:
        try:
            _helper().submit(_known, read).result()  # what it has to import is no part of the limit
            value: T = _helper().submit(_in_folder, Path.cwd(), read, arguments).result(seconds)
            return value
        except TimeoutError:
            _stop_helper()
            raise OSError(f"{name}: cannot be read within {seconds:g} s ({LIMIT}); {_ADVICE}") from None
        except BrokenProcessPool as error:
            _stop_helper()
            how = re.search(r"exit codes? .*\{(.*)\}", str(error))
            why = f" ({how[1]})" if how else ""
            raise OSError(f"{name}: crashes the decoder{why}; {_ADVICE}") from None


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
    """Seconds that a file may take; 0 to read it in this process."""
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
    """loky starts it without importing the user's script again, unlike multiprocessing's forkserver."""
    from loky import ProcessPoolExecutor

    # the helper reads in its own process, and a crash is reported here, not by a traceback of its own
    env = {LIMIT: "0", "PYTHONFAULTHANDLER": "", "OPENBLAS_NUM_THREADS": "1"}
    interrupts = signal.SIGINT, signal.SIG_IGN  # they are for the parent
    return ProcessPoolExecutor(1, timeout=_IDLE_SECONDS, initializer=signal.signal, initargs=interrupts, env=env)


def _stop_helper() -> None:
    _helper().shutdown(kill_workers=True)
    _helper.cache_clear()


def _known(read: Callable[..., Any]) -> None:
    """Unpickling the function has imported its module."""


def _in_folder(folder: Path, read: Callable[..., T], arguments: tuple[Any, ...]) -> T:
    os.chdir(folder)  # for relative paths
    return read(*arguments)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helper.cache_clear)
