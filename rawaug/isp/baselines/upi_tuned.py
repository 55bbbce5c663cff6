r"""UPI tuned: its fixed tone curve and gamma, with one matrix and one set of gains fitted to pairs.

``y = M s^-1(x)^2.2`` below the highlights, with ``M = diag(1 / g) C``, rows of ``C`` summing to 1. All of a frame's
mean squared error is in second moments, ``MSE_f(M) = sum_c m_c A_fc m_c - 2 m_c b_fc + e_fc``, so a fit is a few 3 x 3
systems: the whole is exact and takes well under a second.

The frames differ in gains that cannot be guessed. ``mse`` minimises the sum of their errors and follows the brightest;
``mean`` takes the mean of the frames' own gains and matrices; ``log`` minimises ``sum_f log(MSE_f + eps)``, since the
score averages decibels, by weighted least squares with weights ``1 / (MSE_f + eps)``: each round minimises the tangent
of the concave logarithm, which lies above it, so the loss never rises.

Source: Brooks et al., CVPR 2019, for the stages; the paper of the dictionary ISP compares with UPI "tuned" to its data.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.isp import stages
from rawaug.isp.baselines.upi import GAMMA, SmoothstepISP, UPIParams, inverse_smoothstep
from rawaug.isp.fit.samples import FramePair, PixelSamples, sample_pixels
from rawaug.registry import BASELINES

Criterion = Literal["log", "mse", "mean"]

LOG_MSE_EPS = 1e-5
"""Added to a frame's MSE under the logarithm: frames beyond 50 dB count no more."""
ROUNDS = 100
PIXELS = 32768
"""Drawn of each frame."""


@BASELINES.register("upi-tuned")
class TunedUPI(SmoothstepISP):
    """UPI's stages with a fitted camera's matrix and gains; identity until tuned.

    Args:
        cfa: pattern of the RAW.
        criterion: "log", "mse" or "mean", see the module's head.
    """

    name = "upi-tuned"
    trainable = True

    def __init__(self, cfa: CFA | str = "RGGB", criterion: Criterion = "log") -> None:
        super().__init__(cfa)
        if criterion not in get_args(Criterion):
            raise ValueError(f"criterion {criterion!r} is unknown; use one of {', '.join(get_args(Criterion))}")
        self.criterion = criterion
        self.matrix = nn.Parameter(torch.eye(3), requires_grad=False)
        self.gains = nn.Parameter(torch.ones(3), requires_grad=False)

    def default_params(self, batch: int) -> UPIParams:
        return UPIParams(self.matrix.expand(batch, 3, 3), self.gains.expand(batch, 3))

    def tune(self, pairs: Iterable[FramePair], seed: int = 0) -> TunedUPI:
        """Fit matrix and gains; pairs of any CFA, registered or not.

        Raises:
            ValueError: if there is no pair, a frame has too few pixels below the highlights, or what fits best turns
                white black.
        """
        moments = Moments.of(sample_pixels(pairs, PIXELS, seed)[0])
        if self.criterion == "mean":
            own = moments.solve_each()
            scale = own.sum(2)
            product = (own / scale[:, :, None]).mean(0) / (1.0 / scale).mean(0)[:, None]
        else:
            product = moments.solve(torch.ones(len(moments.energy)).double())
            for _ in range(ROUNDS if self.criterion == "log" else 0):
                product = moments.solve(1.0 / (moments.error(product) + LOG_MSE_EPS))
        sums = product.sum(1)
        if (sums <= 0.0).any():
            raise ValueError("tuned UPI: the pairs fit only with negative gains; give frames with more colours")
        self.gains.copy_(1.0 / sums)
        self.matrix.copy_(product / sums[:, None])
        return self


class Moments(NamedTuple):
    """What the frames' squared errors depend on, in double precision, as means over each frame's known readings.

    Args:
        a: ``(F, 3, 3, 3)`` channel by channel, of linear sRGB with itself.
        b: ``(F, 3, 3)`` of linear sRGB with the readings.
        energy: ``(F,)`` of the readings.
    """

    a: Tensor
    b: Tensor
    energy: Tensor

    @classmethod
    def of(cls, samples: PixelSamples) -> Moments:
        """Of pixels below the highlights, where the inverse gains are plain divisions."""
        linear = stages.gamma_expand(inverse_smoothstep(samples.srgb), GAMMA)
        known = samples.known * (linear.mean(1, keepdim=True) < stages.HIGHLIGHT_KNEE)
        x, y, weight = (value[:, :, 0].double() for value in (linear, samples.target, known))
        if (weight.sum(2) < 32).any():
            frame = int((weight.sum(2) < 32).any(1).nonzero()[0])
            raise ValueError(f"frame {frame}: too few pixels below the highlights; use a better exposed frame")
        weight = weight / weight.sum((1, 2), keepdim=True)
        a = torch.einsum("fip,fjp,fcp->fcij", x, x, weight)
        return cls(a, torch.einsum("fip,fcp,fcp->fci", x, y, weight), (weight * y * y).sum((1, 2)))

    def solve_each(self) -> Tensor:
        """Each frame's own matrix ``(F, 3, 3)``."""
        return torch.linalg.solve(self._ridge(self.a), self.b)

    def solve(self, weights: Tensor) -> Tensor:
        """The matrix ``(3, 3)`` of least weighted error, weights ``(F,)``."""
        a, b = torch.einsum("f,fcij->cij", weights, self.a), torch.einsum("f,fci->ci", weights, self.b)
        return torch.linalg.solve(self._ridge(a), b)

    def error(self, product: Tensor) -> Tensor:
        """The frames' mean squared errors ``(F,)``."""
        square = torch.einsum("ci,fcij,cj->f", product, self.a, product)
        return (square - 2.0 * (product * self.b).sum((1, 2)) + self.energy).clamp_min(0.0)

    @staticmethod
    def _ridge(a: Tensor) -> Tensor:
        return a + 1e-9 * a.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(3).to(a)
