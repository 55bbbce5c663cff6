"""Progress on stderr: a bar in a terminal; elsewhere, as in the log of a job, one plain line every 30 seconds.

A line of a log covers everything under way, as the images of an evaluation and the tiles of one of them. The
environment variable ``RAWAUG_PROGRESS_SECONDS`` sets another interval. What takes less prints no line.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TextIO, TypeVar
from weakref import WeakKeyDictionary

from tqdm.asyncio import tqdm as terminal_tqdm
from tqdm.auto import tqdm

T = TypeVar("T")
_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


@contextmanager
def quiet(yes: bool = True) -> Iterator[None]:
    """Print no progress within the block.

    Example:
        >>> with quiet():
        ...     list(progress(range(3), label="count", unit="number"))
        [0, 1, 2]
    """
    token = _quiet.set(yes)
    try:
        yield
    finally:
        _quiet.reset(token)


def progress(
    items: Iterable[Any],
    *,
    label: str,
    unit: str,
    total: int | None = None,
    initial: int = 0,
    leave: bool = False,
    shown: bool = True,
    stream: TextIO | None = None,
) -> Any:
    """``items``, counted as they are iterated over; ``set_postfix_str(text, refresh=False)`` adds to what is shown.

    Args:
        items: what is iterated over.
        label: heads the bar.
        unit: of what is counted, singular.
        total: how many there are, where ``items`` has no length.
        initial: how many were done before.
        leave: keep the finished bar in the terminal.
        shown: False prints nothing at all.
        stream: in place of stderr.
    """
    stream = stream or sys.stderr
    if total is None and isinstance(items, Sized):
        total = len(items)
    shown = shown and not _quiet.get()
    if not shown or stream.isatty() or tqdm is not terminal_tqdm:  # tqdm.auto is another class in a notebook
        settings: dict[str, Any] = {"desc": label, "unit": unit, "total": total, "initial": initial}
        return tqdm(items, file=stream, leave=leave, disable=not shown, **settings)
    return _Logged(items, label, unit, total, initial, stream)


class _Log:
    """Of one stream: what is under way, the outermost first, and when the last line was written."""

    def __init__(self) -> None:
        self.under_way: list[_Logged] = []
        self.written = time.monotonic()


_logs: WeakKeyDictionary[TextIO, _Log] = WeakKeyDictionary()


class _Logged:
    """Items counted in the lines of a log; see :func:`progress`."""

    def __init__(
        self, items: Iterable[Any], label: str, unit: str, total: int | None, initial: int, stream: TextIO
    ) -> None:
        self.items, self.label, self.unit, self.total, self.stream = items, label, unit, total, stream
        self.initial = self.done = initial
        self.began = time.monotonic()
        self.postfix = ""
        self.shown: int | None = None  # how many were done by the last line

    def set_postfix_str(self, text: str, refresh: bool = False) -> None:
        """Add ``text`` to the next line."""
        self.postfix = f", {text}"

    def __iter__(self) -> Iterator[Any]:
        log = _logs.setdefault(self.stream, _Log())
        log.under_way.append(self)
        seconds = float(os.environ.get("RAWAUG_PROGRESS_SECONDS", "30"))
        try:
            for item in self.items:
                yield item
                self.done += 1
                if time.monotonic() - log.written >= seconds:
                    self._write(log)
            if self.shown not in (None, self.done) and log.under_way == [self]:
                self._write(log)
        finally:
            log.under_way.remove(self)

    def _write(self, log: _Log) -> None:
        self.stream.write("; ".join(map(str, log.under_way)) + "\n")
        self.stream.flush()
        log.written = time.monotonic()
        for part in log.under_way:
            part.shown = part.done

    def __str__(self) -> str:
        elapsed, done = time.monotonic() - self.began, self.done - self.initial
        count = str(self.done) if self.total is None else f"{self.done}/{self.total}"
        left = elapsed * (self.total - self.done) / done if self.total is not None and done else None
        remaining = "?" if left is None else tqdm.format_interval(left)
        interval = tqdm.format_interval(elapsed)
        return f"{self.label}: {count} {self.unit}s, {interval} elapsed, {remaining} left{self.postfix}"


def timed(stage: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Adds the seconds of a method to ``self.seconds[stage]``."""

    def decorated(method: Callable[..., T]) -> Callable[..., T]:
        @wraps(method)
        def run(self: Any, *arguments: Any) -> T:
            start = time.perf_counter()
            try:
                return method(self, *arguments)
            finally:
                self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start

        return run

    return decorated
