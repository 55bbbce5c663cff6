"""Settings of the user's own cameras: a camera in a light, or mixtures of two if there are several."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rawaug.camera.lights import (
    ILLUMINANTS,
    Array,
    LightRange,
    compute_mired,
    light_range,
    light_xyz,
    sample_lights,
    weights_in_light,
)
from rawaug.camera.own import Anchor, Camera
from rawaug.isp.dictionary import (
    CAMERAS_MIXED,
    PLAUSIBLE_GAINS,
    CameraDictionary,
    CameraSampler,
    sparse_shares,
)
from rawaug.seeding import Generators, take_generators

_ROUNDS = 100


class OwnCameraSampler(CameraSampler):
    """Draws settings of the user's own cameras, on the CPU.

    A light that is named in their data sheets is exactly that light; all others scatter as for published cameras.

    Args:
        atoms: the dictionary of the ISP.
        cameras: the cameras; an atom is one of them in one of its lights, in this order.
        tone_atoms: number of tone curves.
        light: as in :class:`rawaug.Draw`.
        consistent: whether colour and gains are of one camera in one light; if not, the gains are drawn separately.

    Raises:
        ValueError: if the light is unknown.
    """

    def __init__(
        self,
        atoms: CameraDictionary,
        cameras: Sequence[Camera],
        tone_atoms: int,
        light: float | str | None = None,
        consistent: bool = True,
    ) -> None:
        anchors: list[Anchor] = []
        self._mireds: list[list[float]] = []
        for camera in cameras:
            in_lights = camera.anchors()
            anchors += in_lights
            self._mireds.append([anchor.mired for anchor in in_lights])
        self._from_xyz = np.stack([anchor.from_xyz.numpy() for anchor in anchors])

        # Gains from the data sheets count as plausible, whatever they are.
        gains = np.stack([anchor.gains.numpy() for anchor in anchors])
        self._lowest = min(PLAUSIBLE_GAINS[0], float(gains.min()))
        self._highest = max(PLAUSIBLE_GAINS[1], float(gains.max()))

        self._exact: Array | None = None
        names = [*ILLUMINANTS, *[anchor.light for anchor in anchors]]
        if isinstance(light, str) and light in names:
            self._exact = light_xyz(light).numpy()
            lights = LightRange()
        else:
            lights = light_range(light)

        super().__init__(atoms, tone_atoms, lights, consistent)

    def _cameras_in_light(self, batch: int, generator: Generators) -> tuple[Array, Array]:
        weights, balance = np.empty((batch, len(self._from_xyz))), np.empty((batch, 3))
        rest = np.arange(batch)
        for _ in range(_ROUNDS):
            drawn_by = take_generators(generator, rest)
            cameras, shares = sparse_shares(len(rest), len(self._mireds), CAMERAS_MIXED, drawn_by)
            light = self._lights(len(rest), drawn_by)
            weights[rest] = self._weights(cameras.numpy(), shares.numpy(), light)
            balance[rest] = self.balance(weights[rest], light)

            plausible = (balance[rest] >= self._lowest) & (balance[rest] <= self._highest)
            rest = rest[~plausible.all(axis=1)]
            if not len(rest):
                return weights, balance

        limits = f"{self._lowest:g} to {self._highest:g}"
        raise ValueError(f"no light of {self.lights.kelvin} K gives these cameras gains within {limits}")

    def _lights(self, batch: int, generator: Generators) -> Array:
        if self._exact is not None:
            return np.broadcast_to(self._exact, (batch, 3))
        return sample_lights(batch, generator, self.lights)

    def _weights(self, cameras: Array, shares: Array, light: Array) -> Array:
        """Compute weights ``(B, N)`` of the atoms for cameras ``(B, 2)`` and their shares in lights ``(B, 3)``."""
        mired = compute_mired(light)
        blocks = []
        for number, mireds in enumerate(self._mireds):
            share = (shares * (cameras == number)).sum(axis=1)
            blocks.append(share[:, None] * weights_in_light(mireds, mired))
        return np.concatenate(blocks, axis=1)

    def balance(self, weights: Array, light: Array) -> Array:
        """Compute the white balance ``(B, 3)``, green 1, of mixtures ``(B, N)`` in light of white points ``(B, 3)``."""
        from_xyz = np.einsum("bn,nij->bij", weights, self._from_xyz)
        response = np.einsum("bij,bj->bi", from_xyz, light)
        return np.asarray(response[:, 1:2] / response)
