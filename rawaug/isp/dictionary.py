r"""Dictionaries of camera parameters: atoms, and augmentation in their convex hull.

``C = sum_i w_i D_ccm[i]`` and ``1 / g = sum_i w_i / D_wb[i]``, with ``w`` on the simplex (non-negative, sum 1).

Combining the parameters equals combining the N transformed images, since both stages are linear in them (Conde et al.,
AAAI 2022, "Parameter Dictionaries"). Colour atoms act in the reverse direction, sRGB to camera; each row of theirs (a
column in the paper, where pixels are row vectors) has l1 norm 1, so that with no negative entry white stays white and
the gains carry all of the white balance.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def l1_normalised(matrices: Tensor) -> Tensor:
    """``(..., 3, 3)`` with every row divided by its l1 norm."""
    return F.normalize(matrices, p=1.0, dim=-1)


class ColourDictionary(nn.Module):
    """N colour correction matrices, sRGB to camera, rows l1-normalised.

    Each atom stores the light it was seen in, so that a known white balance can choose among them, as a DNG's
    two illuminants do.

    Attributes:
        matrices: ``(N, 3, 3)``, normalised on use.
        light: ``(N, 2)`` log of the as-shot red and blue multipliers over green.
        neutral: ``(N, 3)`` log of what the channels' gains are beyond as-shot balance and matrix: the digital gain.
        spread: width of the kernel in ``light``; infinite where the light is uninformative.
    """

    light: Tensor
    neutral: Tensor
    spread: Tensor

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.matrices = nn.Parameter(torch.eye(3).repeat(atoms, 1, 1))
        self.register_buffer("light", torch.zeros(atoms, 2))
        self.register_buffer("neutral", torch.zeros(atoms, 3))
        self.register_buffer("spread", torch.tensor(torch.inf))

    def atoms(self) -> Tensor:
        """``(N, 3, 3)``, rows of l1 norm 1."""
        return l1_normalised(self.matrices)

    def combine(self, weights: Tensor) -> Tensor:
        """Weights ``(B, N)`` to matrices ``(B, 3, 3)``."""
        return torch.einsum("bn,nij->bij", weights, self.atoms())

    def weights_for(self, white_balance: Tensor) -> Tensor:
        """Weights ``(B, N)`` of the atoms seen in such light, given as-shot multipliers ``(B, 3)``."""
        distance = (log_light(white_balance)[:, None] - self.light) ** 2
        return torch.softmax(-distance.sum(2) / (2.0 * self.spread**2), dim=1)

    def gains_for(self, white_balance: Tensor, weights: Tensor) -> Tensor:
        """Channel gains ``(B, 3)`` under which grey becomes ``1 / white_balance``, times the digital gain."""
        return white_balance * (weights @ self.neutral).exp() * self.combine(weights).sum(2)


def log_light(white_balance: Tensor) -> Tensor:
    """Log of the red and blue multipliers over green, ``(B, 3)`` to ``(B, 2)``."""
    return (white_balance[:, 0::2] / white_balance[:, 1:2]).log()


class GainDictionary(nn.Module):
    """M triplets (digital gain, red gain, blue gain), as the paper writes its atoms; kept as logarithms, so positive.

    Drawn from U(1, 2) at first, as in the paper.
    """

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.log_gains = nn.Parameter((1.0 + torch.rand(atoms, 3)).log())

    def atoms(self) -> Tensor:
        """``(M, 3)``: g_d, g_r, g_b."""
        return self.log_gains.exp()

    def channel_gains(self) -> Tensor:
        """``(M, 3)``: what R, G and B are multiplied by in the forward pass: g_d g_r, g_d, g_d g_b."""
        digital, red, blue = self.atoms().unbind(1)
        return torch.stack([digital * red, digital, digital * blue], dim=1)

    def combine(self, weights: Tensor) -> Tensor:
        """Weights ``(B, M)`` to channel gains ``(B, 3)``."""
        return 1.0 / (weights @ (1.0 / self.channel_gains()))


def project_to_simplex(weights: Tensor) -> Tensor:
    """The nearest point of the simplex, row by row: ``(B, N)`` to ``(B, N)`` (Duchi et al., ICML 2008, algorithm 1)."""
    ordered = weights.sort(dim=1, descending=True).values
    excess = ordered.cumsum(dim=1) - 1.0
    rank = torch.arange(1, weights.shape[1] + 1, device=weights.device)
    support = (ordered * rank > excess).sum(dim=1, keepdim=True)
    threshold = excess.gather(1, support - 1) / support
    return (weights - threshold).clamp_min(0.0)


def perturb(weights: Tensor, strength: float, generator: torch.Generator) -> Tensor:
    """Dictionary augmentation: ``w + strength * N(0, I)``, brought back to the simplex; ``(B, N)`` to ``(B, N)``."""
    noise = torch.randn(weights.shape, generator=generator, device=generator.device).to(weights)
    return project_to_simplex(weights + strength * noise)


def convex_weights(batch: int, atoms: int, generator: torch.Generator) -> Tensor:
    """Weights ``(batch, atoms)`` uniform on the simplex: dictionary augmentation without encoders.

    Normalised exponentials are the flat Dirichlet distribution.
    """
    uniform = torch.rand(batch, atoms, generator=generator, device=generator.device)
    exponential = -torch.log1p(-uniform)
    return exponential / exponential.sum(dim=1, keepdim=True)
