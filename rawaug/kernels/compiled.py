"""Loops over pixels that are compiled on first use, and the threads they run on.

Numba compiles for the current CPU, without an installed compiler, and keeps the result on disk: beside the source,
in the user's cache folder where that is not writable, or where ``NUMBA_CACHE_DIR`` says. The loops work on rows and
release the GIL, so that plain threads share them out: as many as ``torch.get_num_threads()``, which is 1 in a
DataLoader's worker. A result never depends on their number. Where Numba is missing, or ``NUMBA_DISABLE_JIT=1`` turns it
off, :func:`available` says so and the callers fall back on PyTorch.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any

import torch

_GRAIN = 2**15
"""Numbers that are worth a thread's waking."""

_PIECES = 4
"""Pieces for each thread, so that one that is held up does not hold up the others."""


@cache
def available() -> bool:
    """Whether loops can be compiled here."""
    try:
        import numba
    except ImportError:
        return False
    return not numba.config.DISABLE_JIT


_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""Multiplications and additions may be contracted, which no order of pixels or threads changes."""


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: the function as machine code, without the GIL, kept on disk where there is a place to keep it."""
    from numba import njit

    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # no folder to keep it in is writable
        return njit(**_OPTIONS)(function)


def part(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: what only :func:`compiled` functions of the same module call; it becomes part of them."""
    from numba import njit

    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **_OPTIONS)(function)


class _Pool:
    """The threads of this process; a forked child starts without, for threads do not survive a fork."""

    def __init__(self) -> None:
        self.executor: ThreadPoolExecutor | None = None
        self.threads = 0

    def of(self, threads: int) -> ThreadPoolExecutor:
        if self.executor is None or self.threads != threads:
            self.executor, self.threads = ThreadPoolExecutor(threads, "rawaug"), threads
        return self.executor

    def forget(self) -> None:
        self.executor = None


_pool = _Pool()
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.forget)


def over_rows(rows: int, width: int, run: Callable[[int, int], None]) -> None:
    """Call ``run(start, stop)`` for parts of ``rows`` rows of ``width`` numbers, until all are done.

    Example:
        >>> done = []
        >>> over_rows(3, 4, lambda start, stop: done.extend(range(start, stop)))
        >>> done
        [0, 1, 2]
    """
    threads = torch.get_num_threads()
    pieces = min(threads * _PIECES, rows, rows * width // _GRAIN)
    if threads == 1 or pieces < 2:
        run(0, rows)
        return
    edges = [rows * piece // pieces for piece in range(pieces + 1)]
    waiting = deque(pairwise(edges))

    def work() -> None:
        while waiting:
            try:
                start, stop = waiting.popleft()
            except IndexError:  # another thread was faster
                return
            run(start, stop)

    helpers = [_pool.of(threads).submit(work) for _ in range(min(threads, pieces) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():
            helper.result()
