r"""The lights that pictures are taken in: by name, by colour temperature, drawn at random, and between two others.

A light is drawn uniformly in mired, :math:`10^6 / T` of its colour temperature T, or, as most photographs are taken, on
the daylight locus at T near 5,300 K. On the Planckian locus (Krystek, 1985)

.. math:: u = \frac{0.860117757 + 1.54118254 \cdot 10^{-4} T + 1.28641212 \cdot 10^{-7} T^2}
                   {1 + 8.42420235 \cdot 10^{-4} T + 7.08145163 \cdot 10^{-7} T^2}

and v likewise; on the daylight locus :math:`y = -3 x^2 + 2.87 x - 0.275` (CIE 15:2018, 4,000 to 25,000 K). Real lights
lie a step Duv off both, along the normal in CIE 1960 (u, v), positive towards green.

Bradford's adaptation takes XYZ from the white point w of one light to w' of another,

.. math:: B = M^{-1} \, \mathrm{diag}(M w' / M w) \, M .

The correlated colour temperature is McCamy's (1992). Between two lights of temperatures :math:`T_1 < T < T_2` figures
are mixed linearly in mired, a million over the temperature, as in the DNG specification (Adobe, 1.7),

.. math:: w_1 = \frac{1/T - 1/T_2}{1/T_1 - 1/T_2}, \qquad w_2 = 1 - w_1,

and beyond the outermost light its figures stay constant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rawaug.registry import suggest
from rawaug.seeding import Generators, draw_rows

Array = NDArray[np.float64]
"""The type of lights, which are a few numbers a batch on the CPU: NumPy's calls cost a fifth of PyTorch's."""

SRGB_TO_XYZ = torch.tensor(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]],
    dtype=torch.float64,
    device="cpu",
)
"""The matrix from linear sRGB (IEC 61966-2-1, D65) to CIE XYZ."""
XYZ_TO_SRGB = torch.linalg.inv(SRGB_TO_XYZ)

LAMPS: dict[str, tuple[float, float]] = {
    "FL1": (0.31310, 0.33727), "FL2": (0.37208, 0.37529), "FL3": (0.40910, 0.39430), "FL4": (0.44018, 0.40329),
    "FL5": (0.31379, 0.34531), "FL6": (0.37790, 0.38835), "FL7": (0.31292, 0.32933), "FL8": (0.34588, 0.35875),
    "FL9": (0.37417, 0.37281), "FL10": (0.34609, 0.35986), "FL11": (0.38052, 0.37713), "FL12": (0.43695, 0.40441),
    "LED-B1": (0.4560, 0.4078), "LED-B2": (0.4357, 0.4012), "LED-B3": (0.3756, 0.3723), "LED-B4": (0.3422, 0.3502),
    "LED-B5": (0.3118, 0.3236), "LED-BH1": (0.4474, 0.4066), "LED-RGB1": (0.4557, 0.4211), "LED-V1": (0.4548, 0.4044),
    "LED-V2": (0.3781, 0.3775),
}  # fmt: skip
"""Chromaticities (x, y) of the CIE's fluorescent and LED lamps, 2 degree observer: CIE 15:2018, tables T.3 and 12.

LED-V1 is the chromaticity of its tabulated spectrum; the (0.4560, 0.4548) that is widely quoted is not.
"""

_LAMPS = np.array(list(LAMPS.values()))

D65 = (0.31271, 0.32902)

_COLDEST, _WARMEST = 10_000.0, 2_000.0
"""Limits of the colour temperature, in kelvin."""
_DAYLIGHT_FROM = 4_000.0
"""The lowest colour temperature of the daylight locus, in kelvin."""
_DAYLIGHT_SHARE = 0.9
_DAYLIGHT_MIRED = (190.0, 25.0)
"""Mean and standard deviation; as-shot balances of photographs are mostly between 4,000 and 6,500 K."""
_LAMP_SHARE = 0.1
_DUV_SPREAD = 0.003
"""Standard deviation of Duv; lamps sold as white stay within 0.006 (ANSI C78.377)."""


class LightRange(NamedTuple):
    """The lights that pictures are taken in: equally on both loci within limits, among lamps, and in daylight.

    Args:
        kelvin: limits of the colour temperature, within 1,000 to 15,000.
        lamps: share of the draws that are one of ``among``, whatever its colour temperature.
        among: chromaticities of lamps, ``(L, 2)``.
        by_day: share of the draws that are daylight as in most photographs.
    """

    kelvin: tuple[float, float] = (_WARMEST, _COLDEST)
    lamps: float = _LAMP_SHARE
    among: Array = _LAMPS
    by_day: float = 0.0


_ALL_LIGHTS = LightRange()
PHOTOGRAPHS = LightRange(by_day=_DAYLIGHT_SHARE)
"""The lights of photographs, most of which are taken by day."""


def light_range(light: float | str | None) -> LightRange:
    """The lights of a colour temperature in kelvin, one of :data:`LAMPS` by name, or :data:`PHOTOGRAPHS` by default."""
    if light is None:
        return PHOTOGRAPHS

    if isinstance(light, str):
        if light not in LAMPS:
            listed, near = ", ".join(LAMPS), suggest(light, LAMPS)
            raise ValueError(f"light {light!r} is unknown; use a colour temperature or one of {listed}{near}")
        return PHOTOGRAPHS._replace(lamps=1.0, among=np.array([LAMPS[light]]))

    if not _WARMEST <= light <= _COLDEST:
        raise ValueError(f"light must be {_WARMEST:g} to {_COLDEST:g} kelvin, got {light:g}")
    return LightRange((float(light), float(light)), lamps=0.0)


def planckian(kelvin: Array) -> Array:
    """Compute the chromaticity ``(..., 2)`` of a black body at 1,000 to 15,000 K."""
    return _xy_from_uv(_planckian_uv(kelvin)[0])


def daylight(kelvin: Array) -> Array:
    """Compute the chromaticity ``(..., 2)`` of daylight at 4,000 to 25,000 K."""
    t = (1e3 / kelvin)[..., None]
    c0, c1, c2, c3 = _DAYLIGHT
    both = ((c3 * t + c2) * t + c1) * t + c0

    x = np.where(kelvin <= 7000, both[..., 0], both[..., 1])
    xy = np.empty((*x.shape, 2))
    xy[..., 0] = x
    xy[..., 1] = (2.87 - 3.0 * x) * x - 0.275
    return xy


def move_off_locus(xy: Array, kelvin: Array, duv: Array) -> Array:
    """Move ``xy`` ``(..., 2)`` by ``duv`` ``(...)`` along the normal of the Planckian locus at ``kelvin`` ``(...)``."""
    return _move_along(_planckian_uv(kelvin)[1], xy, duv)


def _move_along(rate: Array, xy: Array, duv: Array) -> Array:
    """Move ``xy`` by ``duv`` along the normal of a locus whose (u, v) change with the temperature at ``rate``."""
    normal = rate[..., ::-1] * _TO_HIGHER_V
    length = np.hypot(rate[..., 0], rate[..., 1])

    uv = xy * _XY_IN_UV / (12.0 * xy[..., 1:] - 2.0 * xy[..., :1] + 3.0)
    return _xy_from_uv(uv + (duv / length)[..., None] * normal)


def white_point(xy: Array | tuple[float, float]) -> Tensor:
    """Convert chromaticities ``(..., 2)`` to XYZ ``(..., 3)`` with Y = 1, float64."""
    return torch.from_numpy(_white_point(np.asarray(xy, dtype=np.float64)))


def sample_lights(batch: int, generator: Generators, lights: LightRange = _ALL_LIGHTS) -> Array:
    """Draw white points ``(batch, 3)``, XYZ with Y = 1; if both loci are defined, each is used equally often.

    Args:
        batch: number of lights.
        generator: a generator on the CPU, or one for each light.
        lights: the range to draw from.
    """
    kelvin, lamps, among, by_day = lights

    numbers = partial(draw_rows, generator, dtype=torch.float64)

    uniform = numbers(torch.rand, batch, 4).numpy()
    duv = _DUV_SPREAD * numbers(torch.randn, batch).numpy()

    temperature = 1.0 / (1 / kelvin[1] + (1 / kelvin[0] - 1 / kelvin[1]) * uniform[:, 0])
    on_daylight = uniform[:, 1] < 0.5
    if by_day:
        sunny = numbers(torch.rand, batch).numpy() < by_day
        mired = _DAYLIGHT_MIRED[0] + _DAYLIGHT_MIRED[1] * numbers(torch.randn, batch).numpy()
        temperature = np.where(sunny, (1e6 / mired.clip(1.0)).clip(*kelvin), temperature)
        on_daylight |= sunny
    on_daylight &= temperature >= _DAYLIGHT_FROM

    by_daylight = daylight(np.maximum(temperature, _DAYLIGHT_FROM))
    black_body, rate = _planckian_uv(temperature)
    on_locus = np.where(on_daylight[:, None], by_daylight, _xy_from_uv(black_body))
    lamp = among[(uniform[:, 3] * len(among)).astype(np.int64)]
    xy = np.where(uniform[:, 2:3] < lamps, lamp, on_locus)
    return _white_point(_move_along(rate, xy, duv))


def _planckian_uv(kelvin: Array) -> tuple[Array, Array]:
    """Compute Krystek's (u, v) ``(..., 2)`` of a black body, and their derivatives by the temperature."""
    t = kelvin[..., None]
    c0, c1, c2 = _PLANCKIAN
    value = (c2 * t + c1) * t + c0
    rate = 2.0 * c2 * t + c1

    uv = value[..., :2] / value[..., 2:]
    return uv, (rate[..., :2] - uv * rate[..., 2:]) / value[..., 2:]


def _white_point(xy: Array) -> Array:
    x, y = xy[..., 0], xy[..., 1]
    xyz = np.ones((*x.shape, 3))
    xyz[..., 0] = x / y
    xyz[..., 2] = (1.0 - x - y) / y
    return xyz


def _xy_from_uv(uv: Array) -> Array:
    return uv * _UV_IN_XY / (2.0 * uv[..., :1] - 8.0 * uv[..., 1:] + 4.0)


_XY_IN_UV, _UV_IN_XY = np.array([4.0, 6.0]), np.array([3.0, 2.0])
"""Factors of the numerators of u, v (CIE 1960) in x, y, and of x, y in u, v."""
_TO_HIGHER_V = np.array([1.0, -1.0])
"""The locus runs to lower u as it gets hotter."""

_PLANCKIAN = np.array(
    [
        [0.860117757, 0.317398726, 1.0, 1.0],
        [1.54118254e-4, 4.22806245e-5, 8.42420235e-4, -2.89741816e-5],
        [1.28641212e-7, 4.20481691e-8, 7.08145163e-7, 1.61456053e-7],
    ]
)
"""Coefficients of 1, T and T^2: the numerators of u and v, then their denominators."""
_DAYLIGHT = np.array([[0.244063, 0.237040], [0.09911, 0.24748], [2.9678, 1.9018], [-4.6070, -2.0064]])
"""Coefficients of the powers of 1000 / T in x: up to 7,000 K, and above."""

REFERENCE = "D65"
"""The light whose white point is the white of sRGB."""

ILLUMINANTS = {
    "A": (0.44758, 0.40745),
    "D50": (0.34567, 0.35850),
    "D55": (0.33242, 0.34743),
    "D65": D65,
    "D75": (0.29902, 0.31485),
}
"""Chromaticities (x, y) of CIE standard illuminants, 2 degree observer (CIE 15:2018, table T.3)."""

_BRADFORD = torch.tensor(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]],
    dtype=torch.float64,
    device="cpu",
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
    return float(compute_mired(light_xyz(light)[None].numpy())[0])


def compute_mired(white: Array) -> Array:
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
    """Get the matrix of a light, or the mixture of those of the lights beside it; all have one shape."""
    if light in matrices:
        return matrices[light]

    mireds = list(map(light_mired, matrices))
    weights = torch.from_numpy(weights_in_light(mireds, np.array([light_mired(light)])))[0]
    return torch.tensordot(weights, torch.stack(list(matrices.values())), dims=1)
