r"""Noise levels of measured cameras, by ISO.

A sensor's gain K, in digital numbers (DN) an electron, grows with the ISO. With V DN from black to white and read noise
of :math:`\sigma` DN,

.. math:: \mathrm{shot\_var} = K / V, \qquad \mathrm{read\_var} = \sigma^2 / V^2 .

Three published sets: five phones of SIDD, tabulated per ISO (Abdelhamed et al. 2018; the numbers of Noise Flow, 2019),
the line of PMRID for one phone (Wang et al. 2020), and the log-linear laws of ELD for five cameras (Wei et al. 2020).
Outside the range that was measured an ISO is refused. Without an ISO the whole range is sampled, log-uniformly.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rawaug.noise.levels import log_uniform, published

Iso = float | tuple[float, float] | None
"""One ISO, the limits of a log-uniform draw, or None for the whole measured range."""


def iso_limits(camera: str, iso: Iso, measured: tuple[float, float]) -> tuple[float, float]:
    """The limits of the draw that ``iso`` asks for.

    Raises:
        ValueError: if they leave the measured range.
    """
    if iso is None:
        return measured
    low, high = (iso, iso) if isinstance(iso, (int, float)) else (iso[0], iso[1])
    if not measured[0] <= low <= high <= measured[1]:
        raise ValueError(f"ISO {iso} is outside the measured range of {camera}, {measured[0]:g} to {measured[1]:g}")
    return float(low), float(high)


def interpolated(table: Tensor, iso: Tensor) -> tuple[Tensor, Tensor]:
    """(shot_var, read_var), each ``(B,)`` float32, at ISO values ``(B,)`` within a table of two rows or more.

    Args:
        table: logarithms of ISO, shot_var and read_var, ``(3, N)`` float64, the ISO values ascending.
        iso: where to read it, linearly in the logarithms.
    """
    x, shot, read = table
    at = iso.log().double()
    right = torch.bucketize(at, x).clamp(1, len(x) - 1)
    t = (at - x[right - 1]) / (x[right] - x[right - 1])
    shot_var, read_var = (torch.exp(torch.lerp(y[right - 1], y[right], t)).float() for y in (shot, read))
    return shot_var, read_var


class SiddLevels:
    """One of SIDD's phones: interpolated in the logarithms of ISO and variance between the tabulated ISOs.

    Example:
        >>> shot_var, read_var = SiddLevels("Google Pixel", iso=1200).sample(2, torch.Generator())
    """

    def __init__(self, phone: str, iso: Iso = None) -> None:
        phones = published()["sidd_noise_level_function"]["cameras"]
        if phone not in phones:
            raise ValueError(f"SIDD phone {phone!r} is unknown; use one of {', '.join(phones)}")
        rows = sorted((float(key), *pair) for key, pair in phones[phone].items())
        self.table = torch.tensor(rows, dtype=torch.float64).log().T.contiguous()
        self.iso = iso_limits(phone, iso, (rows[0][0], rows[-1][0]))

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        return interpolated(self.table.to(generator.device), log_uniform(self.iso, batch, generator))


class PmridLevels:
    """The OPPO Reno 10x of PMRID: gain linear, read variance quadratic in the ISO."""

    def __init__(self, iso: Iso = None) -> None:
        self.law: dict[str, Any] = published()["pmrid"]
        self.iso = iso_limits("pmrid", iso, tuple(self.law["iso"]))

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        iso, white = log_uniform(self.iso, batch, generator), self.law["white_dn"]
        (k1, k0), (s2, s1, s0) = self.law["K"], self.law["sigma2"]
        return (k1 * iso + k0) / white, ((s2 * iso + s1) * iso + s0) / white**2


class EldLevels:
    """One of ELD's cameras: every scale s is log-linear in the gain, log s = slope log K + bias + N(0, sigma^2).

    As levels they give the Gaussian law of read noise; :class:`rawaug.noise.compose.EldNoise` is the full model.
    """

    def __init__(self, camera: str, iso: Iso = None) -> None:
        law = published()["eld"]
        if camera not in law["cameras"]:
            raise ValueError(f"ELD camera {camera!r} is unknown; use one of {', '.join(law['cameras'])}")
        self.camera: dict[str, Any] = law["cameras"][camera]
        self.white_dn = float(law["white_dn"])
        self.lowest_iso = float(law["iso"][0])
        self.iso = iso_limits(camera, iso, tuple(law["iso"]))

    def sample_gain(self, batch: int, generator: torch.Generator) -> Tensor:
        """K in DN an electron, ``(batch,)``."""
        return log_uniform(self.iso, batch, generator) * (self.camera["Kmin"] / self.lowest_iso)

    def sample_scale(self, law: str, gain: Tensor, generator: torch.Generator) -> Tensor:
        """The scale of ``row``, ``gaussian`` or ``tukey_lambda`` noise at these gains, ``(B,)``, white = 1."""
        line = self.camera[law]
        scatter = line["sigma"] * torch.randn(gain.shape, generator=generator, device=gain.device, dtype=gain.dtype)
        return torch.exp(line["slope"] * gain.log() + line["bias"] + scatter - math.log(self.white_dn))

    def typical(self) -> tuple[float, float]:
        """(shot_var, read_var) without the scatter, at the middle of the limits in the logarithm."""
        gain = math.sqrt(self.iso[0] * self.iso[1]) * (self.camera["Kmin"] / self.lowest_iso)
        line = self.camera["gaussian"]
        read_sd = math.exp(line["slope"] * math.log(gain) + line["bias"]) / self.white_dn
        return gain / self.white_dn, read_sd**2

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        gain = self.sample_gain(batch, generator)
        return gain / self.white_dn, self.sample_scale("gaussian", gain, generator).square()
