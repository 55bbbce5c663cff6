r"""Dictionaries of camera parameters: atoms, their convex hull, and settings drawn from it.

``C = sum_i w_i D_ccm[i]`` and ``1 / g = sum_i w_i / D_wb[i]``, with ``w`` on the simplex (Conde et al., AAAI 2022,
"Parameter Dictionaries"). Colour atoms act from sRGB to camera. Each of their rows (a column in the paper, where pixels
are row vectors) has l1 norm 1. The atoms of published cameras have rows of sum 1 instead, with or without negative
entries.

*Sampling.* One draw is a camera in a light, not a colour matrix and gains independently of each other:

.. math:: y = h(C\,T(x);\, g \, 2^{-e}), \qquad g = \mathrm{wb}(M, L) / \min \mathrm{wb}(M, L),
    \quad (C, M) = D_\mathrm{cam} w, \quad T = \textstyle\sum_k v_k T_k

with h Brooks' highlight-preserving inverse gains, w a mixture of two of the cameras that the hull was made for, a light
L (:mod:`rawaug.camera.lights`), a mixture v of up to three inverse tone curves, and e an exposure in stops. The
smallest gain is 1, so that clipped RAW develops to white. Shares of a mixture follow the Dirichlet distribution of
concentration 1/2, so that most draws are near one camera. Flat weights would crowd the middle of the hull, where
cameras are rare.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from rawaug.camera.lights import XYZ_TO_SRGB, Array, LightRange, sample_lights
from rawaug.camera.matrices import camera_from_srgb, daylight_gains
from rawaug.isp.config import ISPParams
from rawaug.seeding import Generators, draw_rows, take_generators

PLAUSIBLE_GAINS = (0.4, 6.0)
"""Range of red and blue gains over green that are kept; a D65 matrix says nothing about light that needs more."""
EXPOSURE = (-0.5, 1.0)
"""Limits of the uniform draw in stops. The headroom that cameras leave between the white of RAW and that of their
pictures is not published. With these the mean RAW of photographs is 0.136, and 71 % of the cells whose green is clipped
have red to spare, as in real files; with a ceiling of 1.5 stops it is 45 %."""
CAMERAS_MIXED, _TONES_MIXED = 2, 3
_ROUNDS = 100
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

    @torch.no_grad()
    def set_cameras(self, xyz_to_camera: Tensor, known: Tensor) -> None:
        """Set the atoms from matrices ``(N, 3, 3)`` from XYZ to camera, and the known cameras by weights ``(P, N)``."""
        self.matrices.copy_(camera_from_srgb(xyz_to_camera))
        self.light.copy_(log_light(daylight_gains(xyz_to_camera)))
        self.known.copy_(known)

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
    noise = draw_rows(
        generator,
        len(weights),
        lambda g, rows: torch.randn(rows, atoms, generator=g, device=g.device, dtype=torch.float32),
    )
    return project_to_simplex(weights + strength * noise.to(weights))


def convex_weights(batch: int, atoms: int, generator: Generators) -> Tensor:
    """Draw weights ``(batch, atoms)`` uniformly from the simplex: augmentation without encoders."""
    # Normalised exponentials follow the flat Dirichlet distribution. They do not fill the hull evenly: with more atoms,
    # more of the mixtures are near its middle.
    uniform = draw_rows(
        generator, batch, lambda g, rows: torch.rand(rows, atoms, generator=g, device=g.device, dtype=torch.float32)
    )
    exponential = -torch.log1p(-uniform)
    return exponential / exponential.sum(dim=1, keepdim=True)


def sparse_shares(batch: int, atoms: int, mixed: int, generator: Generators) -> tuple[Tensor, Tensor]:
    """Draw a few atoms for each picture, with replacement, and their Dirichlet(1/2) shares.

    Args:
        batch: number of pictures B.
        atoms: number of atoms to draw from.
        mixed: number of atoms to draw for each picture.
        generator: a generator on the CPU, or one for each picture.

    Returns:
        Indices and float64 shares, both ``(batch, mixed)``.
    """
    # Squares of normals, divided by their sum, crowd the corners and edges of a hull.
    indices = draw_rows(generator, batch, lambda g, rows: torch.randint(atoms, (rows, mixed), generator=g))
    normals = draw_rows(generator, batch, lambda g, rows: torch.randn(rows, mixed, generator=g, dtype=torch.float64))
    squares = normals**2
    return indices, squares / squares.sum(dim=1, keepdim=True)


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


class CameraSampler:
    """Draws settings of an ISP whose colour atoms are published cameras, on the CPU.

    Args:
        cameras: the atoms; later changes to them do not affect the sampler.
        tone_atoms: number of tone curves, 0 if the tone is learned.
        lights: the lights to draw from.
        consistent: whether colour and gains are of one camera in one light; if not, the gains are drawn separately.
    """

    def __init__(self, cameras: CameraDictionary, tone_atoms: int, lights: LightRange, consistent: bool = True) -> None:
        self.known = _as_array(cameras.known)
        self.atoms = _as_array(cameras.atoms().flatten(1))
        self.responses = _as_array(cameras.responses())
        self.tone_atoms, self.lights, self.consistent = tone_atoms, lights, consistent

    def sample(self, batch: int, generator: Generators, device: torch.device | str = "cpu") -> ISPParams:
        """Draw the settings of ``batch`` pictures from a generator on the CPU, or one each, as tensors on ``device``.

        Their gain weights are ``(batch, 0)``, as the gains follow from the light.
        """
        weights, balance = self._cameras_in_light(batch, generator)
        if not self.consistent:
            _, balance = self._cameras_in_light(batch, generator)

        colour_weights = torch.from_numpy(weights).to(device, torch.float32)
        matrices = torch.from_numpy(_row_by_row(weights, self.atoms).reshape(-1, 3, 3)).to(device, torch.float32)
        gains = torch.from_numpy(balance / balance.min(axis=1, keepdims=True)).to(device, torch.float32)

        tones = none = gains[:, :0]
        if self.tone_atoms:
            atoms, shares = sparse_shares(batch, self.tone_atoms, _TONES_MIXED, generator)
            tones = shares.new_zeros(batch, self.tone_atoms).scatter_add_(1, atoms, shares).to(gains)
        return ISPParams(colour_weights, none, matrices, gains, tones)

    def _cameras_in_light(self, batch: int, generator: Generators) -> tuple[Array, Array]:
        """Draw weights ``(B, N)`` and balances ``(B, 3)``, and repeat the draw if the gains are implausible."""
        weights, balance = np.empty((batch, self.known.shape[1])), np.empty((batch, 3))
        rest = np.arange(batch)
        for _ in range(_ROUNDS):
            drawn_by = take_generators(generator, rest)
            cameras, shares = sparse_shares(len(rest), len(self.known), CAMERAS_MIXED, drawn_by)
            mixtures = (shares.numpy()[..., None] * self.known[cameras.numpy()]).sum(axis=1)
            light = sample_lights(len(rest), drawn_by, self.lights)
            weights[rest] = mixtures
            balance[rest] = self.balance(mixtures, light)

            rest = rest[~is_plausible(balance[rest])]
            if not len(rest):
                return weights, balance

        raise ValueError(f"no light of {self.lights.kelvin} K gives these cameras gains within {PLAUSIBLE_GAINS}")

    def balance(self, weights: Array, light: Array) -> Array:
        """Compute the white balance ``(B, 3)``, green 1, of mixtures ``(B, N)`` in light of white points ``(B, 3)``."""
        linear = light @ XYZ_TO_SRGB.numpy().T
        matrices = _row_by_row(weights, self.atoms).reshape(-1, 3, 3)
        response = _row_by_row(weights, self.responses) * (matrices * linear[:, None]).sum(axis=2)
        return np.asarray(response[:, 1:2] / response)


def _row_by_row(rows: Array, matrix: Array) -> Array:
    """Multiply rows ``(B, N)`` by a matrix, with the same bits however many there are, which BLAS does not promise."""
    return np.concatenate([rows[number : number + 1] @ matrix for number in range(len(rows))])


def _as_array(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().to("cpu", torch.float64).numpy())


def is_plausible(balance: Array) -> NDArray[np.bool_]:
    """Say which white balances ``(B, 3)`` lie within :data:`PLAUSIBLE_GAINS`: booleans ``(B,)``."""
    low, high = PLAUSIBLE_GAINS
    return np.asarray(((balance >= low) & (balance <= high)).all(axis=1))
