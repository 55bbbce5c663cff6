"""Progress on stderr: a bar in a terminal, and elsewhere, as in a job's log, one plain line every 30 seconds.

The environment variable ``RAWAUG_PROGRESS_SECONDS`` sets another interval. Work that takes less time prints no line.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, TextIO

from tqdm.asyncio import tqdm as terminal_tqdm
from tqdm.auto import tqdm

_quiet: ContextVar[bool] = ContextVar("quiet", default=False)
_LINE = "{desc}: {n_fmt}/{total_fmt} {unit}s, {elapsed} elapsed, {remaining} left{postfix}"


@contextmanager
def hide_progress(yes: bool = True) -> Iterator[None]:
    """Print no progress within the block."""
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
    """Count items while they are iterated over.

    The result's method ``set_postfix_str(text, refresh=False)`` adds a text to the bar.

    Args:
        items: the items to iterate over.
        label: the text before the bar.
        unit: the noun for one item, in the singular.
        total: the number of items, if they have no length.
        initial: the number of items that were done before.
        leave: whether a finished bar stays in the terminal.
        shown: whether anything is printed.
        stream: the stream to print to; stderr by default.
    """
    stream = stream or sys.stderr
    settings: dict[str, Any] = {"desc": label, "unit": unit, "total": total, "initial": initial}
    settings["disable"] = not shown or _quiet.get()

    if stream.isatty() or tqdm is not terminal_tqdm:  # tqdm.auto is another class in a notebook
        return tqdm(items, file=stream, leave=leave, **settings)

    seconds = float(os.environ.get("RAWAUG_PROGRESS_SECONDS", "30"))
    settings |= {"mininterval": seconds, "maxinterval": seconds, "delay": seconds, "miniters": 1}
    return _Lines(items, file=stream, leave=False, bar_format=_LINE, **settings)


class _Lines(terminal_tqdm):
    """Writes a line where tqdm draws over the last one."""

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        self.fp.write(f"{self}\n")

    def close(self) -> None:
        if not self.disable and self.n > self.last_print_n and self.last_print_t > self.start_t:
            self.display()  # the end, if there was a line before
        self.disable = True
