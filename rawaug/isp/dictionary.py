"""Dictionaries of camera parameters: atoms, and weights of their convex hull.

``C = sum_i w_i D_ccm[i]`` and ``1 / g = sum_i w_i / D_wb[i]``, with ``w`` on the simplex (Conde et al., AAAI 2022,
"Parameter Dictionaries"). Colour atoms act from sRGB to camera. Each of their rows (a column in the paper, where pixels
are row vectors) has l1 norm 1. The atoms of published cameras have rows of sum 1 instead, with or without negative
entries.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.camera.lights import XYZ_TO_SRGB
from rawaug.camera.matrices import camera_from_srgb, daylight_gains
from rawaug.seeding import Generators, draw_rows

_STEPS = 400


def l1_normalise(matrices: Tensor) -> Tensor:
    """Divide every row of matrices ``(..., 3, 3)`` by its l1 norm."""
    return F.normalize(matrices, p=1.0, dim=-1)


class ColourDictionary(nn.Module):
    """N colour correction matrices, sRGB to camera, each with the light that it was seen in.

    So a known white balance can choose among them, as among the two illuminants of a DNG.
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
        """The matrices ``(N, 3, 3)``, rows of l1 norm 1."""
        return l1_normalise(self.matrices)

    def combine(self, weights: Tensor) -> Tensor:
        """Mix the atoms by weights ``(B, N)`` into matrices ``(B, 3, 3)``."""
        return torch.einsum("bn,nij->bij", weights, self.atoms())

    def weights_for(self, white_balance: Tensor, chosen: Tensor) -> Tensor:
        """Weigh the atoms by how near their light is to that of as-shot multipliers ``(B, 3)``: ``(B, N)``.

        ``chosen`` ``(B, N)`` are the weights that they have if nothing is known of the light.
        """
        distance = (log_light(white_balance)[:, None] - self.light) ** 2
        return torch.softmax(chosen.clamp_min(1e-6).log() - distance.sum(2) / (2.0 * self.spread**2), dim=1)


class CameraDictionary(ColourDictionary):
    """N cameras: matrices from sRGB to white-balanced camera RGB, rows of sum 1, and the white balance of each in D65.

    Matrix and balance together give the matrix from XYZ, so the gains of a mixture follow from any light:

    ``M = diag(r) C S^-1`` with ``C = sum_i w_i C_i``, ``r = sum_i w_i r_i``, the response to D65 (green 1), and S from
    linear sRGB to XYZ.
    """

    known: Tensor

    def __init__(self, atoms: int, known: int) -> None:
        super().__init__(atoms)
        self.register_buffer("known", torch.full((known, atoms), 1.0 / atoms))

    @property
    def typical(self) -> Tensor:
        """The weights ``(N,)`` to use if the camera is unknown: the mean over the known ones."""
        return self.known.mean(dim=0)

    @classmethod
    @torch.no_grad()
    def from_atoms(cls, matrices: Tensor, light: Tensor, known: Tensor) -> CameraDictionary:
        """Make a dictionary of known cameras.

        Args:
            matrices: ``(N, 3, 3)``, from linear sRGB to white-balanced camera RGB, rows of sum 1.
            light: ``(N, 2)``, :func:`log_light` of the atoms' white balance in D65.
            known: ``(P, N)``, each known camera as a mixture of the atoms.
        """
        cameras = cls(len(matrices), len(known))
        cameras.matrices.copy_(matrices)
        cameras.light.copy_(light)
        cameras.known.copy_(known)
        return cameras

    @classmethod
    def from_xyz(cls, xyz_to_camera: Tensor, known: Tensor) -> CameraDictionary:
        """Make a dictionary of matrices ``(N, 3, 3)`` from XYZ to camera, and known cameras as weights ``(P, N)``."""
        return cls.from_atoms(camera_from_srgb(xyz_to_camera), log_light(daylight_gains(xyz_to_camera)), known)

    def atoms(self) -> Tensor:
        """The matrices ``(N, 3, 3)``, rows of sum 1."""
        return self.matrices / self.matrices.sum(dim=2, keepdim=True)

    def responses(self) -> Tensor:
        """The responses of the atoms to D65, float64 ``(N, 3)``, green 1."""
        red, blue = (-self.light.double()).exp().unbind(1)
        return torch.stack([red, torch.ones_like(red), blue], dim=1)

    def xyz_to_camera(self, weights: Tensor) -> Tensor:
        """Mix the atoms by weights ``(B, N)`` into float64 matrices ``(B, 3, 3)`` from XYZ, green 1 in D65."""
        weights = weights.double()
        matrix = torch.einsum("bn,nij->bij", weights, self.atoms().double())

        return (weights @ self.responses())[:, :, None] * matrix @ XYZ_TO_SRGB.to(matrix)

    def weights_for(self, white_balance: Tensor, chosen: Tensor) -> Tensor:
        """The typical weights ``(B, N)``: multipliers ``(B, 3)`` of an unknown light say nothing about the camera."""
        return self.typical.expand(len(white_balance), -1)


def log_light(white_balance: Tensor) -> Tensor:
    """Take the logarithm of the red and blue multipliers over green, ``(B, 3)`` to ``(B, 2)``."""
    return (white_balance[:, 0::2] / white_balance[:, 1:2]).log()


class GainDictionary(nn.Module):
    """M triplets (digital gain, red gain, blue gain) as in the paper, from U(1, 2) at first; stored as logarithms."""

    def __init__(self, atoms: int) -> None:
        super().__init__()
        self.log_gains = nn.Parameter((1.0 + torch.rand(atoms, 3)).log())

    @classmethod
    @torch.no_grad()
    def from_gains(cls, gains: Tensor) -> GainDictionary:
        """Make a dictionary of triplets g_d, g_r, g_b ``(M, 3)``."""
        dictionary = cls(len(gains))
        dictionary.log_gains.copy_(gains.log())
        return dictionary

    def atoms(self) -> Tensor:
        """The triplets g_d, g_r, g_b, ``(M, 3)``."""
        return self.log_gains.exp()

    def channel_gains(self) -> Tensor:
        """The factors of R, G and B in the forward pass, ``(M, 3)``: g_d g_r, g_d, g_d g_b."""
        digital, red, blue = self.atoms().unbind(1)
        return torch.stack([digital * red, digital, digital * blue], dim=1)

    def combine(self, weights: Tensor) -> Tensor:
        """Mix the inverse gains by weights ``(B, M)``, and invert the mixture to channel gains ``(B, 3)``."""
        return 1.0 / (weights @ (1.0 / self.channel_gains()))


def project_to_simplex(weights: Tensor) -> Tensor:
    """Move each row of ``(B, N)`` to the nearest point of the simplex (Duchi et al., ICML 2008, algorithm 1)."""
    ordered = weights.sort(dim=1, descending=True).values
    excess = ordered.cumsum(dim=1) - 1.0
    rank = torch.arange(1, weights.shape[1] + 1, device=weights.device)

    support = (ordered * rank > excess).sum(dim=1, keepdim=True)
    threshold = excess.gather(1, support - 1) / support
    return (weights - threshold).clamp_min(0.0)


def perturb(weights: Tensor, strength: float, generator: Generators) -> Tensor:
    """Augment weights ``(B, N)``: add ``strength * N(0, I)`` and project them back to the simplex."""
    atoms = weights.shape[1]
    noise = draw_rows(generator, torch.randn, len(weights), atoms)
    return project_to_simplex(weights + strength * noise.to(weights))


def convex_weights(batch: int, atoms: int, generator: Generators) -> Tensor:
    """Draw weights ``(batch, atoms)`` uniformly from the simplex: augmentation without encoders."""
    # Normalised exponentials follow the flat Dirichlet distribution. They do not fill the hull evenly: with more atoms,
    # more of the mixtures are near its middle.
    uniform = draw_rows(generator, torch.rand, batch, atoms)
    exponential = -torch.log1p(-uniform)
    return exponential / exponential.sum(dim=1, keepdim=True)


def nearest_in_hull(points: Tensor, atoms: Tensor) -> tuple[Tensor, Tensor]:
    """Find the convex combinations of ``atoms`` ``(..., N, D)``, one hull or several, nearest to points ``(P, D)``.

    It uses accelerated projected gradients (Beck and Teboulle, FISTA, 2009) with restarts.

    Returns:
        Weights ``(..., P, N)`` and squared errors ``(..., P)``.
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
