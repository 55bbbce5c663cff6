r"""Camera-consistent sampling: one draw is a camera in a light, not a colour matrix and gains on their own.

.. math:: y = h(C\,T(x);\, g \, 2^{-e}), \qquad g = \mathrm{wb}(M, L) / \min \mathrm{wb}(M, L),
    \quad (C, M) = D_\mathrm{cam} w, \quad T = \textstyle\sum_k v_k T_k

with h Brooks' highlight-preserving inverse gains (:func:`rawaug.isp.stages.inverse_gains`), w a mixture of two of the
cameras that the hull of the atoms was made for (:class:`rawaug.isp.dictionary.CameraDictionary`), a light L
(:mod:`rawaug.isp.light`), a mixture v of up to three inverse tone curves, and e an exposure in stops. The smallest gain
is 1, as in cameras and LibRaw, so that clipped RAW develops to white.

Shares of a mixture follow the Dirichlet distribution of concentration 1/2, which crowds its ends: most draws are near
one camera, and tone is near one curve or between two. Flat weights of all atoms would crowd the middle of the hull, and
a few atoms at a time its corners, where cameras are rare.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from rawaug.isp.cameras import XYZ_TO_SRGB
from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import CameraDictionary, sparse_shares, sparse_weights
from rawaug.isp.light import Array, LightRange, sample_lights

PLAUSIBLE_GAINS = (0.4, 6.0)
"""Red and blue gains over green that are kept; a matrix made for D65 says nothing of light that needs more."""
EXPOSURE = (-1.0, 0.2)
"""Stops, drawn uniformly: what cameras leave between the white of RAW and that of their pictures is not published."""
CAMERAS_MIXED = 2
TONES_MIXED = 3
_ROUNDS = 100
_ALL_LIGHTS = LightRange()


class CameraSampler:
    """Draws settings of an ISP whose colour atoms are published cameras, as these are now, on the CPU.

    Args:
        cameras: the atoms of colour.
        tone_atoms: number of tone curves; 0 where the tone is learned.
        cameras_mixed, tones_mixed: how many cameras and curves are mixed in a draw, at most; drawn with replacement.
        lights: what the light is drawn from.
        consistent: gains follow from the camera and its light; if not, they are those of another draw, as where colour
            and gains are drawn one by one.

    Raises:
        ValueError: if fewer than one is to be mixed.
    """

    def __init__(
        self,
        cameras: CameraDictionary,
        tone_atoms: int,
        cameras_mixed: int = CAMERAS_MIXED,
        tones_mixed: int = TONES_MIXED,
        lights: LightRange = _ALL_LIGHTS,
        consistent: bool = True,
    ) -> None:
        if min(cameras_mixed, tones_mixed) < 1:
            raise ValueError(f"a draw needs at least one camera and one tone, got {cameras_mixed} and {tones_mixed}")
        self.known, self.atoms, self.responses = (
            tensor.detach().to("cpu", torch.float64).numpy()
            for tensor in (cameras.known, cameras.atoms().flatten(1), cameras.responses())
        )
        self.tone_atoms, self.cameras_mixed, self.tones_mixed = tone_atoms, cameras_mixed, tones_mixed
        self.lights, self.consistent = lights, consistent

    def sample(self, batch: int, generator: torch.Generator, device: torch.device | str = "cpu") -> ISPParams:
        """Settings of ``batch`` pictures, from a generator on the CPU; gains have no weights, they follow the light.

        Raises:
            ValueError: if no light gives a camera plausible gains.
        """
        weights, balance = self._cameras_in_light(batch, generator)
        if not self.consistent:
            _, balance = self._cameras_in_light(batch, generator)
        matrix = (weights @ self.atoms).reshape(-1, 3, 3)
        gains = balance / balance.min(axis=1, keepdims=True)
        colour_weights, matrices, channel_gains = (
            torch.from_numpy(drawn).to(device, torch.float32) for drawn in (weights, matrix, gains)
        )
        tones = none = channel_gains[:, :0]
        if self.tone_atoms:
            tones = sparse_weights(batch, self.tone_atoms, self.tones_mixed, generator).to(channel_gains)
        return ISPParams(colour_weights, none, matrices, channel_gains, tones)

    def _cameras_in_light(self, batch: int, generator: torch.Generator) -> tuple[Array, Array]:
        """Weights ``(B, N)`` and balances ``(B, 3)``; draws with gains beyond what is plausible are drawn again."""
        weights, balance = np.empty((batch, self.known.shape[1])), np.empty((batch, 3))
        open_ = np.arange(batch)
        for _ in range(_ROUNDS):
            chosen, shares = sparse_shares(len(open_), len(self.known), self.cameras_mixed, generator)
            drawn = np.einsum("bm,bmn->bn", shares.numpy(), self.known[chosen.numpy()])
            light = sample_lights(len(open_), generator, *self.lights)
            weights[open_], balance[open_] = drawn, self.balance(drawn, light)
            open_ = open_[~plausible(balance[open_])]
            if not len(open_):
                return weights, balance
        raise ValueError(
            f"no light of {self.lights.kelvin} K gives these cameras gains within {PLAUSIBLE_GAINS}; take other lights"
        )

    def balance(self, weights: Array, light: Array) -> Array:
        """White balance ``(B, 3)``, green 1, of mixtures ``(B, N)`` of atoms in light of white points ``(B, 3)``."""
        linear = light @ XYZ_TO_SRGB.numpy().T
        response = weights @ self.responses * np.einsum("bij,bj->bi", (weights @ self.atoms).reshape(-1, 3, 3), linear)
        return np.asarray(response[:, 1:2] / response)


def plausible(balance: Array) -> NDArray[np.bool_]:
    """Which white balances ``(B, 3)`` are within :data:`PLAUSIBLE_GAINS`, ``(B,)``."""
    low, high = PLAUSIBLE_GAINS
    return np.asarray(((balance >= low) & (balance <= high)).all(axis=1))
