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

import torch
from torch import Tensor

from rawaug.isp.cameras import white_balance
from rawaug.isp.dictionary import CameraDictionary, sparse_weights
from rawaug.isp.light import LightRange, sample_lights
from rawaug.isp.setting import ISPParams

PLAUSIBLE_GAINS = (0.4, 6.0)
"""Red and blue gains over green that are kept; a matrix made for D65 says nothing of light that needs more."""
EXPOSURE = (-1.0, 0.2)
"""Stops, drawn uniformly: what cameras leave between the white of RAW and that of their pictures is not published."""
CAMERAS_MIXED = 2
TONES_MIXED = 3
_ROUNDS = 100
_ALL_LIGHTS = LightRange()


class CameraSampler:
    """Draws settings of an ISP whose colour atoms are published cameras.

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
        self.cameras, self.tone_atoms = cameras, tone_atoms
        self.cameras_mixed, self.tones_mixed = cameras_mixed, tones_mixed
        self.lights, self.consistent = lights, consistent

    @torch.no_grad()
    def sample(self, batch: int, generator: torch.Generator) -> ISPParams:
        """Settings of ``batch`` pictures, from a generator on the CPU; gains have no weights, they follow the light.

        Raises:
            ValueError: if no light gives a camera plausible gains.
        """
        weights, balance = self._cameras_in_light(batch, generator)
        if not self.consistent:
            _, balance = self._cameras_in_light(batch, generator)
        matrix = self.cameras.combine(weights)
        gains = (balance / balance.amin(dim=1, keepdim=True)).to(matrix)
        tones = none = gains[:, :0]
        if self.tone_atoms:
            tones = sparse_weights(batch, self.tone_atoms, self.tones_mixed, generator).to(matrix)
        return ISPParams(weights, none, matrix, gains, tones)

    def _cameras_in_light(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Weights ``(B, N)`` and balances ``(B, 3)``; draws with gains beyond what is plausible are drawn again."""
        device, known = self.cameras.matrices.device, self.cameras.known.cpu().double()
        weights, balance = torch.empty(batch, known.shape[1]).double(), torch.empty(batch, 3).double()
        open_ = torch.arange(batch)
        for _ in range(_ROUNDS):
            shares = sparse_weights(len(open_), len(known), self.cameras_mixed, generator)
            weights[open_] = shares @ known
            light = sample_lights(len(open_), generator, *self.lights)
            balance[open_] = white_balance(self.cameras.xyz_to_camera(weights[open_].to(device)).cpu(), light)
            open_ = open_[~plausible(balance[open_])]
            if not len(open_):
                return weights.to(self.cameras.matrices), balance
        raise ValueError(
            f"no light of {self.lights.kelvin} K gives these cameras gains within {PLAUSIBLE_GAINS}; take other lights"
        )


def plausible(balance: Tensor) -> Tensor:
    """Which white balances ``(B, 3)`` are within :data:`PLAUSIBLE_GAINS`, ``(B,)``."""
    low, high = PLAUSIBLE_GAINS
    return ((balance >= low) & (balance <= high)).all(dim=1)
