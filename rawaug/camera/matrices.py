r"""Published cameras: matrices, and the gains that follow from them in any light.

A camera is a 3 x 3 matrix M from CIE XYZ to its linear RGB. Its response to a light of white point L is M L, so that

.. math:: \mathrm{wb} = (M L)_G / (M L), \qquad C = \mathrm{diag}(M S 1)^{-1} M S

with S from linear sRGB to XYZ. The rows of C sum to 1, so white stays white and the gains carry all of the balance
(Brooks et al., CVPR 2019). The matrices are those of LibRaw and rawspeed, most of them Adobe's for D65. Under other
lights they are an approximation, as in those developers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.camera.lights import D65, SRGB_TO_XYZ, white_point
from rawaug.camera.names import find_camera


class CameraMatrices(NamedTuple):
    """Matrices from CIE XYZ to camera RGB, each scaled to a green response of 1 to D65.

    Args:
        names: makers and models of the P cameras.
        xyz_to_camera: float64 ``(P, 3, 3)``.
    """

    names: tuple[str, ...]
    xyz_to_camera: Tensor

    def select(self, names: Sequence[str]) -> Tensor:
        """Get the matrices ``(N, 3, 3)`` of N cameras by name, in upper or lower case; ValueError if unknown."""
        rows = []
        for name in names:
            listed_name = find_camera(name, self.names)
            rows.append(self.names.index(listed_name))
        return self.xyz_to_camera[rows]


@cache
def load_cameras() -> CameraMatrices:
    """Load the cameras of the package's table; if two sources name one camera, LibRaw's comes first."""
    text = resources.files("rawaug.camera").joinpath("facts/camera_matrices.tsv").read_text("utf-8")
    names = []
    rows = []
    for line in text.splitlines()[2:]:
        maker, model, *columns = line.split("\t")
        names.append(f"{maker} {model}")
        rows.append([float(value) for value in columns[:9]])

    matrices = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3, 3) / 1e4
    green = responses(matrices, white_point(D65))[:, 1, None, None]
    return CameraMatrices(tuple(names), matrices / green)


def camera_from_srgb(xyz_to_camera: Tensor) -> Tensor:
    """Compute C, from linear sRGB to white-balanced camera RGB: ``(..., 3, 3)`` whose rows sum to 1."""
    matrix = xyz_to_camera @ SRGB_TO_XYZ.to(xyz_to_camera)
    return matrix / matrix.sum(dim=-1, keepdim=True)


def responses(xyz_to_camera: Tensor, light: Tensor) -> Tensor:
    """Compute the RAW ``(..., 3)`` of a white surface in a light of white point ``(..., 3)``."""
    return torch.einsum("...ij,...j->...i", xyz_to_camera, light.to(xyz_to_camera))


def gains_in_light(xyz_to_camera: Tensor, light: Tensor) -> Tensor:
    """Compute the gains ``(..., 3)``, green 1, that make white grey in a light of white point ``(..., 3)``."""
    response = responses(xyz_to_camera, light)
    return response[..., 1:2] / response


def daylight_gains(xyz_to_camera: Tensor) -> Tensor:
    """Compute the gains ``(..., 3)`` in D65, the light that the matrices ``(..., 3, 3)`` are made for."""
    return gains_in_light(xyz_to_camera, white_point(D65))
