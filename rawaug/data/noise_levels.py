r"""The noise levels of a capture with a clean reference.

    E[(noisy - clean)^2 | clean = y] = shot_var y + read_var

The levels are fitted as a line. Its points are the mean squared differences in equally filled bins of y, weighted by
the inverse variance of these means, 2 (shot_var y + read_var)^2 / n, in a few rounds. Published frames are clipped at
black and white, which narrows their noise, so bins within three standard deviations of black or white are excluded as
long as enough others remain.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

_BINS = 64
_MIN_BINS = 8
"""Minimum number of bins away from black and white for a fit without the others."""
_ROUNDS = 5
_LEAST = 1e-9
"""Minimum of shot_var and read_var."""
_SITES = 2**20
"""Approximate number of sites that are measured of a larger mosaic."""


def measure_noise(clean: np.ndarray, noisy: np.ndarray) -> tuple[float, float]:
    """Measure (shot_var, read_var) of ``noisy``, both positive; the arrays have the same shape, black 0, white 1."""
    signal = np.ravel(clean).astype(np.float64)
    square = (np.ravel(noisy) - signal) ** 2

    signals, squares = [], []
    for sites in np.array_split(np.argsort(signal), _BINS):
        if len(sites):
            signals.append(signal[sites].mean())
            squares.append(square[sites].mean())
    x = np.array(signals)
    y = np.array(squares)

    weight: np.ndarray = np.ones_like(x)
    for _ in range(_ROUNDS):
        shot_var, read_var = _line(x, y, weight)
        variance = shot_var * x + read_var
        reach = 3 * np.sqrt(variance)
        unclipped = (x > reach) & (x < 1 - reach)
        weight = 1 / variance**2
        if unclipped.sum() >= _MIN_BINS:
            weight = np.where(unclipped, weight, 0.0)
    return shot_var, read_var


def measure_levels(clean: Tensor, noisy: Tensor) -> tuple[float, float]:
    """Apply :func:`measure_noise` to two mosaics ``(1, H, W)``, or to about a million of their sites if larger."""
    step = max(1, clean.numel() // _SITES) | 1  # an odd step visits all four sites of the cell
    return measure_noise(clean.flatten()[::step].numpy(), noisy.flatten()[::step].numpy())


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    """Compute slope and offset of the weighted least-squares line through the points, both positive."""
    mean_x = np.average(x, weights=weight)
    mean_y = np.average(y, weights=weight)
    spread = np.average((x - mean_x) ** 2, weights=weight)
    slope = 0.0
    if spread > 0:
        slope = np.average((x - mean_x) * (y - mean_y), weights=weight) / spread

    steepest = max(mean_y / max(mean_x, _LEAST), _LEAST)
    shot_var = float(np.clip(slope, _LEAST, steepest))
    read_var = float(max(mean_y - shot_var * mean_x, _LEAST))
    return shot_var, read_var
