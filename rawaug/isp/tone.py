r"""Inverse tone curves by name: display-referred sRGB to linear camera light.

A camera's engine takes linear light l to linear display light d = t(l), monotone, and encodes it as sRGB. The inverse
is kept as a table over the sRGB code s,

.. math:: T(s) = t^{-1}(\mathrm{EOTF}(s)), \qquad s = 0, \tfrac{1}{8 \cdot 255}, \dots, 1,

of which every eighth entry is an 8-bit code, without interpolation (EOTF: IEC 61966-2-1). A convex combination of
tables is monotone as they are. The curves t are monotone cubics (Fritsch and Carlson, 1980) through the points of
darktable's base curves, measured against cameras' JPEGs or drawn after a maker's; besides them ``linear``, LibRaw's
rendering, which has no curve, and ``upi``, the smoothstep and gamma 2.2 of Brooks et al. (CVPR 2019).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import cache
from importlib import resources

import numpy as np
import torch
from torch import Tensor

from rawaug.kernels.reference import through_curves

STEPS = 4
"""Entries of a table for each 8-bit level."""
NODES = 255 * STEPS + 1
_FINE = 2**16


def srgb_to_linear(code: Tensor) -> Tensor:
    """The sRGB transfer function: codes in [0, 1] to linear display light in [0, 1]."""
    return torch.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055).clamp_min(0.0) ** 2.4)


def tone_names() -> list[str]:
    """The curves that :func:`tone_tables` knows."""
    return list(_tables())


def tone_tables(names: Sequence[str] | None = None) -> Tensor:
    """Tables ``(K, 1021)`` float32 from 0 to 1, not decreasing; all curves by default.

    Raises:
        ValueError: if a name is unknown.

    Example:
        >>> round(tone_tables(["linear"])[0, 128 * STEPS].item(), 4)
        0.2159
    """
    tables = _tables()
    unknown = [name for name in names or () if name not in tables]
    if unknown:
        raise ValueError(f"tone curve {unknown[0]!r} is unknown; use one of {', '.join(tables)}")
    return torch.stack([tables[name] for name in (tables if names is None else names)])


def to_linear(srgb: Tensor, tables: Tensor) -> Tensor:
    """Pictures ``(B, C, H, W)``, uint8 or float in [0, 1], through one table ``(B, 1021)`` each; float32."""
    return through_curves(tables[:, ::STEPS] if srgb.dtype == torch.uint8 else tables, srgb)


def to_code(linear: Tensor, tables: Tensor) -> Tensor:
    """The way back: linear light ``(B, C, H, W)``, held to [0, 1], to sRGB codes in [0, 1], float32."""
    light = linear.clamp(0.0, 1.0).flatten(1).to(tables)
    right = torch.searchsorted(tables, light).clamp(1, NODES - 1)
    low, high = tables.gather(1, right - 1), tables.gather(1, right)
    share = ((light - low) / (high - low).clamp_min(1e-12)).clamp(0.0, 1.0)
    return ((right - 1 + share) / (NODES - 1)).reshape(linear.shape)


@cache
def _tables() -> dict[str, Tensor]:
    code = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
    display = srgb_to_linear(code)
    tables = {"linear": display.float(), "upi": _inverse_smoothstep(code).float()}
    text = resources.files("rawaug.isp").joinpath("facts/tone_curves.json").read_text("utf-8")
    for name, points in json.loads(text)["curves"].items():
        tables[name] = _inverse(_through(points), display).float()
    return tables


def _inverse_smoothstep(code: Tensor) -> Tensor:
    return (0.5 - torch.sin(torch.asin(1.0 - 2.0 * code) / 3.0)).clamp_min(0.0) ** 2.2


def _through(points: Sequence[Sequence[float]]) -> Callable[[np.ndarray], np.ndarray]:
    """The monotone cubic through ``points`` (camera, display), from black: a measured one may start at an offset."""
    from scipy.interpolate import PchipInterpolator  # slow to import, and needed by nothing else

    light, display = np.array(points).T
    display[0] = 0.0
    curve: Callable[[np.ndarray], np.ndarray] = PchipInterpolator(light, display)
    return curve


def _inverse(curve: Callable[[np.ndarray], np.ndarray], display: Tensor) -> Tensor:
    """Camera light ``(N,)`` at which the curve reaches ``display`` ``(N,)``; quadratic nodes, dense near black."""
    light = np.linspace(0.0, 1.0, _FINE) ** 2
    reached = np.maximum.accumulate(curve(light))
    reached = reached / reached[-1]
    rising = np.concatenate([[True], np.diff(reached) > 0])
    return torch.from_numpy(np.interp(display.numpy(), reached[rising], light[rising]))
