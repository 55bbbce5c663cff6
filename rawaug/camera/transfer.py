r"""Photon transfer: gain, read noise and row noise of a camera from dark frames and pairs of flat ones, by ISO.

Two frames of one even light differ by their noise alone, as the fixed pattern of the pixels and the shape of the light
cancel. In digital numbers (DN) above black, with the second frame B scaled to the mean of the first by
:math:`r = \mu_A / \mu_B`,

.. math:: s^2 = \frac{\mathrm{var}(A - r B)}{1 + r^2}, \qquad
          K = \frac{s_\mathrm{flat}^2 - s_\mathrm{dark}^2}{\mu}, \qquad \mu = \mu_A \frac{1 + r}{1 + r^2},

for each colour of each pair (EMVA Standard 1288, release 4, "photon transfer"). In a single flat, a fixed pattern of
relative deviation p would raise K by the factor :math:`1 + p^2 N` at N electrons. K is the mean over colours and pairs,
weighted by how well each is known, with the interval of 95 % that these weights or, if it is wider, the scatter gives.

Variances are taken within the rows, so row noise does not count. In the difference of two darks, the means of rows of w
pixels vary by :math:`2 (\sigma_\mathrm{row}^2 + \sigma^2 / w)`, which gives the row noise.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from rawaug.bayer import CFA, pack
from rawaug.errors import count_of

_SAME_LEVEL = 0.02
"""Largest relative difference between the means of two flats of one level."""
_CLIPPED = 1e-4
"""Largest share of a flat's pixels that may be at white."""
_PILED_UP = 0.25
"""Share of a dark's pixels at its lowest value above which it is clipped at black."""
_OUTLIER = 8.0
"""Pixels that differ by more standard deviations are left out: their noise is not that of the sensor."""
_NORMAL = 1.96
"""Half the width of an interval of 95 %, in standard deviations."""

Interval = tuple[float, float, float]
"""An estimate, and the lower and the upper end of its interval of 95 %."""


def measure_photon_transfer(
    darks: Iterable[Any], flats: Iterable[Any]
) -> tuple[dict[Any, dict[str, float]], list[str]]:
    """Measure K, sigma and row in DN at each ISO that has two darks and two flats of one level.

    Args:
        darks: frames with the lens capped, such as :class:`rawaug.io.RawFrame`, of a Bayer pattern.
        flats: frames of an even light, two or more at each of several levels; their exposures need not be known.

    Returns:
        ``{"K", "sigma", "row"}`` by ISO (None if the files state none), and lines that say how sure they are, and what
        was left out and why.

    Raises:
        ValueError: if nothing can be measured, the frames are of several cameras or patterns, or only some state their
            ISO.
    """
    darks_by_iso, flats_by_iso = _group_by_iso(darks, "dark"), _group_by_iso(flats, "flat")
    _require_one_camera([*darks_by_iso.values(), *flats_by_iso.values()])

    levels: dict[Any, dict[str, float]] = {}
    lines, reasons = [], []
    for iso in sorted({*darks_by_iso, *flats_by_iso}, key=lambda iso: iso or 0.0):
        at_iso = "without an ISO" if iso is None else f"at ISO {iso:g}"
        try:
            dark_planes = [_in_dn(frame) for frame in darks_by_iso[iso]]
            sigma, row, dark_count = _measure_darks(dark_planes)
            black = torch.stack([planes.mean((1, 2)) for planes in dark_planes]).mean(0)
            pairs, left_out = _pair_up(flats_by_iso[iso], black)
            gain = _measure_gain(pairs, sigma[0] ** 2, dark_count)
        except ValueError as error:
            reasons.append(f"{at_iso}: {error}")
            continue

        levels[iso] = {"K": gain[0], "sigma": sigma[0], "row": row[0]}
        figures = f"K {_written(gain)}, sigma {_written(sigma)}, row {_written(row)} DN"
        lines.append(
            f"{at_iso}: {figures}, from {count_of(len(dark_planes), 'dark')}, {count_of(len(pairs), 'pair')} of flats"
        )
        reasons += [f"{at_iso}: {reason}" for reason in left_out]

    if None in levels and len(levels) > 1:
        raise ValueError("some files state an ISO and some do not; measure them separately")
    if not levels:
        raise ValueError(f"nothing can be measured; {'; '.join(reasons) or 'there are no frames'}")
    return levels, [*lines, *[f"left out {reason}" for reason in reasons]]


def _written(interval: Interval) -> str:
    return "{:.4g} ({:.4g} to {:.4g})".format(*interval)


def _group_by_iso(frames: Iterable[Any], kind: str) -> dict[Any, list[Any]]:
    """Group frames by their ISO; a missing ISO has none."""
    by_iso: dict[Any, list[Any]] = defaultdict(list)
    for frame in frames:
        if frame.cfa not in CFA.__members__:
            raise ValueError(f"{frame.name}: photon transfer takes {kind}s of a Bayer pattern, not {frame.cfa}")
        by_iso[frame.iso].append(frame)
    return by_iso


def _require_one_camera(groups: Sequence[Sequence[Any]]) -> None:
    """Raise ValueError unless all frames are of one camera, pattern, size and grid of DN."""
    for what in ("camera", "cfa", "white", "mosaic"):
        values = set()
        for frame in (frame for group in groups for frame in group):
            value = getattr(frame, what)
            values.add(str(tuple(value.shape)) if what == "mosaic" else str(value))
        if len(values) > 1:
            raise ValueError(f"the frames differ in their {what}, {', '.join(sorted(values))}; measure each separately")


def _in_dn(frame: Any) -> Tensor:
    """Compute the planes ``(4, h, w)`` of a frame in DN above its black level, float64."""
    scale = frame.white - torch.tensor(frame.black, dtype=torch.float64)
    return pack(frame.mosaic[None].double(), frame.cfa)[0] * scale[:, None, None]


def _measure_darks(darks: Sequence[Tensor]) -> tuple[Interval, Interval, int]:
    """Measure sigma and row of darks ``(4, h, w)``, and say on how many values sigma rests."""
    if len(darks) < 2:
        raise ValueError(f"{count_of(len(darks), 'dark')}; two are needed, since noise is what differs between them")
    for planes in darks:
        if float((planes == planes.min()).double().mean()) > _PILED_UP:
            raise ValueError("the darks are clipped at black, so their noise cannot be measured")

    variances, row_variances, count = [], [], 0
    for first, second in zip(darks[::2], darks[1::2], strict=False):  # an odd one counts for the black level alone
        difference = first - second
        difference = difference - difference.mean((1, 2), keepdim=True)
        variance, used = _within_rows(difference)
        variances.append(float(variance.mean()) / 2)
        count += used

        mosaic_rows = difference.unflatten(0, (2, 2)).mean((1, 3))  # R and Gr share a row of the sensor, Gb and B
        row_variances.append(float(mosaic_rows.square().mean()) / 2 - variances[-1] / (2 * difference.shape[-1]))

    sigma = math.sqrt(sum(variances) / len(variances))
    if sigma == 0:
        raise ValueError("the darks do not differ at all")
    deviation = sigma * math.sqrt(0.5 / count)

    row_var = max(sum(row_variances) / len(row_variances), 0.0)
    rows = 2 * darks[0].shape[1] * len(row_variances)
    row_deviation = (row_var + sigma**2 / (2 * darks[0].shape[-1])) * math.sqrt(2 / rows)
    low, high = max(row_var - _NORMAL * row_deviation, 0.0), row_var + _NORMAL * row_deviation
    row = (math.sqrt(row_var), math.sqrt(low), math.sqrt(high))
    return (sigma, sigma - _NORMAL * deviation, sigma + _NORMAL * deviation), row, count


def _within_rows(difference: Tensor) -> tuple[Tensor, int]:
    """Compute the variance ``(4,)`` within the rows of ``(4, h, w)``, less outliers, and the number of values."""
    width = difference.shape[-1]
    within = difference - difference.mean(-1, keepdim=True)
    scale = (1.4826 * within.abs().flatten(1).median(1).values).clamp_min(1.0)
    regular = within.abs() <= _OUTLIER * scale[:, None, None]
    squares = (within.square() * regular).sum((1, 2))
    return squares / regular.sum((1, 2)) * (width / (width - 1)), int(regular.sum())


def _pair_up(flats: Sequence[Any], black: Tensor) -> tuple[list[tuple[Tensor, Tensor]], list[str]]:
    """Pair the flats of a level, as planes ``(4, h, w)`` in DN above the darks, and say what is left out."""
    usable, clipped = [], 0
    for frame in flats:
        if float((frame.mosaic >= frame.mosaic.new_tensor(1.0 - 1e-6)).double().mean()) > _CLIPPED:
            clipped += 1
        else:
            usable.append(_in_dn(frame) - black[:, None, None])
    usable.sort(key=lambda planes: float(planes.mean()))

    pairs, alone = [], 0
    while usable:
        first = usable.pop()
        if usable and float(usable[-1].mean()) >= (1 - _SAME_LEVEL) * float(first.mean()):
            pairs.append((first, usable.pop()))
        else:
            alone += 1

    reasons = []
    if clipped:
        reasons.append(f"{count_of(clipped, 'flat')} clipped at white")
    if alone:
        reasons.append(f"{count_of(alone, 'flat')} without a second one of the same level, within {_SAME_LEVEL:.0%}")
    if not pairs:
        raise ValueError(f"there is no pair of flats of one level ({', '.join(reasons) or 'no flats'})")
    return pairs, reasons


def _measure_gain(pairs: Sequence[tuple[Tensor, Tensor]], read_var: float, dark_count: int) -> Interval:
    """Measure K by pairs of flats ``(4, h, w)`` above black, and a read variance that rests on so many values."""
    gains, weights, signals = [], [], []
    for first, second in pairs:
        means = first.mean((1, 2)), second.mean((1, 2))
        if not bool((means[1] > 0).all()):
            raise ValueError("a flat is no brighter than the darks")
        ratio = means[0] / means[1]
        variance, count = _within_rows(first - ratio[:, None, None] * second)
        variance = variance / (1 + ratio.square())
        signal = means[0] * (1 + ratio) / (1 + ratio.square())

        gains.append((variance - read_var) / signal)
        weights.append((signal / variance).square() * count / 8)  # a variance of n values is known to its root of 2 / n
        signals.append(signal)

    gain, weight, signal = torch.cat(gains), torch.cat(weights), torch.cat(signals)
    total = float(weight.sum())
    mean = float((gain * weight).sum()) / total
    scatter = float((weight * (gain - mean).square()).sum()) / max(len(gain) - 1, 1)
    by_dark = read_var * math.sqrt(2 / dark_count) * float((weight / signal).sum()) / total
    half = _NORMAL * math.sqrt(max(scatter, 1.0) / total + by_dark**2)
    return mean, mean - half, mean + half
