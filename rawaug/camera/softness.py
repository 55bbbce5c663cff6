r"""How soft a camera is: the steepness of the sharpest edges in its RAW, beside that of photographs for the screen.

The greens of a Bayer mosaic are without gaps along diagonals, a distance of sqrt(2) pixels apart. At an edge between
darker and brighter greens :math:`g_{-2} \leq \dots \leq g_3` along a diagonal, the steepness is the share of the edge
that its largest step takes,

.. math:: s = (g_1 - g_0) / (g_3 - g_{-2}),

which knows neither contrast nor exposure. The 0.9 quantile of s over a frame is that of edges in focus. In photographs
scaled down for the screen and then blurred by a Gaussian of deviation :math:`\sigma` it falls as
:data:`STEEPNESS` says, and this is inverted: the result is the blur that makes such photographs as soft as the frame.

A spectrum would tell softness as well, but spectra of scenes differ by more than those of lenses. Frames need edges in
focus; without any they count as softer. Below 0.4 pixels little can be told, as a step of sqrt(2) pixels then takes
most of an edge, and the result is at most 1, the softest that is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rawaug.bayer import CFA

MTF50 = math.sqrt(math.log(2.0) / 2.0) / math.pi
"""The deviation of a Gaussian in pixels times the frequency in cycles a pixel where it halves contrast, 0.187."""

PUBLISHED = (0.0, 1.0)
"""A range of blur in pixels for cameras of which nothing is known. To be as soft as frames of five cameras (Canon S40
and G2, GoPro HERO6 and HERO7, Nikon D5000), sharp photographs need 0.5 to 1, and photographs that are soft themselves 0
to 1 (``python -m benchmarks.softness``). ``recipes/base.yaml`` draws it: after a short training its networks gain by
it at every strength and on real noise (docs/results_isp.md). Elsewhere it is not drawn by default."""

STEEPNESS = {0.0: 0.696, 0.4: 0.672, 0.5: 0.633, 0.6: 0.589, 0.7: 0.538, 0.8: 0.501, 1.0: 0.451}
"""The steepness of photographs by the blur in pixels: the median of the 0.9 quantiles of 69 (the same benchmark)."""

_QUANTILE = 0.9
_MOST_SITES = 2**22
"""Only so many sites in the middle of a frame are looked at."""
_LEAST_EDGES = 200
"""A frame needs this many edges."""


def edge_steepness(mosaic: NDArray[np.floating[Any]], cfa: CFA | str) -> NDArray[np.floating[Any]]:
    """Measure s of every edge between the greens of a mosaic.

    Args:
        mosaic: ``(H, W)``, linear, black 0, white 1, with little noise.
        cfa: its pattern.

    Returns:
        The steepness of N edges, ``(N,)``, in no particular order.
    """
    height, width = mosaic.shape
    rows, columns = np.ogrid[2 : height - 3, 3 : width - 3]
    green = (rows + columns + sum(CFA(cfa).sites[1])) % 2 == 0

    shares = []
    for direction in (1, -1):
        values = []
        for k in range(-2, 4):
            values.append(mosaic[2 + k : height - 3 + k, 3 + k * direction : width - 3 + k * direction])
        steps = np.diff(np.stack(values), axis=0)
        noise = np.median(np.abs(steps[1] - steps[0])[green]) / 0.6745 / math.sqrt(6.0)

        edge, mean = values[5] - values[0], 0.5 * (values[0] + values[5])
        height_of_edge = np.abs(edge)
        is_edge = green & (mean > 0.03) & (np.maximum(values[0], values[5]) < 0.9)
        is_edge &= (height_of_edge > 0.5 * mean) & (height_of_edge > 20.0 * noise)
        is_edge &= (steps * np.sign(edge) > -0.05 * height_of_edge).all(axis=0)
        is_edge &= np.abs(steps[2]) >= np.abs(steps).max(axis=0)
        shares.append((steps[2] / np.where(is_edge, edge, 1.0))[is_edge])
    return np.concatenate(shares)


def measure_blur(frames: Iterable[tuple[NDArray[np.floating[Any]], CFA | str]]) -> float | None:
    """Measure the blur that makes photographs for the screen as soft as the frames of a camera.

    Args:
        frames: mosaics ``(H, W)``, linear, black 0, white 1, and their patterns.

    Returns:
        The median over the frames, a standard deviation in pixels from 0 to 1; None if no frame has enough edges.
    """
    quantiles = []
    for mosaic, cfa in frames:
        side = math.isqrt(_MOST_SITES)
        top, left = (max(length - side, 0) // 4 * 2 for length in mosaic.shape)  # even, so that the pattern stays
        steepness = edge_steepness(mosaic[top : top + side, left : left + side], cfa)
        if len(steepness) >= _LEAST_EDGES:
            quantiles.append(np.quantile(steepness, _QUANTILE))

    if not quantiles:
        return None
    falling = sorted(STEEPNESS.items(), reverse=True)
    deviations, table = zip(*falling, strict=True)
    return float(np.interp(np.median(quantiles), table, deviations))
