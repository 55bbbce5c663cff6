"""Whether Triton kernels run on this machine's GPU, and the fallback where they do not.

PyTorch's CUDA builds include Triton. Where it is missing, or a kernel cannot be compiled, callers use the same pass in
PyTorch, which is slower, after one warning. With ``TRITON_INTERPRET=1`` in the environment the kernels run on tensors
of the CPU, step by step: for tests.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from typing import TypeVar

import torch
from torch import Tensor

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
