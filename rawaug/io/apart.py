"""Reading apart: decoders run in a helper process, so that a crash or a hang of theirs ends one file.

LibRaw, OpenImageIO, SciPy and HDF5 are C and C++ code that reads what strangers wrote. :func:`apart` calls a reader in
a helper that this process keeps; pixels come back through shared memory. If the helper dies, or takes more than
``RAWAUG_READ_SECONDS`` (60 by default; 0 reads in this process), the file is named in an OSError and the next file gets
a new helper. On a busy machine, where it did not get to use a processor for that long, it has ten times as many. Each
thread of each DataLoader worker has its own. :func:`apart_each` reads many: the helper decodes the next files while
this process works on one, and small files share a message.

Helpers are forked from one clean process (:mod:`rawaug.io.reading_process`), which imports the libraries once: to
start one takes milliseconds, and no thread of a decoder has to survive a fork. Needs Unix sockets; elsewhere, files are
read in this process.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from rawaug.io.helper import LIMIT, Helper, Lost
from rawaug.io.reading_process import MEMORIES

T = TypeVar("T")

SECONDS = 60.0
_ADDRESS = "RAWAUG_READERS"
_SERVE = "import sys, json; sys.path[:] = json.loads(sys.argv[1]); from rawaug.io.reading_process import serve; serve()"
_KEEP_MEMORY = {
    "MALLOC_MMAP_THRESHOLD_": f"{2**25}",  # the most that glibc takes
    "MALLOC_TRIM_THRESHOLD_": f"{2**28}",
    "GLIBC_TUNABLES": "glibc.malloc.hugetlb=1",
}
"""glibc keeps what a decoder frees for the next picture, and takes the rest in huge pages. Otherwise all pages of every
picture are mapped anew, which takes a quarter of the time of decoding it."""


def apart(read: Callable[..., T], *arguments: Any) -> T:
    """``read(*arguments)`` in a helper process.

    Args:
        read: a function of a module, found there by its name.
        arguments: that can be pickled; the first one is the file, which errors name.

    Raises:
        OSError: if the helper dies or takes too long.
        Exception: whatever ``read`` raises.

    Example:
        >>> apart(len, "four")
        4
    """
    seconds = time_limit()
    with _borrowed(seconds > 0) as helper:
        if helper is None:
            return read(*arguments)
        try:
            helper.ask(read, [arguments])
            ((known, value),) = helper.answer(seconds)
        except Lost as lost:
            raise OSError(f"{arguments[0]}: {lost}") from None
    if not known:
        raise value
    return value


def apart_each(read: Callable[..., T], files: Sequence[Any], *rest: Any) -> Iterator[T | Exception]:
    """``read(file, *rest)`` of each file in order, by a helper that works ahead; an error stands in place of a value.

    Args:
        read: a function of a module, found there by its name.
        files, rest: that can be pickled.

    Example:
        >>> list(apart_each(len, ["four", "three", 2]))[:2]
        [4, 5]
    """
    calls, done = [(file, *rest) for file in files], 0
    while done < len(calls):
        seconds = time_limit()
        suspects, lost = 1, None
        with _borrowed(seconds > 0 and len(calls) - done > 1) as helper:
            if helper is not None:
                try:
                    for _, value in _answers(helper, read, calls[done:], seconds):
                        done += 1
                        yield value
                    return
                except Lost as ended:
                    suspects, lost = helper.next, ended
        for call in calls[done : done + suspects]:  # one of several is found by reading them one by one
            done += 1
            yield OSError(f"{call[0]}: {lost}") if lost and suspects == 1 else _alone(read, call)


def _answers(
    helper: Helper, read: Callable[..., Any], calls: Sequence[Any], seconds: float
) -> Iterator[tuple[bool, Any]]:
    """What ``read`` made of each, in order; the helper always has what to do next.

    Raises:
        Lost: if the helper dies or hangs, by one of the next ``helper.next`` calls.
    """
    sent = 0
    while sent < len(calls) or helper.expected:
        while len(helper.waited) < MEMORIES and (sent < len(calls) or helper.late):
            few = calls[sent : sent + helper.few]
            helper.ask(read, few)
            sent += len(few)
        answers = helper.answer(seconds)
        if sent == len(calls) and not helper.expected:
            helper.drain(seconds)  # now, since the caller may not ask for more than there is
        yield from answers


def _alone(read: Callable[..., T], call: Sequence[Any]) -> T | Exception:
    try:
        return apart(read, *call)
    except Exception as error:
        return error


@contextmanager
def _borrowed(wanted: bool) -> Iterator[Helper | None]:
    """A helper of this thread, which keeps one; None if none is wanted or, with a warning, the system lacks room."""
    helper = _idle_or_new() if wanted else None
    try:
        yield helper
    finally:
        if helper is not None:
            if helper.idle and getattr(_of_this_thread, "helper", None) is None:
                _of_this_thread.helper = helper
            else:  # such as after a KeyboardInterrupt, which leaves an answer behind
                helper.let_go()


def _idle_or_new() -> Helper | None:
    global _unavailable
    found: Helper | None = getattr(_of_this_thread, "helper", None)
    _of_this_thread.helper = None
    if (found is None or not found.idle) and not _unavailable:
        try:
            found = Helper(_connected())
        except (OSError, RuntimeError) as error:
            _unavailable = True
            warnings.warn(f"files are read in this process, so a damaged one may crash it: {error}", stacklevel=5)
    return found


def time_limit() -> float:
    """Seconds that a file may take; 0 where files are read in this process.

    Raises:
        ValueError: if ``RAWAUG_READ_SECONDS`` is no number of seconds.
    """
    text = os.environ.get(LIMIT, str(SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < float("inf"):
        raise ValueError(f"{LIMIT}={text}: must be a number of seconds, or 0 to read in the same process")
    return seconds if hasattr(os, "fork") and hasattr(socket, "AF_UNIX") else 0.0


@contextmanager
def reading_within(seconds: float | None) -> Iterator[None]:
    """Another time limit inside a ``with`` block, for this process and those that it starts; None changes nothing.

    Example:
        >>> with reading_within(5.0):
        ...     time_limit()
        5.0
    """
    before = os.environ.get(LIMIT)
    if seconds is not None:
        os.environ[LIMIT] = str(seconds)
    try:
        yield
    finally:
        if seconds is not None:
            os.environ.pop(LIMIT)
            os.environ.update({} if before is None else {LIMIT: before})


def prepare() -> None:
    """Start the process that helpers come from, without waiting for it, for the workers that this one will have."""
    if time_limit() and _address() is None:
        with suppress(OSError):  # whoever reads will say so
            _start()


# -- the process that helpers come from -------------------------------------------------------------------------------

_of_this_thread = threading.local()
_starting = threading.Lock()
_unavailable = False


def _address() -> str | None:
    """Of the socket of a running process, started here or by the process that this one comes from."""
    address = os.environ.get(_ADDRESS)
    return address if address and Path(address).exists() else None


def _connected() -> socket.socket:
    for _ in range(2):
        link = socket.socket(socket.AF_UNIX)
        try:
            link.connect(_address() or _start())
            return link
        except (ConnectionError, FileNotFoundError):  # its owner has ended
            link.close()
            os.environ.pop(_ADDRESS, None)
    raise RuntimeError("the process that helpers come from cannot be reached")


def _start() -> str:
    """Start the process; whoever connects before it is ready waits."""
    with _starting:
        if (known := _address()) is not None:
            return known
        folder = tempfile.mkdtemp(prefix="rawaug-")  # of this user alone
        address = f"{folder}/readers"
        loaded = sorted(name for name in sys.modules if name.startswith(("rawaug.io.", "rawaug.data.")))
        with socket.socket(socket.AF_UNIX) as listening:
            listening.bind(address)
            listening.listen(128)
            number = listening.fileno()
            process = subprocess.Popen(
                [sys.executable, "-c", _SERVE, json.dumps(sys.path), str(number), folder, *loaded],
                stdin=subprocess.PIPE,  # which closes when this process ends, however it does
                stdout=2,
                pass_fds=[number],
                start_new_session=True,  # an interrupt is for this process
                env=_KEEP_MEMORY | os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )
        os.environ[_ADDRESS] = address
        atexit.register(_stop, process, folder, os.getpid())
        return address


def _stop(process: subprocess.Popen[bytes], folder: str, owner: int) -> None:
    if os.getpid() == owner:
        process.kill()
        process.communicate()
        shutil.rmtree(folder, ignore_errors=True)


def _forget() -> None:
    """In a forked process: the helper is the parent's."""
    global _of_this_thread, _starting
    _of_this_thread, _starting = threading.local(), threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
