"""What is known of a RAW mosaic besides its numbers, as a file states it or a user gives it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA


@dataclass(frozen=True)
class Statements:
    """What is known of a mosaic besides its numbers; None where it is not."""

    cfa: CFA | None = None
    black: tuple[float, ...] | None = None
    white: float | None = None
    white_balance: tuple[float, float, float] | None = None
    color_matrix: Tensor | None = None
    shot_var: float | None = None
    read_var: float | None = None

    @classmethod
    def parse(cls, values: Mapping[str, Any], where: str | Path) -> Statements:
        """Of plain values or arrays; other keys are left out.

        Raises:
            ValueError: if a value is not of its kind, naming ``where`` it comes from.
        """
        parsed: dict[str, Any] = {}
        for key, value in values.items():
            if key not in KINDS or value is None:
                continue
            try:
                parsed[key] = KINDS[key](value)
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"{where}: {key} is not valid: {' '.join(str(error).split())}") from error
        return cls(**parsed)

    def joined(self, given: Statements, file: Path) -> Statements:
        """These statements of ``file``, and what is ``given`` where it has none.

        Raises:
            ValueError: if both say something, but not the same.
        """
        for key in ("cfa", "black", "white"):
            own, other = getattr(self, key), getattr(given, key)
            if own is not None and other is not None and own != other:
                raise ValueError(f"{file}: states {key} {shown(own)}, not {shown(other)} as given; leave {key} out")
        chosen = {key: getattr(given, key) if getattr(self, key) is None else getattr(self, key) for key in KINDS}
        return Statements(**chosen)


def levels(value: Any) -> tuple[float, ...]:
    """One level, or those of R, Gr, Gb, B; four equal ones are one."""
    floats = _floats(value)
    found = floats[:1] if len(set(floats)) == 1 else floats
    if len(found) not in (1, 4):
        raise ValueError(f"{len(found)} levels; use one, or those of R, Gr, Gb, B")
    return found


def _floats(value: Any) -> tuple[float, ...]:
    floats = tuple(float(number) for number in np.ravel(value))
    if not floats or not np.isfinite(floats).all():
        raise ValueError(f"{np.ravel(value).tolist()} must be finite numbers")
    return floats


def _one(value: Any) -> float:
    (number,) = _floats(value)
    return number


def _variance(value: Any) -> float:
    if _one(value) < 0:
        raise ValueError(f"{_one(value):g} is negative")
    return _one(value)


def _gains(value: Any) -> tuple[float, float, float]:
    red, green, blue = _floats(value)
    if min(red, green, blue) <= 0:
        raise ValueError(f"{red:g}, {green:g}, {blue:g} must be positive")
    return red / green, 1.0, blue / green


def _matrix(value: Any) -> Tensor:
    return torch.tensor(_floats(value)).reshape(3, 3)


def _pattern(value: Any) -> CFA:
    return CFA(str(value if isinstance(value, str) else np.ravel(value)[0]).strip().upper())


KINDS = {
    "cfa": _pattern,
    "black": levels,
    "white": _one,
    "white_balance": _gains,
    "color_matrix": _matrix,
    "shot_var": _variance,
    "read_var": _variance,
}
"""What may be stated, and how each is read."""


def shown(value: Any) -> str:
    """A CFA or levels in a message."""
    return "/".join(f"{level:g}" for level in value) if isinstance(value, tuple) else f"{value}"
