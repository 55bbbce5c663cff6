r"""The noise law of a camera over ISO, measured on its own files.

.. math:: \log \mathrm{shot\_var},\ \log \mathrm{read\_var} \text{ are linear in } \log \mathrm{ISO}

between the ISO values that were measured, as in SIDD's tables (:mod:`rawaug.noise.iso`): a sensor's gain grows with the
ISO, in steps where it switches its amplifier, so that a table follows it better than one line. Outside the measured
range an ISO is refused. Files without an ISO give one level, which holds for every picture.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug.noise.iso import interpolated, iso_limits
from rawaug.noise.levels import log_uniform
from rawaug.noise.models import ShotReadNoise
from rawaug.registry import NOISE

_LEAST = 1e-12
"""Stands for a variance of 0, which is below what can be measured, in the logarithms."""


class IsoLevel(NamedTuple):
    """What was measured at one ISO.

    Args:
        iso: None if the files have none.
        shot_var, read_var: variances, white = 1.
        r2: of the line through the measured points; None if unknown.
        frames: how many were measured; None if unknown.
    """

    iso: float | None
    shot_var: float
    read_var: float
    r2: float | None = None
    frames: int | None = None


class MeasuredLevels:
    """The levels of one camera, at the measured ISO values and between them.

    Args:
        levels: one for each ISO, or a single one without.
        camera: make and model, for messages.

    Raises:
        ValueError: if there is no level, two have the same ISO, or one of several has none.

    Example:
        >>> law = MeasuredLevels([IsoLevel(100, 1e-4, 1e-7), IsoLevel(400, 4e-4, 1.6e-6)], "Maker Model")
        >>> [f"{level:.2g}" for level in law.at(200)]
        ['0.0002', '4e-07']
    """

    def __init__(self, levels: Sequence[IsoLevel], camera: str = "unknown") -> None:
        values = [level.iso for level in levels]
        if not values or len(set(values)) < len(values) or (None in values and len(values) > 1):
            raise ValueError(f"a noise law takes levels of different ISO values, or one without; got {values}")
        self.levels = sorted(levels, key=lambda level: level.iso or 0.0)
        self.camera = camera
        rows = [(iso or 1.0, max(shot, _LEAST), max(read, _LEAST)) for iso, shot, read, *_ in self.levels]
        self.table = torch.tensor(rows, dtype=torch.float64).log().T.contiguous()

    @property
    def limits(self) -> tuple[float, float] | None:
        """Lowest and highest ISO that was measured; None where the files have no ISO."""
        low, high = self.levels[0].iso, self.levels[-1].iso
        return None if low is None or high is None else (low, high)

    def at(self, iso: float | None) -> tuple[float, float]:
        """(shot_var, read_var) at an ISO; any ISO, or none, where only one level without was measured.

        Raises:
            ValueError: if the ISO is unknown or outside the measured range.
        """
        if self.limits is None or (iso is None and len(self.levels) == 1):
            return self.levels[0].shot_var, self.levels[0].read_var
        if iso is None:
            raise ValueError(f"the noise of {self.camera} depends on the ISO, which the file does not say")
        low, _ = iso_limits(self.camera, iso, self.limits)
        known = next((level for level in self.levels if level.iso == iso), None)
        if known is not None:
            return known.shot_var, known.read_var
        shot_var, read_var = interpolated(self.table, torch.tensor([low]))
        return float(shot_var), float(read_var)

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Levels at ISO values that are log-uniform over the measured range."""
        device = generator.device
        if self.limits is None or len(self.levels) == 1:
            shot_var, read_var = self.at(None)
            return torch.full((batch,), shot_var, device=device), torch.full((batch,), read_var, device=device)
        return interpolated(self.table.to(device), log_uniform(self.limits, batch, generator))

    def spec(self) -> dict[str, Any]:
        """The noise by name: what files of weights hold, and :func:`rawaug.noise.noise_model` reads."""
        rows = [{key: value for key, value in level._asdict().items() if value is not None} for level in self.levels]
        return {"name": "MeasuredNoise", "settings": {"camera": self.camera, "levels": rows}}


def camera_law(stored: Mapping[str, Any]) -> MeasuredLevels:
    """The law that the entry ``noise`` of an ISP's file holds.

    Raises:
        ValueError: if it is not such an entry.
    """
    if "shot_var" in stored:  # of version 0.1: one level, without its ISO
        return MeasuredLevels([IsoLevel(None, stored["shot_var"], stored["read_var"], stored.get("r2"))])
    if stored.get("name") != "MeasuredNoise":
        raise ValueError(f"expected the noise law of a camera, got {dict(stored)}; fit the ISP again")
    return MeasuredNoise(**stored["settings"]).law


@NOISE.register("MeasuredNoise")
class MeasuredNoise(ShotReadNoise):
    """Shot and read noise of a camera measured at several ISO values; each picture draws an ISO.

    Args:
        levels: for each ISO ``{iso, shot_var, read_var}``, besides ``r2`` and ``frames`` if known.
        camera: make and model.

    Raises:
        ValueError: see :class:`MeasuredLevels`; or if a level has an unknown key.
    """

    def __init__(self, levels: Sequence[Mapping[str, Any]], camera: str = "unknown") -> None:
        for row in levels:
            if not {"shot_var", "read_var"} <= row.keys() <= set(IsoLevel._fields):
                raise ValueError(f"MeasuredNoise: a level is {{iso, shot_var, read_var}}, got {dict(row)}")
        self.law = MeasuredLevels([IsoLevel(**{"iso": None, **row}) for row in levels], camera)
        super().__init__(self.law)
