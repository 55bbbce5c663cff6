"""What ``torch.compile`` leaves as it is written: loops that are compiled already, draws from keyed generators.

Dynamo traces Python into tensor operations. It cannot trace Numba's compiler, and a hash or a generator's seed that it
traced would be a constant of the graph. A step marked :func:`eager` breaks the graph instead and runs as it always
does: the same bits with and without ``torch.compile``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

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
