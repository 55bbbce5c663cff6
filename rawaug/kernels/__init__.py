"""Passes over pixels, each with one result in up to three forms, among which :func:`fastest` chooses.

They exist in PyTorch (:mod:`rawaug.kernels.reference`), as loops for the CPU (:mod:`rawaug.kernels.cpu`), and as Triton
kernels for CUDA (:mod:`rawaug.kernels.gpu`). PyTorch runs if Numba or Triton is missing, is switched off
(``NUMBA_DISABLE_JIT=1``), or fails to compile. With ``TRITON_INTERPRET=1``, Triton's kernels run step by step on CPU
tensors, for tests.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar

import torch
from torch import Tensor

from rawaug.kernels import runtime

R = TypeVar("R")

_CPU, _GPU, _GPU_SRGB = "rawaug.kernels.cpu", "rawaug.kernels.gpu", "rawaug.kernels.gpu_srgb"
_PASSES = {
    "cpu": dict.fromkeys(("unprocess", "shot_read", "develop", "render", "smooth"), _CPU),
    "cuda": {
        **dict.fromkeys(("unprocess", "raw_pairs", "colours", "shot_read"), _GPU),
        **dict.fromkeys(("develop", "smooth", "mean_square"), _GPU_SRGB),
    },
}
"""The module that has a pass of a name as loops, for the CPU, or as a Triton kernel."""

_failed: list[str] = []
"""Triton's kernels have raised errors of these names; after one error they are not tried again."""


def can_use_triton(image: Tensor) -> bool:
    """Tell whether to try a Triton kernel on an image of any shape."""
    return image.device.type == "cuda" and not _failed and find_spec("triton") is not None


def fastest(name: str, image: Tensor, *args: Any, otherwise: Callable[[], R]) -> R:
    """Run a pass by the kernel for the device of an image.

    Args:
        name: name of the pass, a function of the modules of kernels.
        image: the image, of any shape.
        args: further arguments of the pass.
        otherwise: the same pass in PyTorch, for devices without a kernel.
    """
    if name in _PASSES["cuda"] and can_use_triton(image):
        return try_kernel(lambda: _load("cuda", name)(image, *args), otherwise)

    if name in _PASSES["cpu"] and image.device.type == "cpu" and runtime.has_numba():
        result: R = _load("cpu", name)(image, *args)
        return result
    return otherwise()


@cache
def _load(kind: str, name: str) -> Callable[..., Any]:
    kernel: Callable[..., Any] = getattr(import_module(_PASSES[kind][name]), name)
    return kernel


def try_kernel(kernel: Callable[[], R], otherwise: Callable[[], R]) -> R:
    """Run a kernel; if it fails, warn and run ``otherwise``."""
    try:
        return kernel()
    except torch.OutOfMemoryError:  # says nothing about the kernel
        raise
    except Exception as error:  # whatever a compiler, its driver or its cache may raise
        _failed.append(type(error).__name__)
        last_line = str(error).strip().rpartition("\n")[2]
        reason = f"{type(error).__name__}: {last_line}"
        warnings.warn(f"rawaug's GPU kernel is unavailable, using PyTorch instead: {reason}", stacklevel=3)
        return otherwise()
