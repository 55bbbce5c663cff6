"""The noise of measured cameras by ISO, from their own files or from their data sheets.

Between the ISO values of a camera's levels, the logarithms of both variances are linear in the logarithm of the ISO. An
ISO outside the measured range is refused. Files without an ISO give one level for every picture.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug.noise.effects import ColumnNoise, DefectPixels, RowNoise, TukeyLambdaNoise
from rawaug.noise.levels import (
    EFFECTS,
    FixedLevels,
    Iso,
    MixedLevels,
    NoiseLevels,
    draw_levels,
    interpolate_levels,
    iso_limits,
    load_presets,
    log_uniform,
)
from rawaug.noise.models import NOISE, NoiseModel, Params, ShotReadNoise, draw_seeds, move_params, per_picture

_LEAST = 1e-12
"""Replaces a variance of 0 in logarithms."""


class IsoLevel(NamedTuple):
    """The noise levels that were measured at one ISO.

    Args:
        iso: the ISO; None if the files have none.
        shot_var, read_var: variances, white = 1.
        r2: R^2 of the line through the measured points; None if unknown.
        frames: number of frames that were measured; None if unknown.
        row_var, column_var, tukey_lambda, hot_share: as in :class:`rawaug.noise.SensorNoise`; None for none.
    """

    iso: float | None
    shot_var: float
    read_var: float
    r2: float | None = None
    frames: int | None = None
    row_var: float | None = None
    column_var: float | None = None
    tukey_lambda: float | None = None
    hot_share: float | None = None

    @property
    def effects(self) -> dict[str, float]:
        """What the level states beside shot_var and read_var."""
        stated = {}
        for name in EFFECTS:
            value = getattr(self, name)
            if value is not None:
                stated[name] = value
        return stated


class MeasuredLevels:
    """The levels of one camera, at the measured ISO values and between them.

    Args:
        levels: one for each ISO, or a single one without an ISO.
        camera: make and model, for messages.
        iso: one ISO, the limits of a log-uniform draw, or None for the whole measured range.

    Raises:
        ValueError: if there is no level, two have the same ISO, one of several has no ISO, or ``iso`` was not measured.

    Example:
        >>> law = MeasuredLevels([IsoLevel(100, 1e-4, 1e-7), IsoLevel(400, 4e-4, 1.6e-6)], "Maker Model")
        >>> [f"{level:.2g}" for level in law.at(200)]
        ['0.0002', '4e-07']
    """

    def __init__(self, levels: Sequence[IsoLevel], camera: str = "unknown", iso: Iso = None) -> None:
        values = [level.iso for level in levels]
        if not values or len(set(values)) < len(values) or (None in values and len(values) > 1):
            raise ValueError(f"a noise law takes levels of different ISO values, or one without; got {values}")
        self.levels = sorted(levels, key=lambda level: level.iso or 0.0)
        self.camera = camera

        self.effects = frozenset(self.levels[0].effects)
        for level in self.levels:
            if set(level.effects) != self.effects:
                names = ", ".join(sorted(self.effects ^ set(level.effects)))
                raise ValueError(f"a noise law states {names} at some ISO values and not at others; state it at all")

        rows = []
        for level in self.levels:
            rows.append((level.iso or 1.0, max(level.shot_var, _LEAST), max(level.read_var, _LEAST)))
        self.table = torch.tensor(rows, dtype=torch.float64).log().T.contiguous()

        self.iso: tuple[float, float] | None = None
        if self.limits is not None:
            self.iso = iso_limits(camera, iso, self.limits)
        elif iso is not None:
            raise ValueError(f"the noise of {camera} was measured at no ISO; omit iso")

    @property
    def limits(self) -> tuple[float, float] | None:
        """The lowest and the highest measured ISO; None if the files have no ISO."""
        low, high = self.levels[0].iso, self.levels[-1].iso
        if low is None or high is None:
            return None
        return low, high

    def at(self, iso: float | None) -> tuple[float, float]:
        """Give (shot_var, read_var) at an ISO, or the one measured level for None; ValueError outside the range."""
        if self.limits is None or (iso is None and len(self.levels) == 1):
            return self.levels[0].shot_var, self.levels[0].read_var
        if iso is None:
            raise ValueError(f"the noise of {self.camera} depends on the ISO, which the file does not say")

        low, _ = iso_limits(self.camera, iso, self.limits)
        for level in self.levels:
            if level.iso == iso:
                return level.shot_var, level.read_var

        shot_var, read_var = interpolate_levels(self.table, torch.tensor([low]))
        return float(shot_var), float(read_var)

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw an ISO for each picture, log-uniformly over the range, and its levels, ``(batch,)``."""
        drawn = self.draw(batch, generator)
        return drawn["shot_var"], drawn["read_var"]

    def draw(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``iso``, ``shot_var``, ``read_var`` and the camera's effects, ``(batch,)``."""
        if self.iso is None or len(self.levels) == 1:
            return self._fixed(self.levels[0].iso).draw(batch, generator)

        iso = log_uniform(self.iso, batch, generator)
        shot_var, read_var = interpolate_levels(self.table.to(generator.device), iso)
        drawn = {"iso": iso, "shot_var": shot_var, "read_var": read_var}
        for name in sorted(self.effects):
            drawn[name] = torch.from_numpy(self._interpolate(name, iso.cpu().numpy())).to(iso)
        return drawn

    def _interpolate(self, effect: str, iso: Any) -> np.ndarray[Any, Any]:
        """Interpolate what the levels state of an effect, in logarithms but for the shape of tails."""
        log_iso, values = [], []
        for level in self.levels:
            log_iso.append(math.log(level.iso or 1.0))
            values.append(level.effects[effect])
        if effect == "tukey_lambda":
            return np.interp(np.log(iso), log_iso, values)
        return np.exp(np.interp(np.log(iso), log_iso, np.log(np.maximum(values, _LEAST))))

    def _fixed(self, iso: float | None) -> FixedLevels:
        """The levels at an ISO, with all else that is known there."""
        further = {}
        for name in sorted(self.effects):
            further[name] = float(self._interpolate(name, iso or self.levels[0].iso or 1.0))
        if iso is not None:
            further["iso"] = iso
        return FixedLevels(*self.at(iso), **further)

    def within(self, iso: float | tuple[float, float]) -> NoiseLevels:
        """Restrict the law to one ISO, or to the range between two; ValueError outside the measured range.

        Example:
            >>> law = MeasuredLevels([IsoLevel(100, 1e-4, 1e-7), IsoLevel(400, 4e-4, 1.6e-6)], "Maker Model")
            >>> shot_var, _ = law.within((100, 200)).sample(1000, torch.Generator().manual_seed(0))
            >>> bool(shot_var.max() < 2.001e-4)
            True
        """
        law = MeasuredLevels(self.levels, self.camera, iso)
        if law.iso is not None and law.iso[0] == law.iso[1]:
            return self._fixed(law.iso[0])
        return law

    def spec(self) -> dict[str, Any]:
        """Write the law as a name with settings, the form that weight files store and :func:`noise_model` reads."""
        rows = []
        for level in self.levels:
            rows.append({key: value for key, value in level._asdict().items() if value is not None})
        return {"name": "MeasuredNoise", "settings": {"camera": self.camera, "levels": rows}}


def sidd_levels(phone: str, iso: Iso = None) -> MeasuredLevels:
    """The levels of one of SIDD's phones at the tabulated ISO values and between them.

    Args:
        phone: ``iPhone 7``, ``Google Pixel``, ``Samsung Galaxy S6 Edge``, ``Motorola Nexus 6`` or ``LG G4``.
        iso: one ISO, the limits of a log-uniform draw, or None for the whole tabulated range.

    Raises:
        ValueError: if there is no such phone, or the ISO is outside the tabulated range.
    """
    phones = load_presets()["sidd_noise_level_function"]["cameras"]
    if phone not in phones:
        raise ValueError(f"SIDD phone {phone!r} is unknown; use one of {', '.join(phones)}")

    levels = []
    for value, (shot_var, read_var) in phones[phone].items():
        levels.append(IsoLevel(float(value), shot_var, read_var))
    return MeasuredLevels(levels, phone, iso)


class RoundedNoise(ShotReadNoise):
    """Shot and read noise of RAW that is rounded to digital numbers, and the other effects that the levels state.

    Args:
        levels: levels whose ``read_var`` contains the rounding, as it does if it is measured on RAW files. Row and
            column noise, heavy tails and hot pixels are added where they state :data:`rawaug.noise.levels.EFFECTS`.
        quantum: step of the digital numbers, white = 1; None rounds nothing.
        lowest: what 0 DN is on this scale, at most 0; files hold nothing below. None clips nothing.

    Raises:
        ValueError: if the step is not in (0, 1).
    """

    def __init__(self, levels: NoiseLevels, quantum: float | None = None, lowest: float | None = None) -> None:
        if quantum is not None and not 0.0 < quantum < 1.0:
            raise ValueError(f"quantum must be between 0 and 1, got {quantum}")
        if lowest is not None and not lowest <= 0.0:
            raise ValueError(f"lowest must be at most 0, got {lowest}")
        self.quantum, self.lowest = quantum, lowest
        super().__init__(levels)

        stated: frozenset[str] = getattr(levels, "effects", frozenset())
        self.tails = TukeyLambdaNoise(levels, EFFECTS["tukey_lambda"]) if "tukey_lambda" in stated else None
        self.effects: list[NoiseModel] = []
        for name, effect in (
            ("row_var", RowNoise(0.0)),
            ("column_var", ColumnNoise(0.0)),
            ("hot_share", DefectPixels()),
        ):
            if name in stated:
                self.effects.append(effect)

    def move(self, params: Params, device: torch.device) -> Params:
        """Move all but the seeds, unless an effect reads them on the host."""
        if self.tails is not None or self.effects:
            return params
        return move_params(params, device)

    @property
    def is_plain(self) -> bool:
        """Whether nothing is rounded, and no effect but shot and read noise is stated."""
        return self.quantum is None and self.lowest is None and self.tails is None and not self.effects

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw ``shot_var``, ``read_var`` (without the rounding), ``seed``, and ``quantum``, ``lowest`` of whole DN.

        The effects of the levels are drawn with them, at the same ISO.
        """
        params = draw_levels(self.levels, batch, generator) | {"seed": draw_seeds(batch, generator)}
        if "hot_share" in params:
            params["dead_share"] = torch.zeros_like(params["hot_share"])
        if self.quantum is not None:
            quantum = torch.full_like(params["read_var"], self.quantum)
            params["read_var"] = (params["read_var"] - quantum.square() / 12).clamp_min(0.0)
            params["quantum"] = quantum
        if self.lowest is not None:
            params["lowest"] = torch.full_like(params["read_var"], self.lowest)
        return params

    def apply(self, clean: Tensor, params: Params) -> Tensor:
        """Make noisy RAW ``(B, 4, h, w)``, rounded if the camera rounds; see :meth:`NoiseModel.apply`."""
        if self.tails is not None or self.effects:
            return NoiseModel.apply(self, clean, params)
        noisy = super().apply(clean, params)
        return _round_to_quantum(noisy, params)

    def apply_with_variance(self, clean: Tensor, params: Params) -> tuple[Tensor, Tensor]:
        """Make noisy RAW and its variance map, both ``(B, 4, h, w)``."""
        if "quantum" not in params and self.tails is None and not self.effects:
            return super().apply_with_variance(clean, params)
        noisy = self.apply(clean, params)
        return noisy, self.variance(noisy, params)

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the noise to ``clean`` ``(B, 4, h, w)`` without the clip at white."""
        if self.tails is None:
            noisy = super().disturb(clean, params, out)
        else:
            noisy = self.tails.disturb(clean, params, out)
        for effect in self.effects:
            effect.disturb(noisy, params, out=noisy)
        return _round_to_quantum(noisy, params)

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Compute ``shot_var max(clean, 0) + read_var``, ``(B, 4, h, w)``, with rounding and the variance of lines."""
        variance = super().variance(clean, params)
        for effect in self.effects:
            variance += effect.variance(clean, params)
        if "quantum" in params:
            variance += per_picture(params["quantum"].square() / 12, clean)
        return variance


def _round_to_quantum(noisy: Tensor, params: Params) -> Tensor:
    """Round RAW ``(B, 4, h, w)`` in place to multiples of the drawn steps, from 0 DN on, if there are any."""
    if "quantum" in params:
        quantum = per_picture(params["quantum"], noisy)
        noisy = noisy.div_(quantum).round_().mul_(quantum)
    if "lowest" in params:
        torch.maximum(noisy, per_picture(params["lowest"], noisy), out=noisy)
    return noisy


@NOISE.register("MeasuredNoise")
class MeasuredNoise(RoundedNoise):
    """Shot and read noise of a camera that was measured at several ISO values; each picture draws an ISO.

    Args:
        levels: ``{iso, shot_var, read_var}`` for each ISO, and ``r2`` and ``frames`` if known.
        camera: make and model.
        quantum, lowest: as for :class:`RoundedNoise`.
        iso: one ISO, or (lowest, highest), from which the levels are drawn; by default the whole measured range.

    Raises:
        ValueError: if a level is incomplete, the step is not in (0, 1), or the ISO was not measured.
    """

    def __init__(
        self,
        levels: Sequence[Mapping[str, Any]],
        camera: str = "unknown",
        quantum: float | None = None,
        iso: Iso = None,
        lowest: float | None = None,
    ) -> None:
        rows = []
        for row in levels:
            if not {"shot_var", "read_var"} <= row.keys() <= set(IsoLevel._fields):
                raise ValueError(f"MeasuredNoise: a level is {{iso, shot_var, read_var}}, got {dict(row)}")
            rows.append(IsoLevel(**{"iso": None, **row}))

        self.law = MeasuredLevels(rows, camera)
        drawn_from: NoiseLevels = self.law
        if iso is not None:
            drawn_from = self.law.within(iso)
        super().__init__(drawn_from, quantum, lowest)


def camera_law(stored: Mapping[str, Any]) -> MeasuredLevels:
    """Read the law in the entry ``noise`` of an ISP's file; ValueError if it is not a camera's law."""
    if stored.get("name") != "MeasuredNoise":
        raise ValueError(f"expected the noise law of a camera, got {dict(stored)}; fit the ISP again")
    return MeasuredNoise(**stored["settings"]).law


def measured_noise(specs: Sequence[Mapping[str, Any]], iso: Iso = None) -> RoundedNoise:
    """Make the noise of one or several cameras, of which each picture draws one.

    Args:
        specs: laws as an ISP's file stores them.
        iso: one ISO, limits, or None for the whole measured range.

    Raises:
        ValueError: if a law is not a camera's, or the cameras round to different digital numbers.
    """
    laws: list[NoiseLevels] = []
    grids = set()
    for spec in specs:
        law = camera_law(spec)
        laws.append(law if iso is None else law.within(iso))
        settings = spec.get("settings", {})
        grids.add((settings.get("quantum"), settings.get("lowest")))

    if len(grids) > 1:
        raise ValueError("the cameras round to different digital numbers; give the noise of one, or leave out bits")
    if len(laws) == 1:
        return RoundedNoise(laws[0], *grids.pop())
    return RoundedNoise(MixedLevels(laws), *grids.pop())
