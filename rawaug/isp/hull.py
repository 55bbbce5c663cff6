r"""What a colour dictionary can make: the nearest mixture of its atoms, and atoms chosen to reach many cameras.

Two matrices C and C' differ on pictures of second moment :math:`S = E[x x^T]`, x in linear sRGB, by

.. math:: \mathrm{MSE} = \tfrac{1}{3} \| (C - C') S^{1/2} \|_F^2 .

In the coordinates :math:`C S^{1/2} / \sqrt 3` that is a squared Euclidean distance, and the best mixture the projection
on the hull of the atoms, found by accelerated projected gradients (Beck and Teboulle, FISTA, 2009) with restarts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.isp.dictionary import project_to_simplex

_STEPS = 400
_CANDIDATES = 24


def second_moment(linear: Tensor) -> Tensor:
    """``E[x x^T]`` ``(3, 3)`` float64 of colours ``(3, P)``."""
    return linear.double() @ linear.double().T / linear.shape[1]


def colour_coordinates(matrices: Tensor, moment: Tensor) -> Tensor:
    """``(N, 3, 3)`` to points ``(N, 9)`` whose squared distance is the mean squared error on such pictures."""
    values, vectors = torch.linalg.eigh(moment.double())
    root = vectors @ torch.diag(values.clamp_min(0.0).sqrt()) @ vectors.T
    return (matrices.double() @ root / 3**0.5).flatten(1)


def nearest_in_hull(points: Tensor, atoms: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest convex combinations of ``atoms`` ``(..., N, D)``, one hull or several, to ``points`` ``(P, D)``.

    Returns:
        Weights ``(..., P, N)`` on the simplex, and squared distances ``(..., P)``.
    """
    gram, correlation = atoms @ atoms.mT, points @ atoms.mT
    rate = 1.0 / torch.linalg.eigvalsh(gram)[..., -1:, None]
    weights = torch.full_like(correlation, 1.0 / atoms.shape[-2])
    ahead, momentum = weights, torch.ones_like(correlation[..., :1])
    for _ in range(_STEPS):
        gradient = ahead @ gram - correlation
        new = project_to_simplex((ahead - rate * gradient).flatten(0, -2)).reshape(weights.shape)
        uphill = (gradient * (new - weights)).sum(dim=-1, keepdim=True) > 0
        momentum = torch.where(uphill, torch.ones_like(momentum), momentum)
        later = 0.5 * (1.0 + (1.0 + 4.0 * momentum**2).sqrt())
        ahead = new + (momentum - 1.0) / later * (new - weights)
        weights, momentum = new, later
    return weights, (weights @ atoms - points).square().sum(dim=-1)


def psnr(squared_error: Tensor) -> Tensor:
    """PSNR in dB, data range 1."""
    return -10.0 * squared_error.clamp_min(1e-20).log10()


def greedy_atoms(points: Tensor, count: int, decibel: float = 45.0) -> list[int]:
    """Indices of ``count`` points ``(P, D)`` whose hull reaches as many of all of them as possible.

    The first is the point farthest from the mean. Each next one is, among the 24 that are farthest from the hull so
    far, that which leaves the least squared error in sum over the points not within ``decibel``.
    """
    chosen = [int((points - points.mean(dim=0)).square().sum(dim=1).argmax())]
    while len(chosen) < min(count, len(points)):
        errors = nearest_in_hull(points, points[chosen])[1]
        farthest = errors.topk(min(_CANDIDATES, len(points))).indices.tolist()
        candidates = [index for index in farthest if index not in chosen]
        open_ = psnr(errors) < decibel
        if not open_.any():
            open_ = torch.ones_like(open_)
        hulls = points[torch.tensor([[*chosen, new] for new in candidates])]
        chosen.append(candidates[int(nearest_in_hull(points[open_], hulls)[1].sum(dim=1).argmin())])
    return chosen


def extreme_points(points: Tensor) -> Tensor:
    """Indices of the points ``(P, D)``, D small, that are corners of the hull of all: only these make it wide."""
    from scipy.spatial import ConvexHull  # slow to import, and needed by nothing else

    return torch.from_numpy(ConvexHull(points.numpy()).vertices).long().sort().values
