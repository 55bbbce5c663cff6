"""Progress on stderr: a bar in a terminal; elsewhere, as in the log of a job, one plain line every 30 seconds.

The environment variable ``RAWAUG_PROGRESS_SECONDS`` sets another interval. What is over within it prints no line.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sized
from typing import Any, TextIO

from tqdm.asyncio import tqdm as terminal_tqdm
from tqdm.auto import tqdm

LINE = "{desc}: {n_fmt}/{total_fmt} {unit}s, {elapsed} elapsed, {remaining} left{postfix}"


def progress(
    items: Iterable[Any] | None = None,
    *,
    label: str,
    unit: str,
    total: int | None = None,
    initial: int = 0,
    leave: bool = False,
    shown: bool = True,
    stream: TextIO | None = None,
) -> Any:
    """A tqdm bar over ``items``; without them, its ``update`` is called at every step.

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
    options: dict[str, Any] = {"desc": label, "unit": unit, "total": total, "initial": initial, "disable": not shown}
    if stream.isatty() or tqdm is not terminal_tqdm:  # tqdm.auto is another class in a notebook
        return tqdm(items, file=stream, leave=leave, **options)
    seconds = float(os.environ.get("RAWAUG_PROGRESS_SECONDS", "30"))
    pace: dict[str, Any] = {"mininterval": seconds, "maxinterval": float("inf"), "miniters": 1, "delay": seconds}
    return terminal_tqdm(items, file=_Lines(stream), leave=True, bar_format=LINE, **pace, **options)


class _Lines:
    """Turns what a bar redraws in place into whole lines."""

    def __init__(self, stream: TextIO) -> None:
        self.stream = stream

    def write(self, text: str) -> None:
        """Write what there is to read of ``text`` as one line."""
        text = text.replace("\x1b[A", "").strip()
        if text:
            self.stream.write(f"{text}\n")

    def flush(self) -> None:
        """Hand on what is written."""
        self.stream.flush()
