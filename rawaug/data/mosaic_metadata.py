"""The metadata of a mosaic in a file other than camera RAW: pattern, levels, colours and noise, parsed by key.

The caller must give the CFA and levels that a file does not state, and cannot override those that it states.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rawaug.bayer import CFA

Metadata = dict[str, Any]
"""The metadata of a mosaic, by the keys of :data:`KINDS`."""


def parse_metadata(values: Mapping[str, Any], where: str | Path) -> Metadata:
    """Parse metadata from plain values or arrays; other keys, and values of None, are ignored."""
    metadata: Metadata = {}
    for key, value in values.items():
        if key not in KINDS or value is None:
            continue
        try:
            metadata[key] = KINDS[key](value)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{where}: {key} is not valid: {' '.join(str(error).split())}") from error
    return metadata


def complete_metadata(own: Metadata, others: Metadata, file: Path) -> Metadata:
    """Add the metadata of the caller (``others``) to a file's ``own``; ValueError if they contradict each other."""
    for key, value in others.items():
        if key in own and own[key] != value:
            contrast = f"{format_value(own[key])}, not {format_value(value)} as given"
            raise ValueError(f"{file}: states {key} {contrast}; leave {key} out")
    return others | own


def levels(value: Any) -> tuple[float, ...]:
    """Parse one level, or the levels of R, Gr, Gb, B; four equal levels become one."""
    numbers = _floats(value)
    if len(set(numbers)) == 1:
        numbers = numbers[:1]
    if len(numbers) not in (1, 4):
        raise ValueError(f"{len(numbers)} levels; use one, or those of R, Gr, Gb, B")
    return numbers


def _floats(value: Any) -> tuple[float, ...]:
    floats = tuple(map(float, np.ravel(value)))
    if not floats or not np.isfinite(floats).all():
        raise ValueError(f"{np.ravel(value).tolist()} must be finite numbers")
    return floats


def _one(value: Any) -> float:
    (number,) = _floats(value)
    return number


def _variance(value: Any) -> float:
    variance = _one(value)
    if variance < 0:
        raise ValueError(f"{variance:g} is negative")
    return variance


def _gains(value: Any) -> tuple[float, float, float]:
    red, green, blue = _floats(value)
    if min(red, green, blue) <= 0:
        raise ValueError(f"{red:g}, {green:g}, {blue:g} must be positive")
    return red / green, 1.0, blue / green


def _cfa(value: Any) -> CFA:
    names = np.ravel(value)
    if len(names) != 1:
        raise ValueError(f"{len(names)} names; use one of {', '.join(CFA)}")
    name = names[0]
    if isinstance(name, bytes):  # as MATLAB and h5py give text
        name = name.decode("ascii")
    return CFA(str(name).strip().upper())


def _matrix(value: Any) -> Tensor:
    return torch.tensor(_floats(value)).reshape(3, 3)


KINDS: dict[str, Callable[[Any], Any]] = {
    "cfa": _cfa,
    "black": levels,
    "white": _one,
    "white_balance": _gains,
    "color_matrix": _matrix,
    "shot_var": _variance,
    "read_var": _variance,
}
"""The keys of metadata, each with the function that parses its value."""


def format_value(value: Any) -> str:
    """Format a value for messages; levels are separated by slashes."""
    if isinstance(value, tuple):
        return "/".join(f"{level:g}" for level in value)
    return str(value)
