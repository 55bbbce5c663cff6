r"""Noise levels: samplers of (shot_var, read_var) per picture.

A published preset draws shot_var log-uniformly and read_var around a line in the logarithms,

.. math:: \log \mathrm{read\_var} = a \log \mathrm{shot\_var} + b + N(0, \sigma^2)

(Brooks et al., "Unprocessing images for learned raw denoising", 2019). The logarithm is natural in some sources and
base 10 in others, with the same constants; each preset keeps its own. Variances are on the scale white = 1.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from importlib import resources
from typing import Any, Protocol

import torch
from torch import Tensor


class NoiseLevels(Protocol):
    """Anything that samples noise levels."""

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """(shot_var, read_var), each ``(batch,)`` float32 on the generator's device."""
        ...


@cache
def published() -> dict[str, Any]:
    """The package's ``presets.json``: published levels, each with its source."""
    data: dict[str, Any] = json.loads(resources.files("rawaug.noise").joinpath("presets.json").read_text("utf-8"))
    return data


def log_uniform(limits: tuple[float, float], batch: int, generator: torch.Generator) -> Tensor:
    """``(batch,)`` numbers whose logarithms are uniform between those of ``limits``."""
    low, high = (math.log(limit) for limit in limits)
    return torch.exp(
        low + (high - low) * torch.rand(batch, generator=generator, device=generator.device, dtype=torch.float32)
    )


def _normal(batch: int, generator: torch.Generator) -> Tensor:
    return torch.randn(batch, generator=generator, device=generator.device, dtype=torch.float32)


class FixedLevels:
    """The same levels for every picture: those of one camera at one ISO.

    Example:
        >>> shot_var, read_var = FixedLevels(1e-3, 1e-5).sample(2, torch.Generator())
    """

    def __init__(self, shot_var: float, read_var: float) -> None:
        if not (0 <= shot_var < math.inf and 0 <= read_var < math.inf):
            raise ValueError(
                f"noise variances must be finite and not negative, got shot_var={shot_var}, read_var={read_var}"
            )
        self.shot_var, self.read_var = float(shot_var), float(read_var)

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        shot_var, read_var = (
            torch.full((batch,), level, device=generator.device, dtype=torch.float32)
            for level in (self.shot_var, self.read_var)
        )
        return shot_var, read_var


class MixedLevels:
    """Levels of a random one of several laws, each picture's own; all weighted alike.

    Example:
        >>> shot_var, read_var = MixedLevels([FixedLevels(1e-3, 0.0), FixedLevels(2e-3, 0.0)]).sample(
        ...     8, torch.Generator().manual_seed(0)
        ... )
        >>> sorted(set(shot_var.tolist())) == torch.tensor([1e-3, 2e-3]).tolist()
        True
    """

    def __init__(self, laws: Sequence[NoiseLevels]) -> None:
        if not laws:
            raise ValueError("a mixture of noise levels needs at least one law")
        self.laws = laws

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        which = torch.randint(len(self.laws), (batch,), generator=generator, device=generator.device)
        drawn = torch.stack([torch.stack(law.sample(batch, generator)) for law in self.laws])
        shot_var, read_var = drawn[which, :, torch.arange(batch, device=which.device)].unbind(1)
        return shot_var, read_var


class Preset:
    """A published preset: ``upi``, ``cycleisp_dnd``, ``cycleisp_sidd`` or ``rawir``.

    Raises:
        ValueError: if the name is unknown.
    """

    def __init__(self, name: str) -> None:
        presets = published()["presets"]
        if name not in presets:
            raise ValueError(f"noise preset {name!r} is unknown; use one of {', '.join(presets)}")
        law = presets[name]
        self.name = name
        self.shot_range: tuple[float, float] = tuple(law["shot"])
        self.line: dict[str, float] = law["read_line"]
        self.base = {"natural": math.e, "base 10": 10.0}[law["log"]]

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        shot_var = log_uniform(self.shot_range, batch, generator)
        scatter = self.line["sigma"] * _normal(batch, generator)
        # The slope is the same in any base; intercept and scatter are exponents of the preset's own.
        exponent = (self.line["intercept"] + scatter) * math.log(self.base)
        return shot_var, shot_var ** self.line["slope"] * torch.exp(exponent)
