"""One run at a time in a folder: a lock file with its owner, whom the second run names when it is refused.

The lock is POSIX's on the open file (``fcntl.lockf``), which the kernel releases when its process ends, however it
ends: the file that a killed run leaves behind is taken over. It holds on NFS, between machines, and children of the
process do not inherit it. Where there is no ``fcntl`` (Windows) nothing is locked.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import wraps
from pathlib import Path
from typing import IO, ParamSpec, TypeVar

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

P = ParamSpec("P")
R = TypeVar("R")

NAME = "rawaug.lock"
"""Of the lock file in a folder."""

_held: set[tuple[Path, int]] = set()
"""By process: within one, POSIX's locks do not exclude each other, and a child inherits this set."""


@contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold the lock ``file``, whose folder is made, and is removed if it is still empty.

    Raises:
        ValueError: if another run holds it, named by process and machine.
        OSError: if it cannot be written, or was gone at the end: the folder was removed or replaced meanwhile.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, locked(Path(folder, NAME)):
        ...     [path.name for path in Path(folder).iterdir()]
        ['rawaug.lock']
    """
    if fcntl is None:
        yield
        return
    file = file.absolute()
    made = not file.parent.exists()
    file.parent.mkdir(parents=True, exist_ok=True)
    own = (file, os.getpid())
    if own in _held:
        raise ValueError(_refusal(file, "this process"))
    with _acquired(file) as handle:
        _held.add(own)
        try:
            yield
            if not _is_at(file, handle):
                raise OSError(f"{file.parent}: was removed or replaced during this run; run the same command again")
        finally:
            _held.discard(own)
            if _is_at(file, handle):
                file.unlink()
            if made and file.parent.is_dir() and not any(file.parent.iterdir()):
                file.parent.rmdir()


def one_at_a_time(folder: Callable[..., Path | None]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator: hold the lock of the folder that the arguments name during a call; of None none."""

    def decorator(function: Callable[P, R]) -> Callable[P, R]:
        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            place = folder(*args, **kwargs)
            with nullcontext() if place is None else locked(place / NAME):
                return function(*args, **kwargs)

        return call

    return decorator


def _acquired(file: Path) -> IO[str]:
    """The locked file, open; its owner is in it."""
    while True:
        handle = file.open("a+")
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except (BlockingIOError, PermissionError):
            handle.seek(0)
            owner = handle.read().strip() or "another run"
            handle.close()
            raise ValueError(_refusal(file, owner)) from None
        except BaseException:
            handle.close()
            raise
        if _is_at(file, handle):  # not the file that its last owner has just removed
            handle.truncate(0)
            handle.write(f"process {os.getpid()} on {socket.gethostname()}\n")
            handle.flush()
            return handle
        handle.close()


def _is_at(file: Path, handle: IO[str]) -> bool:
    try:
        return os.path.samestat(file.stat(), os.fstat(handle.fileno()))
    except FileNotFoundError:
        return False


def _refusal(file: Path, owner: str) -> str:
    return f"{file.parent}: in use by {owner} ({file.name}); wait for it, or choose another output"
