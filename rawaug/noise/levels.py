r"""Noise levels: samplers of (shot_var, read_var) for each picture, as variances on the scale white = 1.

A published preset draws shot_var log-uniformly and read_var around a line in the logarithms,

.. math:: \log \mathrm{read\_var} = a \log \mathrm{shot\_var} + b + N(0, \sigma^2)

(Brooks et al., 2019). The logarithms are natural in some sources and of base 10 in others; each preset keeps its own. A
measured camera has levels by ISO. With a gain of K digital numbers (DN) per electron, V DN from black to white and read
noise of :math:`\sigma` DN,

.. math:: \mathrm{shot\_var} = K / V, \qquad \mathrm{read\_var} = \sigma^2 / V^2 .

The published levels are five phones of SIDD (Abdelhamed et al. 2018; the numbers of Noise Flow, 2019), the line of
PMRID for one phone (Wang et al. 2020), and the log-linear laws of ELD for five cameras (Wei et al. 2020). An ISO
outside the measured range is refused; without an ISO the whole range is sampled log-uniformly.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from importlib import resources
from numbers import Real
from typing import Any, Protocol

import torch
from torch import Tensor


class NoiseLevels(Protocol):
    """A law of noise levels, from which every picture draws its own."""

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw (shot_var, read_var), each ``(batch,)`` float32 on the generator's device, white = 1."""
        ...


EFFECTS = {"row_var": 0.0, "column_var": 0.0, "tukey_lambda": 0.14, "hot_share": 0.0}
"""What a law may state beside shot_var and read_var, and its value in a camera that lacks it."""


def draw_levels(levels: NoiseLevels, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw ``shot_var``, ``read_var``, ``iso`` where the law depends on it, and its :data:`EFFECTS`, ``(batch,)``."""
    if hasattr(levels, "draw"):
        drawn: dict[str, Tensor] = levels.draw(batch, generator)
        return drawn
    shot_var, read_var = levels.sample(batch, generator)
    return {"shot_var": shot_var, "read_var": read_var}


@cache
def load_presets() -> dict[str, Any]:
    """Load the package's ``presets.json``: published levels, each with its source."""
    data: dict[str, Any] = json.loads(resources.files("rawaug.noise").joinpath("presets.json").read_text("utf-8"))
    return data


def _entry(what: str, name: str, table: dict[str, Any]) -> Any:
    if name not in table:
        raise ValueError(f"{what} {name!r} is unknown; use one of {', '.join(table)}")
    return table[name]


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Draw from [0, 1): float32 of ``shape`` on the generator's device."""
    return torch.rand(shape, generator=generator, device=generator.device, dtype=torch.float32)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    """Draw standard normals: float32 of ``shape`` on the generator's device."""
    return torch.randn(shape, generator=generator, device=generator.device, dtype=torch.float32)


def log_uniform(limits: tuple[float, float], batch: int, generator: torch.Generator) -> Tensor:
    """Draw ``(batch,)`` numbers whose logarithms are uniform between those of ``limits``."""
    low, high = math.log(limits[0]), math.log(limits[1])
    return torch.exp(low + (high - low) * uniform(generator, batch))


class FixedLevels:
    """The same levels for every picture, as for a camera at one ISO.

    Args:
        shot_var, read_var: variances, white = 1.
        further: ``iso``, if it is known, and :data:`EFFECTS` by name.

    Raises:
        ValueError: if a variance is negative or not finite.
    """

    def __init__(self, shot_var: float, read_var: float, **further: float) -> None:
        if not (0 <= shot_var < math.inf and 0 <= read_var < math.inf):
            raise ValueError(f"noise variances must be finite and not negative, got {shot_var} and {read_var}")
        self.shot_var, self.read_var = float(shot_var), float(read_var)
        self.further = further
        self.effects = frozenset(further) - {"iso"}

    @classmethod
    def of(cls, pair: Any) -> FixedLevels:
        """Make the levels from ``(shot_var, read_var)``; ValueError if it is not a pair of such numbers."""
        if not isinstance(pair, Sequence) or len(pair) != 2 or not all(isinstance(v, Real) for v in pair):
            raise ValueError(f"noise must be a name or a pair (shot_var, read_var) of variances, got {pair!r:.100}")
        return cls(*pair)

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Repeat both levels for each picture, ``(batch,)``."""
        levels = torch.tensor([self.shot_var, self.read_var], device=generator.device, dtype=torch.float32)
        return levels[0].repeat(batch), levels[1].repeat(batch)

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Repeat all that is known for each picture, as :func:`draw_levels` says."""
        shot_var, read_var = self.sample(batch, generator)
        drawn = {"shot_var": shot_var, "read_var": read_var}
        for name, value in self.further.items():
            drawn[name] = torch.full_like(shot_var, value)
        return drawn


class MixedLevels:
    """The levels of several laws; each picture draws one of the laws with equal probability."""

    def __init__(self, laws: Sequence[NoiseLevels]) -> None:
        if not laws:
            raise ValueError("a mixture of noise levels needs at least one law")
        self.laws = laws
        self.effects = frozenset().union(*[getattr(law, "effects", ()) for law in laws])

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw a law for each picture and its levels from that law, ``(batch,)``."""
        drawn = self.draw(batch, generator)
        return drawn["shot_var"], drawn["read_var"]

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw a law for each picture and what it knows, as :func:`draw_levels` says; the ISO if all laws know it."""
        which = torch.randint(len(self.laws), (batch,), generator=generator, device=generator.device)

        drawn = []
        for law in self.laws:
            drawn.append(draw_levels(law, batch, generator))
        names = ["shot_var", "read_var", *sorted(self.effects)]
        if all("iso" in levels for levels in drawn):
            names.append("iso")

        pictures = torch.arange(batch, device=which.device)
        mixed = {}
        for name in names:
            values = []
            for levels in drawn:
                values.append(levels.get(name, torch.full_like(levels["shot_var"], EFFECTS.get(name, 0.0))))
            mixed[name] = torch.stack(values)[which, pictures]
        return mixed


class Preset:
    """A published preset: ``upi``, ``cycleisp_dnd``, ``cycleisp_sidd`` or ``rawir``."""

    def __init__(self, name: str) -> None:
        law = _entry("noise preset", name, load_presets()["presets"])
        self.name = name
        self.shot_range: tuple[float, float] = tuple(law["shot"])
        self.line: dict[str, float] = law["read_line"]
        self.base = {"natural": math.e, "base 10": 10.0}[law["log"]]

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw shot_var log-uniformly and read_var around its line, ``(batch,)``."""
        shot_var = log_uniform(self.shot_range, batch, generator)
        scatter = self.line["sigma"] * normal(generator, batch)

        # The slope is the same in any base; intercept and scatter are exponents of the preset's own base.
        exponent = (self.line["intercept"] + scatter) * math.log(self.base)
        return shot_var, shot_var ** self.line["slope"] * torch.exp(exponent)


Iso = float | tuple[float, float] | None
"""One ISO, the limits of a log-uniform draw, or None for the whole measured range."""


def iso_limits(camera: str, iso: Iso, measured: tuple[float, float]) -> tuple[float, float]:
    """The limits of the draw that ``iso`` requests; ValueError if they are outside the measured range."""
    if iso is None:
        return measured

    if isinstance(iso, (int, float)):
        low = high = iso
    else:
        low, high = iso

    if not measured[0] <= low <= high <= measured[1]:
        raise ValueError(f"ISO {iso} is outside the measured range of {camera}, {measured[0]:g} to {measured[1]:g}")
    return float(low), float(high)


def interpolate_levels(table: Tensor, iso: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate (shot_var, read_var), each ``(B,)``, at ISO values ``(B,)``, linearly in the logarithms.

    ``table``, float64 ``(3, N)`` with N at least 2, holds the logarithms of ISO, ascending, shot_var and read_var.
    """
    x, log_shot, log_read = table
    at = iso.log().double()
    right = torch.bucketize(at, x).clamp(1, len(x) - 1)
    t = (at - x[right - 1]) / (x[right] - x[right - 1])

    shot_var = torch.lerp(log_shot[right - 1], log_shot[right], t).exp().float()
    read_var = torch.lerp(log_read[right - 1], log_read[right], t).exp().float()
    return shot_var, read_var


class PmridLevels:
    """The OPPO Reno 10x of PMRID, whose gain is linear and whose read variance is quadratic in the ISO, 100 to 6400."""

    def __init__(self, iso: Iso = None) -> None:
        self.law: dict[str, Any] = load_presets()["pmrid"]
        self.iso = iso_limits("pmrid", iso, tuple(self.law["iso"]))

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw an ISO for each picture, log-uniformly, and compute its levels, ``(batch,)``."""
        drawn = self.draw(batch, generator)
        return drawn["shot_var"], drawn["read_var"]

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``iso``, ``shot_var`` and ``read_var``, ``(batch,)``."""
        iso = log_uniform(self.iso, batch, generator)
        white = self.law["white_dn"]
        k1, k0 = self.law["K"]
        s2, s1, s0 = self.law["sigma2"]

        gain = k1 * iso + k0
        read_var_dn = (s2 * iso + s1) * iso + s0
        return {"iso": iso, "shot_var": gain / white, "read_var": read_var_dn / white**2}


class EldLevels:
    """One of ELD's cameras, where every scale s is log-linear in the gain: log s = slope log K + bias + N(0, sigma^2).

    Used as levels, they give the Gaussian law of read noise; :class:`rawaug.noise.EldNoise` is the full model.
    """

    def __init__(self, camera: str, iso: Iso = None) -> None:
        law = load_presets()["eld"]
        self.camera: dict[str, Any] = _entry("ELD camera", camera, law["cameras"])
        self.white_dn = float(law["white_dn"])
        self.lowest_iso = float(law["iso"][0])
        self.iso = iso_limits(camera, iso, tuple(law["iso"]))

    def sample_gain(self, batch: int, generator: torch.Generator) -> Tensor:
        """Draw the gain K in DN per electron, ``(batch,)``."""
        return log_uniform(self.iso, batch, generator) * (self.camera["Kmin"] / self.lowest_iso)

    def sample_scale(self, law: str, gain: Tensor, generator: torch.Generator) -> Tensor:
        """Draw the scale of ``row``, ``gaussian`` or ``tukey_lambda`` noise at gains ``(B,)``: ``(B,)``, white = 1."""
        line = self.camera[law]
        scatter = line["sigma"] * normal(generator, *gain.shape)
        return torch.exp(line["slope"] * gain.log() + line["bias"] + scatter - math.log(self.white_dn))

    def typical(self) -> tuple[float, float]:
        """Compute (shot_var, read_var) without the scatter, at the geometric mean of the limits."""
        gain = math.sqrt(self.iso[0] * self.iso[1]) * (self.camera["Kmin"] / self.lowest_iso)

        line = self.camera["gaussian"]
        read_sd = math.exp(line["slope"] * math.log(gain) + line["bias"]) / self.white_dn
        return gain / self.white_dn, read_sd**2

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw a gain for each picture, and its levels, ``(batch,)``."""
        drawn = self.draw(batch, generator)
        return drawn["shot_var"], drawn["read_var"]

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``iso``, ``shot_var`` and ``read_var``, ``(batch,)``."""
        gain = self.sample_gain(batch, generator)
        read_var = self.sample_scale("gaussian", gain, generator).square()
        return {"iso": self.iso_at_gain(gain), "shot_var": gain / self.white_dn, "read_var": read_var}

    def iso_at_gain(self, gain: Tensor) -> Tensor:
        """Compute the ISO of gains in DN per electron."""
        return gain * (self.lowest_iso / self.camera["Kmin"])
