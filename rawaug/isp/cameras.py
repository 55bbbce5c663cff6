r"""Published cameras by name: sRGB to camera colour, and the white-balance gains of a light.

A camera is a 3 x 3 matrix M from CIE XYZ to its linear RGB. Its response to a light of white point L is M L, so that

.. math:: \mathrm{wb} = (M L)_G / (M L), \qquad C = \mathrm{diag}(M S 1)^{-1} M S

with S from linear sRGB to XYZ: the rows of C sum to 1, so white stays white and the gains carry all of the balance,
as in dcraw and in Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019. The matrices are those of
LibRaw and rawspeed, most of them Adobe's for D65; under other lights they are an approximation, as in those developers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.isp.light import D65, white_point
from rawaug.registry import spelled

SRGB_TO_XYZ = torch.tensor(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]],
    dtype=torch.float64,
)
"""Linear sRGB (IEC 61966-2-1, D65) to CIE XYZ."""
XYZ_TO_SRGB = torch.linalg.inv(SRGB_TO_XYZ)

DAYLIGHT_GAINS = (0.6, 4.0)
"""Red and blue gains under D65 of a plausible camera."""
LARGEST_ENTRY = 2.0
"""Of C, in absolute value, of a plausible camera."""


class CameraMatrices(NamedTuple):
    """Matrices from CIE XYZ to camera RGB, each scaled to a green response of 1 to D65.

    Args:
        names: maker and model, one a matrix.
        xyz_to_camera: ``(N, 3, 3)`` float64.
        rejected: rows of the published tables left out, by reason.
    """

    names: tuple[str, ...]
    xyz_to_camera: Tensor
    rejected: dict[str, int]

    def distinct(self) -> Tensor:
        """The different ones among the matrices ``(M, 3, 3)``: bodies that share a sensor often share a matrix."""
        return torch.unique(self.xyz_to_camera, dim=0)

    def named(self, names: Sequence[str]) -> Tensor:
        """The matrices ``(len(names), 3, 3)`` of these cameras, whatever the case of the letters.

        Raises:
            ValueError: if one is not listed; similar names are suggested.

        Example:
            >>> published_cameras().named(["nikon d750"]).shape
            torch.Size([1, 3, 3])
        """
        return self.xyz_to_camera[[self.names.index(spelled(name, self.names)) for name in names]]


@cache
def published_cameras() -> CameraMatrices:
    """The plausible cameras of the package's table; where two sources name one camera LibRaw's comes first."""
    text = resources.files("rawaug.isp").joinpath("facts/camera_matrices.tsv").read_text("utf-8")
    rows = [line.split("\t") for line in text.splitlines()[2:]]
    matrices = torch.tensor([[float(value) for value in row[2:11]] for row in rows], dtype=torch.float64)
    matrices = matrices.reshape(-1, 3, 3) / 1e4
    reasons = {
        "four-colour sensor": torch.tensor([row[12] != "" for row in rows]),
        "singular": torch.linalg.det(matrices).abs() < 1e-3,
        "response not positive": ~(responses(matrices, white_point(D65)) > 0).all(dim=1),
    }
    gains = white_balance(matrices, white_point(D65))[:, 0::2]
    reasons["implausible gains"] = ~((gains >= DAYLIGHT_GAINS[0]) & (gains <= DAYLIGHT_GAINS[1])).all(dim=1)
    reasons["implausible colour"] = ~(colour_matrix(matrices).abs().amax(dim=(1, 2)) <= LARGEST_ENTRY)
    believed = torch.ones(len(rows), dtype=torch.bool)
    rejected = {}
    for reason, where in reasons.items():
        rejected[reason] = int((where & believed).sum())
        believed &= ~where
    names = tuple(f"{row[0]} {row[1]}" for row, kept in zip(rows, believed.tolist(), strict=True) if kept)
    return CameraMatrices(names, normalised(matrices[believed]), rejected)


def normalised(xyz_to_camera: Tensor) -> Tensor:
    """Matrices ``(..., 3, 3)`` scaled to a green response of 1 to D65, so that they may be averaged."""
    return xyz_to_camera / responses(xyz_to_camera, white_point(D65))[..., 1, None, None]


def colour_matrix(xyz_to_camera: Tensor) -> Tensor:
    """C, linear sRGB to white-balanced camera RGB: ``(..., 3, 3)`` whose rows sum to 1."""
    matrix = xyz_to_camera @ SRGB_TO_XYZ.to(xyz_to_camera)
    return matrix / matrix.sum(dim=-1, keepdim=True)


def responses(xyz_to_camera: Tensor, light: Tensor) -> Tensor:
    """RAW ``(..., 3)`` of a white surface under a light of white point ``(..., 3)``."""
    return torch.einsum("...ij,...j->...i", xyz_to_camera, light.to(xyz_to_camera))


def white_balance(xyz_to_camera: Tensor, light: Tensor) -> Tensor:
    """Gains ``(..., 3)`` that make a white surface grey under a light of white point ``(..., 3)``; green is 1."""
    response = responses(xyz_to_camera, light)
    return response[..., 1:2] / response
