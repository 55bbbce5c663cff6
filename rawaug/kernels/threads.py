"""PyTorch on one thread.

Its loops share a tensor out among the threads, and the ends of a share are worked on by other instructions than its
middle: the last bit of a power or an exponential depends on the number of threads. One thread gives the same bits
everywhere. Where a step is so small that more threads gain nothing, it also spares the tenfold loss that they bring on
a busy machine.

A child of a fork stays on one thread: the threads of OpenMP, on which PyTorch's loops run, do not survive a fork, and a
loop that waits for them never ends. DataLoader's workers are on one thread anyway.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Within this block, or the decorated function, PyTorch's CPU loops run on one thread.

    Example:
        >>> with one_thread():
        ...     torch.get_num_threads()
        1
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _after_fork() -> None:
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)
