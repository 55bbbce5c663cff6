r"""Variance stabilisation: the generalised Anscombe transform and its exact unbiased inverse.

.. math:: z = \frac{2}{s} \sqrt{\max(s y + \tfrac{3}{8} s^2 + r, 0)}

with s = ``shot_var`` and r = ``read_var``, turns Poisson-Gaussian noise of variance s y + r into noise of variance 1,
which a denoiser for white Gaussian noise can handle (Starck, Murtagh and Bijaoui 1998). A denoiser gives the mean of z.
The algebraic inverse of a mean is biased, because the root is concave. The exact unbiased inverse maps E[z | y] back
to y (Makitalo and Foi, "Optimal inversion of the generalized Anscombe transformation for Poisson-Gaussian noise",
2013). Below :data:`TABLE_COUNTS` photons it is a table computed by integration; above, it is its limit
:math:`y = s (z^2/4 - 1/8) - r/s`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

TABLE_COUNTS = 60.0
"""Expected photon counts up to which E[z | y] is integrated; beyond, the closed form errs by less than 1e-3 photons."""


def forward(y: Tensor, shot_var: float | Tensor, read_var: float | Tensor) -> Tensor:
    """Transform noisy RAW ``(B, ...)`` so that its noise has variance 1.

    ``shot_var`` and ``read_var`` are numbers, or tensors ``(B,)`` with one for each picture, white = 1.

    Raises:
        ValueError: if a ``shot_var`` is not positive (its noise is white already), or a ``read_var`` is negative.

    Example:
        >>> z = forward(torch.full((1, 4, 2, 2), 0.25), 1e-3, 1e-5)
        >>> torch.allclose(inverse(z, 1e-3, 1e-5), torch.tensor(0.25), atol=1e-3)
        True
    """
    s, r = _levels(y, shot_var, read_var)
    return (s * y + 0.375 * s.square() + r).clamp_(min=0).sqrt_().mul_(2 / s)


def inverse(z: Tensor, shot_var: float | Tensor, read_var: float | Tensor) -> Tensor:
    """Invert :func:`forward` without bias.

    The result is the clean RAW whose transformed noisy RAW has the mean ``z`` ``(B, ...)``. It is never below
    black; the levels are as in :func:`forward`.
    """
    levels = torch.stack(_levels(z, shot_var, read_var)).flatten(1)

    pictures = []
    for picture, s, r in zip(z, *levels.tolist(), strict=True):
        pictures.append(s * _counts(picture, math.sqrt(r) / s))
    return torch.stack(pictures)


def _levels(like: Tensor, shot_var: float | Tensor, read_var: float | Tensor) -> tuple[Tensor, Tensor]:
    """s and r of each picture, ``(B, 1, ...)``."""
    shape = (len(like), *(1,) * (like.ndim - 1))
    s = torch.as_tensor(shot_var).to(like).expand(len(like)).reshape(shape)
    r = torch.as_tensor(read_var).to(like).expand(len(like)).reshape(shape)

    if not (s > 0).all() or not (r >= 0).all():
        raise ValueError(f"variance stabilisation needs shot_var > 0 and read_var >= 0, got {shot_var} and {read_var}")
    return s, r


def _counts(z: Tensor, sigma: float) -> Tensor:
    """Look up the expected photons for the mean z, with read noise of ``sigma`` photons."""
    counts, means = _table(sigma)
    counts, means = counts.to(z), means.to(z)

    right = torch.searchsorted(means, z.contiguous()).clamp_(1, len(means) - 1)
    step = (means[right] - means[right - 1]).clamp_min(torch.finfo(z.dtype).tiny)  # 0 for the first at a high sigma

    low = torch.lerp(counts[right - 1], counts[right], ((z - means[right - 1]) / step).clamp(0, 1))
    high = z.square() / 4 - 0.125 - sigma**2
    return torch.where(z > means[-1], high, low)


def _table(sigma: float) -> tuple[Tensor, Tensor]:
    """Tabulate expected counts and E[z], the Poisson sum over k of E[2 sqrt(k + sigma n + 3/8 + sigma^2)]."""
    counts = torch.linspace(0, math.sqrt(TABLE_COUNTS), 512, dtype=torch.float64).square()
    k = torch.arange(0.0, 3 * TABLE_COUNTS, dtype=torch.float64)
    n = torch.linspace(-8, 8, 801, dtype=torch.float64)

    weights = torch.exp(-n.square() / 2)
    root = 2 * (k[:, None] + sigma * n + 0.375 + sigma**2).clamp_(min=0).sqrt_()
    means_by_count = root @ (weights / weights.sum())

    log_pmf = torch.special.xlogy(k, counts[:, None]) - counts[:, None] - torch.lgamma(k + 1)
    return counts, log_pmf.exp() @ means_by_count
