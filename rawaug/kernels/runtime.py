"""Where code runs: devices by name, threads, and loops compiled by Numba.

PyTorch's loops divide a tensor among threads. The ends of each share go through other instructions than its middle, so
the last bit of a power depends on the number of threads; :func:`one_thread` gives the same bits everywhere. OpenMP's
threads do not survive a fork, and a loop that waits for them never ends, so a forked child stays on one thread.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache, wraps
from itertools import pairwise
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from rawaug.registry import suggest

P = ParamSpec("P")
R = TypeVar("R")

KINDS = ("auto", "cpu", "cuda", "gpu", "mps")
"""``gpu`` is CUDA or Apple's MPS, whichever is available; ``auto`` is that, or else the CPU."""


def find_device(name: str, key: str = "device", count: int = 1) -> torch.device:
    """Find a device by name, one of :data:`KINDS` or a numbered one such as ``cuda:1``; ``key`` opens messages.

    Raises:
        ValueError: if the name is unknown, or this machine does not have ``count`` such devices.
    """
    kind, _, number = name.partition(":")
    if kind not in KINDS or (number and not number.isdigit()):
        raise ValueError(f"{key} {name!r} is unknown; use one of {', '.join(KINDS)}{suggest(kind, KINDS)}")

    devices = {"cuda": torch.cuda.device_count(), "mps": int(torch.backends.mps.is_available())}
    if kind in ("auto", "gpu"):
        if devices["cuda"]:
            kind = "cuda"
        elif devices["mps"]:
            kind = "mps"
        else:
            kind = "cpu" if kind == "auto" else "cuda"

    if kind != "cpu" and int(number or 0) + count > devices[kind]:
        raise ValueError(f"{key} {name!r}: {count} needed, this machine has {devices[kind] or 'none'}; use cpu or auto")
    if number:
        kind = f"{kind}:{number}"
    return torch.device(kind)


_ALIGNMENT = 16
"""A tensor among others begins at a multiple of this many bytes, as any type may."""


def move_together(settings: Iterable[Any], device: torch.device) -> list[Any]:
    """Move the tensors among ``settings`` that are on the host to a device, in one copy that nothing waits for.

    Everything else stays as it is. Each small copy would cost a GPU more time than a pass over a crop.
    """
    moved = list(settings)
    places = [k for k, part in enumerate(moved) if isinstance(part, Tensor) and part.device != device]
    if not places:
        return moved

    pieces, starts, end = [], [], 0
    for k in places:
        piece = moved[k].detach().clone(memory_format=torch.contiguous_format).view(-1).view(torch.uint8)
        gap = -end % _ALIGNMENT
        pieces += [piece.new_zeros(gap), piece]
        starts.append(end + gap)
        end += gap + len(piece)

    packed = torch.cat(pieces)
    if device.type == "cuda":
        packed = packed.pin_memory()
    there = packed.to(device, non_blocking=True)

    for k, start in zip(places, starts, strict=True):
        part = moved[k]
        moved[k] = there[start : start + part.numel() * part.element_size()].view(part.dtype).view(part.shape)
    return moved


def take_pictures(images: Tensor, are_taken: Tensor) -> Tensor:
    """Take some pictures of a batch ``(B, ...)``, chosen on the host by booleans ``(B,)``, without waiting for it."""
    if are_taken.all():
        return images
    (rows,) = move_together([are_taken.nonzero()[:, 0]], images.device)
    return images[rows]


def replace_pictures(images: Tensor, are_replaced: Tensor, by: Tensor) -> Tensor:
    """Put pictures ``(b, ...)`` in the places of some of a batch, written to ``images``; see :func:`take_pictures`."""
    if are_replaced.all():
        return by
    (rows,) = move_together([are_replaced.nonzero()[:, 0]], images.device)
    return images.index_copy_(0, rows, by)


@contextmanager
def one_thread() -> Iterator[None]:
    """Let PyTorch's CPU loops use one thread within this block, or within the decorated function."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def eager(function: Callable[P, R]) -> Callable[P, R]:
    """Run the decorated function without gradients and outside of ``torch.compile``, whose loading takes seconds.

    Dynamo cannot trace Numba, and would turn a generator's seed into a constant. A graph break gives the same bits.
    """

    @wraps(function)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        if torch.compiler.is_compiling():
            return torch.compiler.disable(torch.no_grad()(function))(*args, **kwargs)
        if not torch.is_grad_enabled():  # as inside another such function; entering no_grad again takes 10 us
            return function(*args, **kwargs)
        with torch.no_grad():
            return function(*args, **kwargs)

    return run


_GRAIN = 2**15
"""Waking a thread pays from this many numbers."""

_PIECES = 4
"""Each thread has this many pieces of work, so that a late one does not hold up the others."""

_OPTIONS = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}
"""Fused multiply-adds are allowed: they do not depend on the order of pixels or threads."""


@cache
def has_numba() -> bool:
    """Tell whether loops can be compiled for the CPU."""
    try:
        import numba
    except ImportError:
        return False
    return not numba.config.DISABLE_JIT


def compile_loop(function: Callable[..., Any], allocates: bool = False) -> Callable[..., Any]:
    """Compile the decorated function to machine code that releases the GIL, cached on disk if a folder is writable.

    Numba counts references to every slice, which takes a third of the time of a pass over short rows. Without arrays
    that the loop ``allocates`` itself, nothing has to be counted.
    """
    from numba import njit

    try:
        return njit(cache=True, _nrt=allocates, **_OPTIONS)(function)
    except RuntimeError:  # no writable folder
        return njit(_nrt=allocates, **_OPTIONS)(function)


def compile_part(function: Callable[..., Any], allocates: bool = False) -> Callable[..., Any]:
    """Compile a decorated function that only those of :func:`compile_loop` call; for ``allocates`` see there."""
    from numba import njit

    return njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=allocates, **_OPTIONS)(function)


_pools: dict[int, ThreadPoolExecutor] = {}
"""This maps a number of threads to its pool."""


def _after_fork() -> None:
    _pools.clear()
    if torch.get_num_threads() > 1:
        torch.set_num_threads(1)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


def run_over_rows(rows: int, width: int, run: Callable[[int, int], None]) -> None:
    """Call ``run(start, stop)`` on parts of ``rows`` rows of ``width`` numbers, on as many threads as PyTorch uses."""
    threads = torch.get_num_threads()
    pieces = min(threads * _PIECES, rows, rows * width // _GRAIN)
    if threads == 1 or pieces < 2:
        run(0, rows)
        return

    waiting = deque(pairwise(rows * piece // pieces for piece in range(pieces + 1)))

    def work() -> None:
        while waiting:
            try:
                start, stop = waiting.popleft()
            except IndexError:  # another thread was faster
                return
            run(start, stop)

    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads, "rawaug")
    helpers = [_pools[threads].submit(work) for _ in range(min(threads, pieces) - 1)]
    work()
    for helper in helpers:
        if not helper.cancel():
            helper.result()
