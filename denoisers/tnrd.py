r"""Trainable nonlinear reaction diffusion, TNRD (Chen and Pock, TPAMI 2017).

A few stages of a diffusion, each with filters and functions of its own:

.. math:: u_t = u_{t-1} - \sum_i \bar k_i * \phi_i(k_i * u_{t-1}) - \lambda (u_{t-1} - f)

f is the noisy plane, and :math:`\bar k` is k turned by 180 degrees. A filter has unit length and combines the cosines
of a square without the constant one, so that brightness does not matter. A function is a sum of 63 evenly spaced
Gaussians, which are as far apart as they are wide. With 48 filters of 7 x 7, a stage has 48 (48 + 63) + 1 = 5,329
parameters.

Each plane is filtered by itself, with the same weights. Functions are looked up in tables, as in the published code.
"""

from __future__ import annotations

import math
from typing import ClassVar, Unpack

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import require_bounded
from denoisers.network import DENOISERS, Denoiser, Shared
from rawaug.registry import require_between

GAUSSIANS = 63
"""A function has this many Gaussians."""
MARGIN = 5
"""A function is 0 from this many Gaussian widths beyond the outermost Gaussians."""
KNOTS_A_GAUSSIAN = 16
"""A function's table has this many knots from one Gaussian to the next; it is linear between them, within 5e-4."""
KNOTS = KNOTS_A_GAUSSIAN * (GAUSSIANS - 1 + 2 * MARGIN) + 1
PUBLISHED_REACH = 310.0 / 255.0
"""A function covers responses of a filter up to this published one, on pictures with white at 1."""


def cosine_filters(side: int) -> Tensor:
    """Compute the orthonormal cosines of a square without the constant one, ``(side^2 - 1, 1, side, side)``."""
    position = torch.arange(side).double()
    waves = torch.cos(math.pi * (2.0 * position + 1.0) * position[:, None] / (2 * side))
    waves = waves / waves.norm(dim=1, keepdim=True)
    squares = torch.einsum("ay,bx->abyx", waves, waves).flatten(0, 1)
    return squares[1:, None].float()


class Diffusion(nn.Module):
    """One stage: filters, a function of each response, and the filters turned round.

    Args:
        side: of the filters, odd.
        reach: largest response that the functions cover.
    """

    def __init__(self, side: int, reach: float) -> None:
        super().__init__()
        filters = side**2 - 1
        self.side = side
        self.reach = reach
        self.combination = nn.Parameter(torch.eye(filters))
        self.heights = nn.Parameter(torch.zeros(filters, GAUSSIANS))
        self.fidelity = nn.Parameter(torch.zeros(()))
        self.register_buffer("cosines", cosine_filters(side), persistent=False)

    def filters(self) -> Tensor:
        """Compute the filters ``(F, 1, side, side)``, each of length 1 and sum 0."""
        directions = self.combination / self.combination.norm(dim=1, keepdim=True).clamp_min(1e-12)
        cosines = self.get_buffer("cosines").to(directions)
        return torch.einsum("fb,bcyx->fcyx", directions, cosines)

    def influence(self, response: Tensor) -> Tensor:
        """Apply each filter's function to its responses ``(B, F, h, w)``."""
        knots = torch.arange(0, KNOTS, device=response.device, dtype=response.dtype) / KNOTS_A_GAUSSIAN
        centres = torch.arange(GAUSSIANS, device=response.device, dtype=response.dtype) + MARGIN
        gaussians = torch.exp(-0.5 * (knots - centres[:, None]).square())
        table = (self.heights @ gaussians).flatten()

        spacing = 2.0 * self.reach / (GAUSSIANS - 1)
        position = ((response + self.reach) / spacing + MARGIN) * KNOTS_A_GAUSSIAN
        position = position.clamp(0.0, KNOTS - 1.001)
        knot = position.detach().floor()
        share = position - knot

        row = torch.arange(response.shape[1], device=response.device)[:, None, None] * KNOTS
        index = knot.long() + row
        return torch.lerp(table[index], table[index + 1], share)

    def forward(self, plane: Tensor, noisy: Tensor) -> Tensor:
        """Compute the next plane from a plane and the noisy one, all ``(B, 1, h, w)``; no side is below ``side``."""
        margin = (self.side // 2,) * 4
        filters = self.filters()

        response = F.conv2d(F.pad(plane, margin, mode="reflect"), filters)
        force = F.pad(self.influence(response), margin, mode="reflect")
        turned = filters.flip((2, 3)).transpose(0, 1)
        diffusion = F.conv2d(force, turned)
        return plane - diffusion - self.fidelity * (plane - noisy)


@DENOISERS.register("TNRD")
class TNRD(Denoiser):
    """Trainable nonlinear reaction diffusion (Chen and Pock, TPAMI 2017), made for noise of one level.

    In the domain ``anscombe`` every noise has one level; set ``reach`` to the responses of a filter there, such as 40
    deviations.

    Args:
        stages: number of stages, 1 to 1000; 5 is published.
        side: side of the filters, 3, 5 or 7; there are ``side**2 - 1`` of them.
        reach: largest response of a filter that the functions distinguish from larger ones.
        channels, domain, seed: see :class:`denoisers.Denoiser`. There is no noise map.

    Example:
        >>> noisy = torch.rand(2, 4, 33, 50)
        >>> TNRD(stages=2, side=3)(noisy).shape
        torch.Size([2, 4, 33, 50])
    """

    defaults: ClassVar[Shared] = {**Denoiser.defaults, "variance_map": False}

    def __init__(
        self, stages: int = 5, side: int = 7, reach: float = PUBLISHED_REACH, **shared: Unpack[Shared]
    ) -> None:
        require_bounded(stages=stages)
        require_between("reach", reach, 1e-6, 1e6)
        if side not in (3, 5, 7):
            raise ValueError(f"side must be 3, 5 or 7, got {side}")
        if stages < 1:
            raise ValueError(f"stages must be at least 1, got {stages}")
        if shared.get("variance_map"):
            raise ValueError("TNRD takes no noise map: leave out variance_map")

        super().__init__({"stages": stages, "side": side, "reach": reach}, stride=8, **shared)
        self.stages = nn.ModuleList()
        for _ in range(stages):
            self.stages.append(Diffusion(side, reach))

    def residual(self, features: Tensor) -> Tensor:
        """Run the stages on every plane: ``(B, channels, h, w)`` to the correction of the same shape."""
        noisy = features.flatten(0, 1)[:, None]
        plane = noisy
        for stage in self.stages:
            plane = stage(plane, noisy)
        return (plane - noisy).reshape(features.shape)
