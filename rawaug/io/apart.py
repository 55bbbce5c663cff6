"""Reading apart: decoders run in a helper process, so that a crash or a hang of theirs ends one file.

LibRaw, OpenImageIO, SciPy and HDF5 are C and C++ code that reads what strangers wrote. :func:`apart` calls a reader in
a helper that this process keeps; pixels come back through shared memory. If the helper dies, or takes more than
``RAWAUG_READ_SECONDS`` (60 by default; 0 reads in this process), the file is named in an OSError and the next file gets
a new helper. On a busy machine, where it did not get to use a processor for that long, it has ten times as many. Each
thread of each DataLoader worker has its own. :func:`apart_each` reads small files by many in one message, which takes
most of the cost away.

Helpers are forked from one clean process (:mod:`rawaug.io.reading_process`), which imports the libraries once: to
start one takes milliseconds, and no thread of a decoder has to survive a fork. Needs Unix sockets; elsewhere, files are
read in this process.
"""

from __future__ import annotations

import atexit
import json
import math
import mmap
import os
import pickle
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

SECONDS = 60.0
PATIENCE = 10
"""Times the limit that a file may take where the helper has not used the limit of a processor: on a busy machine."""
START_SECONDS = 300.0
"""For the first helper, which waits until the libraries are imported."""

_ADDRESS, _LIMIT = "RAWAUG_READERS", "RAWAUG_READ_SECONDS"
_SERVE = "import sys, json; sys.path[:] = json.loads(sys.argv[1]); from rawaug.io.reading_process import serve; serve()"


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
    helper = _helper() if seconds else None
    if helper is None:
        return read(*arguments)
    try:
        ((known, value),) = _called(helper, read, [arguments], seconds)
    except _Lost as lost:
        raise OSError(f"{arguments[0]}: {lost}") from None
    if not known:
        raise value
    return value


def apart_each(read: Callable[..., T], files: Sequence[Any], *rest: Any) -> list[T | Exception]:
    """``read(file, *rest)`` of each file in a helper process, many by one message; an error stands in place of a value.

    Args:
        read: a function of a module, found there by its name.
        files, rest: that can be pickled.

    Example:
        >>> apart_each(len, ["four", "three", 2])[:2]
        [4, 5]
    """
    done: list[T | Exception] = []
    while len(done) < len(files):
        seconds = time_limit()
        helper = _helper() if seconds and len(files) - len(done) > 1 else None
        if helper is None:
            done.append(_alone(read, files[len(done)], rest))
            continue
        try:
            asked = [(file, *rest) for file in files[len(done) :]]
            done += [value for _, value in _called(helper, read, asked, seconds)]
        except _Lost:  # by one of them, which is found by reading them one by one
            done += [_alone(read, file, rest) for file in files[len(done) :]]
    return done


def _alone(read: Callable[..., T], file: Any, rest: Sequence[Any]) -> T | Exception:
    try:
        return apart(read, file, *rest)
    except Exception as error:
        return error


def _called(helper: _Helper, read: Callable[..., Any], calls: Sequence[Any], seconds: float) -> list[tuple[bool, Any]]:
    """What ``read`` made of the first of these arguments, at least of one; a helper that is lost is forgotten."""
    try:
        return helper.call((_folder(), read, calls), seconds)
    except _Lost:
        _of_this_thread.helper = None
        raise
    except BaseException:  # such as KeyboardInterrupt, which leaves an answer behind
        _of_this_thread.helper = None
        helper.kill()
        raise


def _folder() -> str | None:
    """The working folder, in which the helper finds a relative path; None if it has been removed."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return None


def _helper() -> _Helper | None:
    """The helper of this thread; none, with a warning, where the system has no room for one."""
    global _unavailable
    found: _Helper | None = getattr(_of_this_thread, "helper", None)
    if found is None and not _unavailable:
        try:
            found = _of_this_thread.helper = _Helper(_connected())
        except (OSError, RuntimeError) as error:
            _unavailable = True
            warnings.warn(f"files are read in this process, so a damaged one may crash it: {error}", stacklevel=4)
    return found


def time_limit() -> float:
    """Seconds that a file may take; 0 where files are read in this process.

    Raises:
        ValueError: if ``RAWAUG_READ_SECONDS`` is no number of seconds.
    """
    text = os.environ.get(_LIMIT, str(SECONDS))
    try:
        seconds = float(text)
    except ValueError:
        seconds = -1.0
    if not 0 <= seconds < float("inf"):
        raise ValueError(f"{_LIMIT}={text}: must be a number of seconds, or 0 to read in the same process")
    return seconds if hasattr(os, "fork") and hasattr(socket, "AF_UNIX") else 0.0


@contextmanager
def reading_within(seconds: float | None) -> Iterator[None]:
    """Another time limit inside a ``with`` block, for this process and those that it starts; None changes nothing.

    Example:
        >>> with reading_within(5.0):
        ...     time_limit()
        5.0
    """
    before = os.environ.get(_LIMIT)
    if seconds is not None:
        os.environ[_LIMIT] = str(seconds)
    try:
        yield
    finally:
        if seconds is not None:
            os.environ.pop(_LIMIT)
            os.environ.update({} if before is None else {_LIMIT: before})


def prepare() -> None:
    """Start the process that helpers come from, without waiting for it, for the workers that this one will have."""
    if time_limit() and _address() is None:
        with suppress(OSError):  # whoever reads will say so
            _start()


class _Lost(Exception):
    """The helper died or hung; the text says which."""


class _Helper:
    """A helper process: a connection, the memory that it shares, and the processor's seconds at its last answer."""

    def __init__(self, link: socket.socket) -> None:
        link.settimeout(START_SECONDS)
        try:
            message, (descriptor,), *_ = socket.recv_fds(link, 64, 1)
        except (OSError, ValueError):
            link.close()
            raise RuntimeError("the process that helpers come from did not start") from None
        link.settimeout(None)
        self.pid, self.memory = int(message), descriptor
        self.view: mmap.mmap | None = None
        self.busy = 0.0
        self.connection = Connection(link.detach())
        self.answered = select.poll()
        self.answered.register(self.connection.fileno(), select.POLLIN)
        self.let_go = weakref.finalize(self, _close, self.connection, descriptor)

    def call(self, request: Any, seconds: float) -> list[tuple[bool, Any]]:
        """Of each of the first calls, whether there is a value, and the value or the error.

        Raises:
            _Lost: if the helper dies or takes longer.
        """
        try:
            self.connection.send_bytes(pickle.dumps(request))
            if not self._answers(seconds):
                self.kill()
                raise _Lost(f"cannot be read within {seconds:g} s ({_LIMIT}); leave it out, or copy it again")
            busy, answers, sizes = pickle.loads(self.connection.recv_bytes())
        except (EOFError, ConnectionError):
            busy, answers, sizes = None, 0, ()
        if busy is None:
            self.let_go()
            raise _Lost(f"crashes the decoder ({_ending(answers)}); leave it out, or copy it again")
        self.busy, copies = busy, iter(self._copied(sizes))
        return [pickle.loads(answer, buffers=copies) for answer in answers]

    def _answers(self, seconds: float) -> bool:
        """Whether an answer comes; a helper that other programs keep from running gets more time."""
        for _ in range(PATIENCE):
            if self.answered.poll(1e3 * seconds):
                return True
            if not _processor_seconds(self.pid) < self.busy + seconds:
                return False
        return False

    def _copied(self, sizes: tuple[int, ...]) -> list[np.ndarray]:
        """The buffers in shared memory, which the next answer overwrites."""
        total, place, buffers = sum(sizes), 0, []
        if total and (self.view is None or len(self.view) < total):
            self.view = mmap.mmap(self.memory, os.fstat(self.memory).st_size)
        for size in sizes:
            assert self.view is not None
            buffers.append(np.frombuffer(self.view, np.uint8, size, place).copy())
            place += size
        return buffers

    def kill(self) -> None:
        """End the process, whatever it does."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        self.let_go()


def _processor_seconds(process: int) -> float:
    """What a process has used of the processors; infinite where the system does not say."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return math.inf


def _close(connection: Connection, descriptor: int) -> None:
    """Let go of a helper, which then ends by itself."""
    connection.close()
    os.close(descriptor)


def _ending(status: int) -> str:
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exited with status {os.waitstatus_to_exitcode(status)}"


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
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
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
