"""Devices by name, found or refused before any work.

PyTorch on one thread.

Its loops share a tensor out among the threads, and the ends of a share are worked on by other instructions than its
middle: the last bit of a power or an exponential depends on the number of threads. One thread gives the same bits
everywhere. Where a step is so small that more threads gain nothing, it also spares the tenfold loss that they bring on
a busy machine.

A child of a fork stays on one thread: the threads of OpenMP, on which PyTorch's loops run, do not survive a fork, and a
loop that waits for them never ends. DataLoader's workers are on one thread anyway.

What ``torch.compile`` leaves as it is written: loops that are compiled already, draws from keyed generators.

Dynamo traces Python into tensor operations. It cannot trace Numba's compiler, and a hash or a generator's seed that it
traced would be a constant of the graph. A step marked :func:`eager` breaks the graph instead and runs as it always
does: the same bits with and without ``torch.compile``.

Whether Triton kernels run on this machine's GPU, and the fallback where they do not.

PyTorch's CUDA builds include Triton. Where it is missing, or a kernel cannot be compiled, callers use the same pass in
PyTorch, which is slower, after one warning. With ``TRITON_INTERPRET=1`` in the environment the kernels run on tensors
of the CPU, step by step: for tests.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor

from rawaug.registry import nearest

KINDS = ("auto", "cpu", "cuda", "gpu", "mps")
"""What may be asked for: ``gpu`` is CUDA or Apple's MPS, whichever there is, and ``auto`` that or else the CPU."""


def find_device(name: str, key: str = "device", count: int = 1) -> torch.device:
    """The device called ``name``, which this machine has.

    Args:
        name: one of :data:`KINDS`; of several GPUs one is chosen by number, as in ``cuda:1``.
        key: opens the messages.
        count: how many such devices are needed.

    Raises:
        ValueError: if there is no such kind of device, or this machine has none of it, or fewer.

    Example:
        >>> find_device("cpu")
        device(type='cpu')
        >>> find_device("cdua")
        Traceback (most recent call last):
        ValueError: device 'cdua' is unknown; use one of auto, cpu, cuda, gpu, mps (nearest: cuda)
    """
    kind, _, number = name.partition(":")
    if kind not in KINDS or (number and not number.isdigit()):
        raise ValueError(f"{key} {name!r} is unknown; use one of {', '.join(KINDS)}{nearest(kind, KINDS)}")
    found = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available())}
    present = next((gpu for gpu, devices in found.items() if devices), None)
    if kind in ("auto", "gpu"):
        kind = present or ("cpu" if kind == "auto" else "cuda")
    if kind != "cpu" and int(number or 0) + count > found[kind]:
        raise ValueError(f"{key} {name!r}: {count} needed, this machine has {found[kind] or 'none'}; use cpu or auto")
    return torch.device(f"{kind}:{number}" if number else kind)


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


P = ParamSpec("P")
R = TypeVar("R")


def eager(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: ``torch.compiler.disable``, without loading the compiler where nothing is compiled (seconds).

    Example:
        >>> @eager
        ... def doubled(x):
        ...     return 2 * x
        >>> doubled(3)
        6
    """

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(function)(*args, **kwargs)
        return function(*args, **kwargs)

    return run


Result = TypeVar("Result")

_refused: list[str] = []


@cache
def _installed() -> bool:
    try:
        import triton  # noqa: F401
    except ImportError:
        return False
    return True


def usable(image: Tensor) -> bool:
    """Whether a kernel should be tried on ``image``."""
    return image.device.type == "cuda" and not _refused and _installed()


def kernel_or(kernel: Callable[[], Result], fallback: Callable[[], Result]) -> Result:
    """The result of ``kernel`` or, from its first failure on, of ``fallback``; the failure is reported as a warning.

    Example:
        >>> kernel_or(lambda: 1, lambda: 2)
        1
    """
    try:
        return kernel()
    except torch.OutOfMemoryError:  # says nothing of the kernel
        raise
    except Exception as error:  # whatever a compiler, its driver or its cache may raise
        _refused.append(type(error).__name__)
        reason = (str(error).splitlines() or [""])[-1]
        warnings.warn(
            f"rawaug's GPU kernel is unavailable, using PyTorch instead: {type(error).__name__}: {reason}", stacklevel=3
        )
        return fallback()
