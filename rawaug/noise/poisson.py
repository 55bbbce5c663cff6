r"""Poisson counts from normal draws, on any device.

.. math:: k = F^{-1}_\lambda(\Phi(w)), \qquad w \sim N(0, 1)

with :math:`F_\lambda` the Poisson distribution function, :math:`\lambda \ge 0`. Below :data:`INVERSION_LIMIT` the sum
over k is walked; from there on the inverse's asymptotic (Cornish-Fisher) expansion in :math:`\lambda^{-1/2}` is rounded
down (Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution function", ACM TOMS 2016). One
normal draw a count and no rejection, so that a count depends on its own draw alone. ``torch.poisson`` is not used: on
CUDA its streams are poor and it fails at high rates.
"""

from __future__ import annotations

import torch
from torch import Tensor

INVERSION_LIMIT = 10.0
"""Rates below it are drawn by walking the sum; from it on the expansion's distribution function is right to 5e-5."""

_CACHED = 2**15  # as in models.py; smaller, because more arrays are at work


def poisson(rate: Tensor, normals: Tensor) -> Tensor:
    """Poisson counts for the expected counts ``rate >= 0``, any shape, float32 or float64, as floats of the same type.

    Args:
        rate: expected counts.
        normals: a standard normal draw for each, contiguous; the counts are written over them.

    Example:
        >>> counts = poisson(torch.full((1000,), 3.0), torch.randn(1000, generator=torch.Generator().manual_seed(0)))
    """
    piece = _CACHED if rate.device.type == "cpu" else max(rate.numel(), 1)
    for part, out in zip(rate.reshape(-1).split(piece), normals.view(-1).split(piece), strict=True):
        low = part < INVERSION_LIMIT
        walked = _walked(part[low], out[low]).to(out)
        out.copy_(_expanded(part, out))
        out[low] = walked
    return normals


def _expanded(rate: Tensor, w: Tensor) -> Tensor:
    """Giles' expansion to the order 1 / rate, rounded down."""
    root = rate.clamp(min=INVERSION_LIMIT).sqrt()
    w2 = w * w
    tail = (-8 / 405 + w2 * (7 / 810 + w2 / 270)) / root - w * (1 / 36 + w2 / 72)
    return (rate + w * root + (1 / 3 + w2 / 6) + tail / root).floor_().clamp_(min=0)


def _walked(rate: Tensor, w: Tensor) -> Tensor:
    """The number of k with F(k) < Phi(w), in double precision: in single, the sum would stop short of the far tail."""
    rate, u = rate.double(), torch.special.ndtr(w.double()).clamp_(max=1 - 1e-13)  # which the sum does reach
    term = torch.exp(-rate)
    total, count, k = term.clone(), torch.zeros_like(rate), 0
    while (below := total < u).any():
        k += 1
        count += below
        term *= rate / k
        total += term
    return count
