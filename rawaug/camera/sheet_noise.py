"""The noise that a camera's data sheet states by ISO, as variances with white = 1.

With a gain of K digital numbers (DN) per electron, read noise of sigma DN and V DN from black to white,

    shot_var = K / V,    read_var = sigma^2 / V^2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any, NamedTuple

_MOST_HOT = 0.1
_LARGEST_VAR = 0.2
"""A shot_var above it means fewer than five electrons at white; such numbers are more likely in DN."""


class Level(NamedTuple):
    """The noise of a camera at one ISO, as variances with white = 1; what is not stated is None."""

    iso: float | None
    shot_var: float
    read_var: float
    row_var: float | None = None
    column_var: float | None = None
    tukey_lambda: float | None = None
    hot_share: float | None = None


def read_levels(noise: Any, in_dn: bool, full_scale: float | None) -> list[Level]:
    """Read the noise of a sheet.

    Args:
        noise: what the sheet states, see :class:`rawaug.camera.own.Camera`; None for nothing.
        in_dn: whether levels without names are (K, sigma) in DN.
        full_scale: DN from black to white; None if the sheet does not say.

    Returns:
        The levels by ISO, ascending.

    Raises:
        ValueError: if they cannot be read, or are out of range.
    """
    if noise is None:
        return []
    if not isinstance(noise, dict) or set(noise) & {"shot_var", "read_var", "K", "sigma"}:
        return [_read_level(None, noise, "", in_dn, full_scale)]

    levels = []
    for iso, values in noise.items():
        try:
            number = float(iso)
        except (TypeError, ValueError):
            number = math.nan

        if not 0 < number < math.inf:
            raise ValueError(f"noise has levels by ISO, a positive number, got {iso!r:.100}")

        levels.append(_read_level(number, values, f" at ISO {number:g}", in_dn, full_scale))

    return sorted(levels, key=lambda level: level.iso or 0.0)


def _read_level(iso: float | None, values: Any, where: str, in_dn: bool, full_scale: float | None) -> Level:
    """Read the level of one ISO."""
    further: dict[str, Any] = {}
    if isinstance(values, dict):
        in_dn = bool(set(values) & {"K", "sigma", "row", "column"})
        pair = ("K", "sigma") if in_dn else ("shot_var", "read_var")
        lines = ("row", "column") if in_dn else ("row_var", "column_var")
        known = (*pair, *lines, "lambda", "hot")
        if not set(pair) <= set(values) <= set(known):
            further_keys = ", ".join(known[2:])
            rule = f"is {{{pair[0]}, {pair[1]}}} and, if known, {further_keys}"
            raise ValueError(f"noise {where} {rule}, got {', '.join(map(str, values))}")
        further = {key: values[key] for key in known[2:] if key in values}
        values = [values[pair[0]], values[pair[1]]]

    if not isinstance(values, list) or len(values) != 2 or not all(map(is_number, [*values, *further.values()])):
        raise ValueError(f"noise {where} must be two numbers, got {values!r:.100} {further or ''}".rstrip())

    first, second = float(values[0]), float(values[1])
    row, column = further.get("row_var"), further.get("column_var")
    if min(first, second, *[value for key, value in further.items() if key != "lambda"]) < 0:
        raise ValueError(f"noise {where} must not be negative, got {first:g} and {second:g} {further or ''}")
    advice = "(K, sigma) in DN needs noise_in='DN'"
    if in_dn:
        if full_scale is None:
            raise ValueError(f"noise {where} is in DN: give white_level or bits, and black_level")
        first, second = first / full_scale, (second / full_scale) ** 2
        row, column = further.get("row"), further.get("column")
        row = None if row is None else (row / full_scale) ** 2
        column = None if column is None else (column / full_scale) ** 2
        advice = "check K, sigma and the levels"

    if max(first, second, row or 0.0, column or 0.0) > _LARGEST_VAR:
        raise ValueError(f"noise {where} has variances {first:g} and {second:g}, as no sensor has; {advice}")
    if not -0.5 < further.get("lambda", 0.0) <= 2.0 or further.get("hot", 0.0) > _MOST_HOT:
        rule = f"has a lambda above -0.5 and at most 2, and at most {_MOST_HOT:g} of its pixels are hot"
        raise ValueError(f"noise {where} {rule}, got {further}")
    return Level(iso, first, second, row, column, further.get("lambda"), further.get("hot"))


def check_levels(levels: Sequence[Level], quantum: float) -> None:
    """Raise ValueError for levels that no sensor has; ``quantum`` is the step of rounding, white = 1, or 0."""
    values = [level.iso for level in levels]
    if len(set(values)) < len(values) or (None in values and len(values) > 1):
        raise ValueError(f"noise must have a level for each ISO, or a single one without, got {values}")

    known = [level for level in levels if level.iso is not None and level.shot_var > 0]
    if len(known) > 1 and known[-1].shot_var < 0.9 * known[0].shot_var:
        raise ValueError("noise falls with ISO; K is in DN per electron, the reciprocal of electrons per DN")
    if len(known) > 1 and known[-1].iso >= 4 * known[0].iso:  # type: ignore[operator]
        growth = math.log(known[-1].shot_var / known[0].shot_var) / math.log(known[-1].iso / known[0].iso)  # type: ignore[operator]
        if 0.45 < growth < 0.55:
            raise ValueError("noise grows with the root of ISO; are these deviations? Give their squares")
    for level in levels:
        if level.read_var > level.shot_var > 0:
            reason = f"of {level.read_var:.3g} in read_var is more than the shot noise at white, {level.shot_var:.3g}"
            raise ValueError(f"noise {reason}, as no sensor has; is it a deviation?")

    if len({tuple(value is None for value in level[3:]) for level in levels}) > 1:
        raise ValueError("noise states row, column, lambda or hot at some ISO values only; state it at all")

    rounding = quantum**2 / 12
    for level in levels:
        if level.shot_var < 0 or level.read_var < rounding:
            at = "" if level.iso is None else f" at ISO {level.iso:g}"
            reason = f"{level.read_var:.3g} of read_var{at} is less than rounding alone makes, {rounding:.3g}"
            raise ValueError(f"noise {reason}; leave out bits to round nothing")


def is_number(value: Any) -> bool:
    """Tell whether a figure of a sheet is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
