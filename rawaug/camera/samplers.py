r"""Cameras in a light, drawn at random, on the CPU.

One draw is a camera in a light, not a colour matrix and gains independently of each other:

.. math:: g = \mathrm{wb}(M, L) / \min \mathrm{wb}(M, L), \qquad (C, M) = D_\mathrm{cam} w

with w a mixture of two of the cameras, C its matrix from linear sRGB and M that from XYZ, and a light L
(:mod:`rawaug.camera.lights`). The smallest gain is 1, so that clipped RAW develops to white. Shares of a mixture follow
the Dirichlet distribution of concentration 1/2, so that most draws are near one camera. Flat weights would crowd the
middle of the hull, where cameras are rare. A camera and a light whose gains are implausible are drawn again.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rawaug.camera.lights import (
    ILLUMINANTS,
    XYZ_TO_SRGB,
    Array,
    LightRange,
    compute_mired,
    light_range,
    light_xyz,
    sample_lights,
    weights_in_light,
)
from rawaug.camera.own import Camera
from rawaug.seeding import Generators, draw_rows, take_generators

PLAUSIBLE_GAINS = (0.4, 6.0)
"""Range of red and blue gains over green that are kept; a D65 matrix says nothing about light that needs more."""
CAMERAS_MIXED = 2
_FROM_XYZ = XYZ_TO_SRGB.numpy().T
_ROUNDS = 100

Numbers = NDArray[np.int64]


def sparse_shares(batch: int, atoms: int, mixed: int, generator: Generators) -> tuple[Numbers, Array]:
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
    indices = draw_rows(generator, partial(torch.randint, atoms), batch, mixed, dtype=torch.int64).numpy()
    normals = draw_rows(generator, torch.randn, batch, mixed, dtype=torch.float64).numpy()
    squares = normals * normals
    return indices, squares / squares.sum(axis=1, keepdims=True)


class CameraSampler:
    """Draws published cameras, as mixtures of N atoms.

    Args:
        mixtures: ``(P, N)``, each camera as a mixture of the atoms.
        matrices: ``(N, 3, 3)``, from linear sRGB to white-balanced camera RGB.
        responses: ``(N, 3)``, the atoms' responses to D65.
        lights: the lights to draw from.
        consistent: whether colour and gains are of one camera in one light; if not, the gains are drawn separately.

    Raises:
        ValueError: when it draws, if no light gives the cameras plausible gains.
    """

    plausible = PLAUSIBLE_GAINS

    def __init__(
        self, mixtures: Tensor, matrices: Tensor, responses: Tensor, lights: LightRange, consistent: bool = True
    ) -> None:
        self.mixtures = _as_array(mixtures)
        self.matrices = _as_array(matrices.flatten(1))
        self.responses = _as_array(responses)
        self.lights, self.consistent = lights, consistent

    def sample(self, batch: int, generator: Generators) -> tuple[Tensor, Tensor, Tensor]:
        """Draw ``batch`` cameras in a light from a generator on the CPU, or one each.

        Returns:
            Weights of the atoms ``(batch, N)``, matrices from linear sRGB ``(batch, 3, 3)`` and gains ``(batch, 3)``,
            the smallest of which is 1; float32.
        """
        weights, balance = self._cameras_in_light(batch, generator)
        if not self.consistent:
            _, balance = self._cameras_in_light(batch, generator)

        matrices = _row_by_row(weights, self.matrices).reshape(-1, 3, 3)
        gains = balance / balance.min(axis=1, keepdims=True)
        return _as_tensor(weights), _as_tensor(matrices), _as_tensor(gains)

    def _cameras_in_light(self, batch: int, generator: Generators) -> tuple[Array, Array]:
        """Draw weights ``(B, N)`` and balances ``(B, 3)``, until they are plausible."""

        def draw(count: int, generators: Generators) -> tuple[Array, Array]:
            cameras, shares = sparse_shares(count, len(self.mixtures), CAMERAS_MIXED, generators)
            weights, light = self.draw_in_light(cameras, shares, generators)
            return weights, self.balance(weights, light)

        weights, balance = draw(batch, generator)
        for _ in range(_ROUNDS):
            is_plausible = self.is_plausible(balance)
            if is_plausible.all():
                return weights, balance
            (again,) = np.nonzero(~is_plausible)
            weights[again], balance[again] = draw(len(again), take_generators(generator, again))

        low, high = self.plausible
        raise ValueError(f"no light of {self.lights.kelvin} K gives these cameras gains within {low:g} to {high:g}")

    def is_plausible(self, balance: Array) -> NDArray[np.bool_]:
        """Say which white balances ``(B, 3)`` a camera may have: booleans ``(B,)``."""
        low, high = self.plausible
        return np.asarray(((balance >= low) & (balance <= high)).all(axis=1))

    def draw_in_light(self, cameras: Numbers, shares: Array, generator: Generators) -> tuple[Array, Array]:
        """Draw lights for mixtures of cameras, by their numbers and shares ``(B, 2)``.

        Returns:
            Weights of the atoms ``(B, N)``, and white points ``(B, 3)``, XYZ with Y = 1.
        """
        weights = (shares[..., None] * self.mixtures[cameras]).sum(axis=1)
        return weights, sample_lights(len(cameras), generator, self.lights)

    def balance(self, weights: Array, light: Array) -> Array:
        """Compute the white balance ``(B, 3)``, green 1, of mixtures ``(B, N)`` in light of white points ``(B, 3)``."""
        linear = light @ _FROM_XYZ
        matrices = _row_by_row(weights, self.matrices).reshape(-1, 3, 3)
        response = _row_by_row(weights, self.responses) * (matrices * linear[:, None]).sum(axis=2)
        return np.asarray(response[:, 1:2] / response)


class DataSheetSampler(CameraSampler):
    """Draws cameras of data sheets, whose atoms are one camera in one of its lights, in the order of the cameras.

    A light that is named in the data sheets is exactly that light; all others scatter as for published cameras.

    Args:
        cameras: the cameras.
        mixtures, matrices, responses, consistent: as for :class:`CameraSampler`.
        light: as in :class:`rawaug.Draw`.

    Raises:
        ValueError: if the light is unknown.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        mixtures: Tensor,
        matrices: Tensor,
        responses: Tensor,
        light: float | str | None = None,
        consistent: bool = True,
    ) -> None:
        sheets = [camera.anchors() for camera in cameras]
        anchors = [anchor for sheet in sheets for anchor in sheet]
        self._mireds = [[anchor.mired for anchor in sheet] for sheet in sheets]
        self._from_xyz = np.stack([anchor.from_xyz.numpy() for anchor in anchors])

        # Gains from the data sheets count as plausible, whatever they are.
        gains = torch.stack([anchor.gains for anchor in anchors])
        self.plausible = min(PLAUSIBLE_GAINS[0], float(gains.min())), max(PLAUSIBLE_GAINS[1], float(gains.max()))

        self._exact: Array | None = None
        lights = LightRange()
        if isinstance(light, str) and light in (*ILLUMINANTS, *(anchor.light for anchor in anchors)):
            self._exact = light_xyz(light).numpy()
        else:
            lights = light_range(light)
        super().__init__(mixtures, matrices, responses, lights, consistent)

    def draw_in_light(self, cameras: Numbers, shares: Array, generator: Generators) -> tuple[Array, Array]:
        """Draw lights, or take the one that is named, and weigh each camera's atoms by how near their light is."""
        if self._exact is None:
            light = sample_lights(len(cameras), generator, self.lights)
        else:
            light = np.broadcast_to(self._exact, (len(cameras), 3))

        mired = compute_mired(light)
        blocks = []
        for number, mireds in enumerate(self._mireds):
            share = (shares * (cameras == number)).sum(axis=1)
            blocks.append(share[:, None] * weights_in_light(mireds, mired))
        return np.concatenate(blocks, axis=1), light

    def balance(self, weights: Array, light: Array) -> Array:
        """Compute the white balance ``(B, 3)``, green 1, of mixtures ``(B, N)`` in light of white points ``(B, 3)``."""
        from_xyz = np.einsum("bn,nij->bij", weights, self._from_xyz)
        response = np.einsum("bij,bj->bi", from_xyz, light)
        return np.asarray(response[:, 1:2] / response)


def _row_by_row(rows: Array, matrix: Array) -> Array:
    """Multiply rows ``(B, N)`` by a matrix, with the same bits however many there are, which BLAS does not promise."""
    return np.asarray((rows[:, None] @ matrix)[:, 0])


def _as_tensor(array: Array) -> Tensor:
    return torch.from_numpy(array).float()


def _as_array(tensor: Tensor) -> Array:
    return np.asarray(tensor.detach().to("cpu", torch.float64).numpy())
