r"""Camera-consistent sampling: one draw is a camera in a light, not a colour matrix and gains on their own.

.. math:: y = h(C\,T(x);\, g \, 2^{-e}), \qquad g = \mathrm{wb}(M, L) / \min \mathrm{wb}(M, L), \quad C = C(M),
    \quad M = \textstyle\sum_k w_k M_k, \quad T = \textstyle\sum_k v_k T_k

with h Brooks' highlight-preserving inverse gains (:func:`rawaug.isp.stages.inverse_gains`), M a mixture of two
published cameras, L a light (:mod:`rawaug.isp.light`), T a mixture of three inverse tone curves
(:mod:`rawaug.isp.tone_curves`) and e an exposure in stops. The smallest gain is 1, as in cameras and LibRaw, so that
clipped RAW develops to white.

Weights w and v follow the Dirichlet distribution of concentration 1/2, squares of normals divided by their sum: it
crowds the corners and edges of a hull. Flat weights of many atoms crowd its middle; therefore few are mixed at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.isp.cameras import colour_matrix, normalised, published_cameras, white_balance
from rawaug.isp.light import COLDEST, LAMP_SHARE, WARMEST, sample_lights
from rawaug.isp.stages import correct_colour, inverse_gains
from rawaug.isp.tone_curves import to_linear, tone_tables

PLAUSIBLE_GAINS = (0.4, 6.0)
"""Red and blue gains over green that are kept; a matrix made for D65 says nothing of light that needs more."""
_ROUNDS = 100


class CameraSetting(NamedTuple):
    """What :func:`unprocess` needs of each picture; replays it. Leading dimension B everywhere, float32.

    Args:
        matrix: ``(B, 3, 3)`` linear sRGB to white-balanced camera RGB, rows sum to 1.
        gains: ``(B, 3)`` white balance, forward direction, the smallest 1.
        tone: ``(B, 2041)`` inverse tone table.
        exposure: ``(B,)`` stops.
    """

    matrix: Tensor
    gains: Tensor
    tone: Tensor
    exposure: Tensor


class CameraSampler:
    """Draws camera settings.

    Args:
        cameras: names of published cameras, matrices ``(N, 3, 3)`` from XYZ to camera, or None for all that are
            published, each different matrix alike.
        tones: names of tone curves, or None for all.
        cameras_mixed, tones_mixed: how many are mixed in a draw, at most; drawn with replacement.
        kelvin: lowest and highest colour temperature of the light.
        lamps: share of fluorescent and LED lamps.
        exposure: lowest and highest exposure in stops, drawn uniformly.

    Raises:
        ValueError: if a name is unknown or a limit is outside its range.

    Example:
        >>> sampler = CameraSampler(cameras=["Nikon D750"])
        >>> setting = sampler.sample(2, torch.Generator().manual_seed(0))
        >>> unprocess(torch.rand(2, 3, 8, 8), setting).shape
        torch.Size([2, 3, 8, 8])
    """

    def __init__(
        self,
        cameras: Sequence[str] | Tensor | None = None,
        tones: Sequence[str] | None = None,
        cameras_mixed: int = 2,
        tones_mixed: int = 3,
        kelvin: tuple[float, float] = (WARMEST, COLDEST),
        lamps: float = LAMP_SHARE,
        exposure: tuple[float, float] = (-1.0, 0.2),
    ) -> None:
        if not exposure[0] <= exposure[1]:
            raise ValueError(f"exposure must be (lowest, highest) in stops, got {exposure}")
        if min(cameras_mixed, tones_mixed) < 1:
            raise ValueError(
                f"a draw needs at least one camera and one tone curve, got {cameras_mixed} and {tones_mixed}"
            )
        if cameras is None:
            self.cameras = published_cameras().distinct()
        elif isinstance(cameras, Tensor):
            self.cameras = normalised(cameras.double())
        else:
            self.cameras = published_cameras().named(cameras)
        self.tones = tone_tables(tones)
        self.cameras_mixed, self.tones_mixed = cameras_mixed, tones_mixed
        self.kelvin, self.lamps, self.exposure = kelvin, lamps, exposure

    def sample(self, batch: int, generator: torch.Generator) -> CameraSetting:
        """Settings of ``batch`` pictures, from a generator on the CPU."""
        camera, balance = self._cameras_in_light(batch, generator)
        weights = sparse_weights(batch, len(self.tones), self.tones_mixed, generator)
        low, high = self.exposure
        exposure = low + (high - low) * torch.rand(batch, generator=generator)
        gains = balance / balance.amin(dim=1, keepdim=True)
        return CameraSetting(colour_matrix(camera).float(), gains.float(), weights.float() @ self.tones, exposure)

    def _cameras_in_light(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Matrices ``(B, 3, 3)`` and balances ``(B, 3)``; draws with gains beyond what is plausible are drawn again."""
        camera, balance = torch.empty(batch, 3, 3).double(), torch.empty(batch, 3).double()
        open_ = torch.arange(batch)
        for _ in range(_ROUNDS):
            weights = sparse_weights(len(open_), len(self.cameras), self.cameras_mixed, generator)
            camera[open_] = torch.einsum("bn,nij->bij", weights, self.cameras)
            light = sample_lights(len(open_), generator, self.kelvin, self.lamps)
            balance[open_] = white_balance(camera[open_], light)
            open_ = (~plausible(balance)).nonzero()[:, 0]
            if not len(open_):
                return camera, balance
        raise ValueError(
            f"no light at {self.kelvin} K gives these cameras gains within {PLAUSIBLE_GAINS}; widen kelvin"
        )


def plausible(balance: Tensor) -> Tensor:
    """Which white balances ``(B, 3)`` are within :data:`PLAUSIBLE_GAINS`, ``(B,)``."""
    low, high = PLAUSIBLE_GAINS
    return ((balance >= low) & (balance <= high)).all(dim=1)


def sparse_weights(batch: int, atoms: int, mixed: int, generator: torch.Generator) -> Tensor:
    """Weights ``(batch, atoms)`` on the simplex, float64, of which at most ``mixed`` are not zero: Dirichlet(1/2)."""
    chosen = torch.randint(atoms, (batch, mixed), generator=generator)
    squares = torch.randn(batch, mixed, generator=generator, dtype=torch.float64) ** 2
    shares = squares / squares.sum(dim=1, keepdim=True)
    return torch.zeros(batch, atoms, dtype=torch.float64).scatter_add_(1, chosen, shares)


@torch.no_grad()
def unprocess(srgb: Tensor, setting: CameraSetting) -> Tensor:
    """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], to linear camera RGB ``(B, 3, H, W)`` float32. Pure.

    Not clipped: at an exposure above 0 a highlight may pass white, and a saturated colour may be negative in a channel.
    """
    gains = setting.gains * torch.exp2(-setting.exposure)[:, None]
    return inverse_gains(correct_colour(to_linear(srgb, setting.tone), setting.matrix), gains)
