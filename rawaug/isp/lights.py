r"""Lights by name or colour temperature, and interpolation between two of them.

Bradford's adaptation takes XYZ from the white point w of one light to w' of another,

.. math:: B = M^{-1} \, \mathrm{diag}(M w' / M w) \, M .

The correlated colour temperature is McCamy's (1992). Between two lights of temperatures :math:`T_1 < T < T_2` figures
are mixed linearly in mired, a million over the temperature, as in the DNG specification (Adobe, 1.7),

.. math:: w_1 = \frac{1/T - 1/T_2}{1/T_1 - 1/T_2}, \qquad w_2 = 1 - w_1,

and beyond the outermost light its figures stay constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from rawaug.isp.cameras import LAMPS, SRGB_TO_XYZ, Array, daylight, planckian, white_point
from rawaug.registry import suggest

REFERENCE = "D65"
"""The light whose white point is the white of sRGB."""

ILLUMINANTS = {
    "A": (0.44758, 0.40745),
    "D50": (0.34567, 0.35850),
    "D55": (0.33242, 0.34743),
    "D65": (0.31271, 0.32902),
    "D75": (0.29902, 0.31485),
}
"""Chromaticities (x, y) of CIE standard illuminants, 2 degree observer (CIE 15:2018, table T.3)."""

_BRADFORD = torch.tensor(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]], dtype=torch.float64
)
"""The matrix M, from XYZ to the responses of the cones."""


def _light_chromaticity(light: str) -> tuple[float, float]:
    """The chromaticity (x, y) of a light by its name or its colour temperature in kelvin; ValueError if unknown."""
    if light in ILLUMINANTS:
        return ILLUMINANTS[light]
    if light in LAMPS:
        return LAMPS[light]

    try:
        kelvin = float(light.removesuffix("K").strip())
    except ValueError:
        names = [*ILLUMINANTS, *LAMPS]
        listed = f"{', '.join(names)}{suggest(light, names)}"
        raise ValueError(f"light {light!r:.40} is unknown; use a number in kelvin, {listed}") from None

    if not 1000 <= kelvin <= 15000:
        raise ValueError(f"a light must be 1,000 to 15,000 kelvin, got {kelvin:g}")

    locus = planckian if kelvin < 4000 else daylight
    x, y = locus(np.array(kelvin)).tolist()
    return x, y


def light_xyz(light: str) -> Tensor:
    """The white point of a light, XYZ ``(3,)`` with Y = 1; that of D65 is the white of sRGB."""
    if light == REFERENCE:
        return SRGB_TO_XYZ.sum(dim=1)
    return white_point(_light_chromaticity(light))


def light_mired(light: str) -> float:
    """A million over the correlated colour temperature of a light."""
    return float(mired_of(light_xyz(light)[None].numpy())[0])


def mired_of(white: Array) -> Array:
    """A million over the correlated colour temperatures ``(B,)`` of white points ``(B, 3)`` (McCamy, 1992)."""
    total = white.sum(axis=1)
    x, y = white[:, 0] / total, white[:, 1] / total
    n = (x - 0.3320) / (0.1858 - y)
    kelvin = ((449.0 * n + 3525.0) * n + 6823.3) * n + 5520.33
    return np.asarray(1e6 / np.maximum(kelvin, 1000.0))


def adaptation(white: Tensor, other: Tensor) -> Tensor:
    """Bradford's adaptation ``(3, 3)`` of XYZ from one white point ``(3,)`` to another."""
    cones = (_BRADFORD @ other) / (_BRADFORD @ white)
    return torch.linalg.inv(_BRADFORD) @ torch.diag(cones) @ _BRADFORD


def weights_in_light(anchors: Sequence[float], mired: Array) -> Array:
    """Weights ``(B, N)`` of anchors at ascending or descending mireds, linear between two and constant beyond."""
    mireds = np.asarray(anchors, dtype=np.float64)
    if len(mireds) == 1:
        return np.ones((len(mired), 1))

    order = np.argsort(mireds)
    rows = np.eye(len(mireds))[order]
    columns = []
    for column in rows.T:
        columns.append(np.interp(mired, mireds[order], column))
    return np.stack(columns, axis=1)


def mix_by_light(matrices: Mapping[str, Tensor], light: str) -> Tensor:
    """Get the matrix of a light, or the mixture of the matrices of the lights beside it."""
    if light in matrices:
        return matrices[light]

    mireds = list(map(light_mired, matrices))
    weights = torch.from_numpy(weights_in_light(mireds, np.array([light_mired(light)])))[0]
    return torch.einsum("n,nij->ij", weights, torch.stack(list(matrices.values())))
