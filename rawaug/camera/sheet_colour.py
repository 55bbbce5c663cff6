r"""The colours of a camera's data sheet, in each light that it names, and its lens shading.

With a matrix C from linear sRGB to white-balanced camera RGB, whose rows sum to 1, gains g (green 1) that make white
grey, S from linear sRGB to XYZ, and Bradford's adaptation B(L) from the light's white point to D65, the matrix from XYZ
under the light L is

.. math:: X = \mathrm{diag}(1 / g) \; C \; S^{-1} B(L) .
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from rawaug.camera.lights import REFERENCE, XYZ_TO_SRGB, adaptation, light_mired, light_xyz, mix_by_light
from rawaug.camera.matrices import camera_from_srgb, gains_in_light

MatrixKind = Literal["xyz_to_camera", "srgb_to_camera", "camera_to_srgb"]

_INVERSE_DIAGONAL = 1.1
"""A matrix to the camera whose diagonal is above this is the inverse of one: of 1,427 cameras none is like that."""
_MOST_GAIN = 100.0
"""Gains are between this and one over it."""
_LONGEST_SHADING = 256
"""Most rows and columns of a table of lens shading."""


class Anchor(NamedTuple):
    """A camera in one light of its data sheet.

    Args:
        light: the name of the light.
        mired: a million over its correlated colour temperature in kelvin.
        matrix: float64 ``(3, 3)``, from linear sRGB to white-balanced camera RGB, rows of sum 1.
        gains: float64 ``(3,)``, green 1.
        from_xyz: float64 ``(3, 3)``, X of this module.
    """

    light: str
    mired: float
    matrix: Tensor
    gains: Tensor
    from_xyz: Tensor


def read_anchors(matrix: Any, matrix_is: MatrixKind, white_balance: Any) -> list[Anchor]:
    """Read the colours of a sheet: the camera in each light that its figures name, warmest first.

    Args:
        matrix: 3 x 3, or a mapping of lights to such matrices.
        matrix_is: its direction.
        white_balance: gains of R, G and B, or a mapping of lights to them; None if the matrix determines them.

    Raises:
        ValueError: if a figure is missing, of another shape or out of range.
    """
    matrices = _by_light("matrix", matrix)
    _require_shape("matrix", matrices, (3, 3))
    gains = _by_light("white_balance", white_balance)
    _require_shape("white_balance", gains, (3,))
    for light, stated in gains.items():
        if not ((stated >= 1 / _MOST_GAIN) & (stated <= _MOST_GAIN)).all():
            rule = f"must be from {1 / _MOST_GAIN:g} to {_MOST_GAIN:g}"
            raise ValueError(f"white_balance of light {light} {rule}, got {stated.tolist()!r:.100}")
    if len(matrices) == 1 and gains and not isinstance(white_balance, dict):
        gains = dict.fromkeys(matrices, gains[REFERENCE])  # both are for the same light, that of the matrix

    from_srgb = {}
    for light, stated in matrices.items():
        from_srgb[light] = _from_srgb(light, stated, matrix_is)
    lights = {*matrices, *gains}
    if gains and not isinstance(matrix, dict):
        lights = {*gains}  # the single matrix serves in all of them

    anchors = []
    for light in sorted(lights, key=light_mired, reverse=True):
        to_camera = mix_by_light(from_srgb, light)
        neutral = gains.get(light)
        if neutral is None:
            neutral = _implied_gains(light, matrices, matrix_is)

        neutral = neutral / neutral[1]
        to_d65 = adaptation(light_xyz(light), light_xyz(REFERENCE))
        from_xyz = torch.diag(1.0 / neutral) @ to_camera @ XYZ_TO_SRGB @ to_d65
        anchors.append(Anchor(light, light_mired(light), to_camera, neutral, from_xyz))

    return anchors


def _by_light(key: str, value: Any) -> dict[str, Tensor]:
    """Read what a sheet states in each light, or in the one of D65; nothing if it states nothing."""
    if value is None:
        return {}
    if not isinstance(value, dict):
        value = {REFERENCE: value}

    by_light = {}
    for light, numbers in value.items():
        name = str(light)
        try:
            light_xyz(name)
            by_light[name] = torch.tensor(numbers, dtype=torch.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{key} of light {name!r:.40} cannot be read: {error}") from None

    if not by_light:
        raise ValueError(f"{key} names no light")
    return by_light


def _require_shape(key: str, by_light: Mapping[str, Tensor], shape: tuple[int, ...]) -> None:
    for light, numbers in by_light.items():
        if numbers.shape != shape or not numbers.isfinite().all():
            size = " x ".join(map(str, shape))
            raise ValueError(f"{key} of light {light} must be {size} finite numbers, got {numbers.tolist()!r:.100}")


def _from_srgb(light: str, matrix: Tensor, matrix_is: MatrixKind) -> Tensor:
    """The matrix of a light from linear sRGB to white-balanced camera RGB, rows of sum 1."""
    if matrix_is == "xyz_to_camera":
        under_light = adaptation(light_xyz(REFERENCE), light_xyz(light))
        return camera_from_srgb(matrix @ under_light)

    if matrix_is == "camera_to_srgb":
        if not float(torch.linalg.cond(matrix)) <= 1e6:  # NaN for a matrix of zeros
            raise ValueError(f"matrix of light {light} cannot be inverted")

        matrix = torch.linalg.inv(matrix)

    rows = matrix.sum(dim=1, keepdim=True)
    if not ((rows - 1.0).abs() < 0.05).all():
        sums = ", ".join(f"{value:.3f}" for value in rows.flatten().tolist())
        raise ValueError(f"matrix of light {light} must keep white: its rows sum to {sums}, not to 1")
    return matrix / rows


def _implied_gains(light: str, matrices: Mapping[str, Tensor], matrix_is: MatrixKind) -> Tensor:
    """The gains of a light that follow from the matrix from XYZ."""
    if matrix_is != "xyz_to_camera":
        raise ValueError(f"white_balance needs the gains of light {light} as well")

    response = matrices[light] @ light_xyz(light)
    if not (response > 0).all():
        raise ValueError(f"matrix of light {light} makes white negative: {response.tolist()}")
    return gains_in_light(matrices[light], light_xyz(light))


def check_colours(anchors: Sequence[Anchor], matrix_is: MatrixKind, states_gains: bool) -> None:
    """Refuse matrices in the wrong direction, and neutral colours in place of gains."""
    for light, _, matrix, gains, _ in anchors:
        if matrix_is != "xyz_to_camera" and bool((matrix.diagonal() > _INVERSE_DIAGONAL).all()):
            other = "srgb_to_camera" if matrix_is == "camera_to_srgb" else "camera_to_srgb"
            reason = f"of light {light} adds colour on the way to the camera, whose colours overlap"
            raise ValueError(f"matrix {reason}; is it {other}?")
        if states_gains and float(gains[0]) < 0.95 and float(gains[2]) < 0.95:
            reason = f"of light {light} makes green the strongest, as no sensor needs"
            raise ValueError(f"white_balance {reason}; of an AsShotNeutral give the reciprocals")


def read_shading(shading: Any) -> dict[str, Tensor]:
    """Read the tables ``(3, rows, columns)`` of each light of a sheet; none if no shading is stated.

    Raises:
        ValueError: if a table cannot be read, is of another size, or has values that are no shares of light.
    """
    by_light = {}
    for light, table in _by_light("shading", shading).items():
        if table.ndim == 2:
            table = table.expand(3, -1, -1)
        if table.ndim != 3 or len(table) != 3 or min(table.shape) < 2 or max(table.shape) > _LONGEST_SHADING:
            sides = " x ".join(map(str, table.shape))
            rule = f"must be a table of 2 to {_LONGEST_SHADING} rows and columns, or three of them"
            raise ValueError(f"shading of light {light} {rule}, got {sides or 'a number'}")
        if not bool(((table > 0) & (table <= 1)).all()):
            raise ValueError(f"shading of light {light} must be above 0 and at most 1; are these gains?")
        by_light[light] = table

    if len({table.shape for table in by_light.values()}) > 1:
        raise ValueError("shading needs tables of one size for all lights")
    return by_light
