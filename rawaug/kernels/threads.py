"""PyTorch on one thread.

Its loops share a tensor out among the threads, and the ends of a share are worked on by other instructions than its
middle: the last bit of a power or an exponential depends on the number of threads. One thread gives the same bits
everywhere. Where a step is so small that more threads gain nothing, it also spares the tenfold loss that they bring on
a busy machine.
"""

from __future__ import annotations

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
