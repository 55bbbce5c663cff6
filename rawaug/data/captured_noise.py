r"""Noise levels of a capture whose clean version is known.

    E[(noisy - clean)^2 | clean = y] = shot_var y + read_var

A line through the mean squared differences of equally filled bins of y, weighted by the inverse variance of these
means, 2 (shot_var y + read_var)^2 / n, in a few rounds. Bins whose noise would reach black or white (three standard
deviations) are left out while enough others remain: published frames are clipped there, which narrows the noise.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

_BINS = 64
_FEWEST = 8
_ROUNDS = 5
_LEAST = 1e-9
_SITES = 2**20


def captured_noise(clean: np.ndarray, noisy: np.ndarray) -> tuple[float, float]:
    """(shot_var, read_var) of ``noisy``, both positive; arrays of the same shape, black 0, white 1.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> clean = rng.random((300, 300))
        >>> noisy = clean + rng.normal(size=clean.shape) * np.sqrt(0.01 * clean + 0.0004)
        >>> captured_noise(clean, noisy)  # doctest: +ELLIPSIS
        (0.01..., 0.0003...)
    """
    signal = np.ravel(clean).astype(np.float64)
    square = (np.ravel(noisy) - signal) ** 2
    order = np.argsort(signal)
    parts = [part for part in np.array_split(order, _BINS) if len(part)]
    x, y = (np.array([values[part].mean() for part in parts]) for values in (signal, square))
    weight: np.ndarray = np.ones_like(x)
    for _ in range(_ROUNDS):
        shot, read = _line(x, y, weight)
        reach = 3 * np.sqrt(shot * x + read)
        whole = (x > reach) & (x < 1 - reach)
        weight = np.where(whole if whole.sum() >= _FEWEST else True, 1 / (shot * x + read) ** 2, 0.0)
    return shot, read


def measured_levels(clean: Tensor, noisy: Tensor) -> tuple[float, float]:
    """:func:`captured_noise` of two mosaics ``(1, H, W)``, of about a million of their sites if they are larger."""
    step = max(1, clean.numel() // _SITES) | 1  # odd, so that all four sites of the cell take part
    return captured_noise(clean.flatten()[::step].numpy(), noisy.flatten()[::step].numpy())


def _line(x: np.ndarray, y: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    middle = np.average(x, weights=weight), np.average(y, weights=weight)
    spread = np.average((x - middle[0]) ** 2, weights=weight)
    slope = np.average((x - middle[0]) * (y - middle[1]), weights=weight) / spread if spread > 0 else 0.0
    shot = float(np.clip(slope, _LEAST, max(middle[1] / max(middle[0], _LEAST), _LEAST)))
    return shot, float(max(middle[1] - shot * middle[0], _LEAST))
