r"""Noise by name: the published presets and the measured cameras.

===================================================================  ===========================  ============
names                                                                what                         ``iso=``
===================================================================  ===========================  ============
``upi`` ``cycleisp_dnd`` ``cycleisp_sidd`` ``rawir``                 published training presets   no
``iPhone 7`` ``Google Pixel`` ``Samsung Galaxy S6 Edge``
``Motorola Nexus 6`` ``LG G4``                                       SIDD's phones                as tabulated
``pmrid``                                                            OPPO Reno 10x                100 to 6400
``CanonEOS5D4`` ``CanonEOS700D`` ``CanonEOS70D`` ``NikonD850``
``SonyA7S2``                                                         ELD's cameras                100 to 6400
``Nikon D750`` ``Sony ILCE-7M3`` and 367 more                        darktable's profiles         as measured
``any camera``                                                       all profiles, each alike     as measured
===================================================================  ===========================  ============

Anything in :data:`rawaug.noise.models.NOISE` goes by its name as well. ``{"name": ..., "settings": {...}}`` gives
settings: ``iso`` and ``poisson`` for a name of the table, the keyword arguments of its class for a model.
CalibratedNoise needs no name: ``{"pair_psnr": 41.18}``.

*Profiles.* darktable has var = a y + b for 374 cameras by ISO. Its red and blue figures contain a white balance, so the
green ones serve all channels. It measures after demosaicing, where noise has been averaged: for four cameras that ELD
measured on the mosaic its profiles are too low, by 7.2 to 11.4 in shot variance and 2.2 to 16 in read variance
(:data:`SPREAD`). All are multiplied by the geometric means, :data:`SHOT_ON_MOSAIC` and :data:`READ_ON_MOSAIC`; the
median shot_var at ISO 100 is then 2.8e-5, a full well of 36,000 electrons. A fifth camera bears the first factor out:
frames of a Nikon D5000 at ISO 200 measure 2.6 to 3.2e-5, and its profile gives 3.09e-5. ``any camera`` draws the
factors, log-uniformly over the spread and each on its own. Rows whose green variance is not positive are left out.

*Measured cameras.* Between the ISO values of a fitted camera's files, the logarithms of both variances are linear in
that of the ISO. Outside the measured range an ISO is refused. Files without an ISO give one level for every picture.

*Stated PSNR.* A picture of mean signal m has noise of mean square ``shot_var m + read_var`` before the clip at white,
and a factor s on both variances shifts the PSNR of every pair by ``-10 log10(s)``. So a mean PSNR of P takes the factor

    s = 10^((P_0 - P) / 10),        P_0 = mean(-10 log10(shot_var m + read_var))

over draws of the law and the pictures' m. Conde et al., AAAI 2022, state P = 41.18 dB for their training pairs.
"""

from __future__ import annotations

import math
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cache, partial
from importlib import resources
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rawaug.isp.camera_names import camera_key, find_camera
from rawaug.noise.levels import (
    EldLevels,
    FixedLevels,
    Iso,
    MixedLevels,
    NoiseLevels,
    PmridLevels,
    Preset,
    SiddLevels,
    interpolate_levels,
    iso_limits,
    load_presets,
    log_uniform,
)
from rawaug.noise.models import (
    NOISE,
    NoiseModel,
    Params,
    PoissonGaussianNoise,
    ShotReadModel,
    ShotReadNoise,
    per_picture,
)
from rawaug.registry import Spec, check_settings, split_spec, suggest
from rawaug.seeding import keyed_generator

ANY_CAMERA = "any camera"
SHOT_ON_MOSAIC = 8.6
READ_ON_MOSAIC = 6.2
SPREAD = ((7.2 / SHOT_ON_MOSAIC, 11.4 / SHOT_ON_MOSAIC), (2.2 / READ_ON_MOSAIC, 16.0 / READ_ON_MOSAIC))
"""Limits of a camera's shot_var and read_var, relative to those of its profile."""
_ROUNDING = 1e-9  # of logarithms that are the same ISO
_LEAST = 1e-12  # stands for a variance of 0 in the logarithms


class Profiles(NamedTuple):
    """The usable rows of darktable's N cameras: logarithms of ISO, shot_var and read_var in ``table`` ``(3, N, R)``.

    A camera has ``rows`` ``(N,)`` of the R, ISO ascending, and infinite in the others.
    """

    names: tuple[str, ...]
    table: Tensor
    rows: Tensor

    def limits(self) -> Tensor:
        """The logarithms of the lowest and highest ISO of each camera, ``(N, 2)``."""
        iso = self.table[0]
        return torch.stack([iso[:, 0], iso.gather(1, self.rows[:, None] - 1)[:, 0]], dim=1)


@cache
def load_profiles() -> Profiles:
    """Load the package's ``profiles.tsv``; where a camera has an ISO twice, the geometric mean counts."""
    cameras: dict[str, dict[float, list[list[float]]]] = defaultdict(lambda: defaultdict(list))
    text = resources.files("rawaug.noise").joinpath("profiles.tsv").read_text("utf-8")
    for line in text.splitlines()[2:]:
        maker, model, iso, *variances = line.split("\t")
        levels = float(variances[1]) * SHOT_ON_MOSAIC, float(variances[4]) * READ_ON_MOSAIC
        if min(levels) > 0:
            cameras[f"{maker} {model}"][math.log(float(iso))].append([math.log(level) for level in levels])
    tables = []
    for rows in cameras.values():
        means = [torch.tensor(found, dtype=torch.float64).mean(dim=0) for _, found in sorted(rows.items())]
        isos = torch.tensor(sorted(rows), dtype=torch.float64)
        tables.append(torch.cat([isos[:, None], torch.stack(means)], dim=1))
    length = torch.tensor([len(rows) for rows in tables])
    table = pad_sequence(tables, batch_first=True).permute(2, 0, 1).contiguous()
    table[0, torch.arange(table.shape[2]) >= length[:, None]] = math.inf
    return Profiles(tuple(cameras), table, length)


class ProfileLevels:
    """The levels of one camera's profile, or of all profiles alike.

    Each picture draws an ISO, log-uniformly within the limits that its camera's profile has. The levels of any camera
    are drawn within :data:`SPREAD` as well; those of one camera are the middle of it.

    Args:
        camera: maker and model, or ``any camera``.
        iso: one ISO, the limits of the draw, or None for all that was measured.

    Raises:
        ValueError: if the camera has no profile, or none reaches the ISO.
    """

    def __init__(self, camera: str = ANY_CAMERA, iso: Iso = None) -> None:
        profiles = load_profiles()
        names = profiles.names
        if camera.casefold() != ANY_CAMERA:
            names = (find_camera(camera, names),)
        chosen = torch.tensor([profiles.names.index(name) for name in names])
        limits = profiles.limits()[chosen]
        measured = (round(math.exp(limits.min())), round(math.exp(limits.max())))
        asked = iso_limits(names[0] if len(names) == 1 else ANY_CAMERA, iso, measured)
        low, high = torch.tensor(asked, dtype=torch.float64).log()
        limits = torch.stack([limits[:, 0].clamp_min(low), limits[:, 1].clamp_max(high)], dim=1)
        within = limits[:, 0] <= limits[:, 1] + _ROUNDING
        if not within.any():
            raise ValueError(f"no camera has a profile within ISO {iso}; widen the range")
        self.cameras, self.limits = chosen[within], limits[within]
        self.spread = camera.casefold() == ANY_CAMERA

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw a camera and an ISO for each picture, and interpolate its levels, ``(batch,)``."""
        device = generator.device
        drawn = torch.randint(len(self.cameras), (batch,), generator=generator, device=device)
        low, high = self.limits.to(device)[drawn].unbind(1)
        at = low + (high - low) * torch.rand(batch, generator=generator, device=device, dtype=torch.float64)
        iso, shot, read = load_profiles().table.to(device)[:, self.cameras.to(device)[drawn]]
        right = torch.searchsorted(iso, at[:, None]).clamp(1, iso.shape[1] - 1)
        (x0, x1), (s0, s1), (r0, r1) = ((y.gather(1, right - 1), y.gather(1, right)) for y in (iso, shot, read))
        t = ((at[:, None] - x0) / (x1 - x0)).clamp(0.0, 1.0)
        levels = [torch.exp(torch.lerp(y0, y1, t))[:, 0].float() for y0, y1 in ((s0, s1), (r0, r1))]
        if self.spread:
            levels = [y * log_uniform(ends, batch, generator) for y, ends in zip(levels, SPREAD, strict=True)]
        return levels[0], levels[1]


class LevelEnds(NamedTuple):
    """The least and the greatest levels that one camera is likely to have at an ISO, white = 1."""

    iso: float
    shot_var: tuple[float, float]
    read_var: tuple[float, float]


def profile_ends(camera: str) -> list[LevelEnds]:
    """Say how far the levels of a camera's profile are known, at its lowest ISO and at each doubling of it.

    Raises:
        ValueError: if the camera has no profile.

    Example:
        >>> iso, shot_var, _ = profile_ends("Sony ILCE-7M3")[0]
        >>> f"ISO {iso:g}: {shot_var[0]:.1e} to {shot_var[1]:.1e}"
        'ISO 100: 1.0e-05 to 1.6e-05'
    """
    low, high = map(round, ProfileLevels(camera).limits[0].exp().tolist())
    found = []
    for step in range(int(math.log2(high / low)) + 1):
        iso = float(low * 2**step)
        middle = ProfileLevels(camera, iso).sample(1, torch.Generator())
        shot, read = ((float(level) * a, float(level) * b) for level, (a, b) in zip(middle, SPREAD, strict=True))
        found.append(LevelEnds(iso, shot, read))
    return found


class IsoLevel(NamedTuple):
    """The noise levels that were measured at one ISO.

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
        """The lowest and the highest ISO that was measured; None where the files have no ISO."""
        low, high = self.levels[0].iso, self.levels[-1].iso
        return None if low is None or high is None else (low, high)

    def at(self, iso: float | None) -> tuple[float, float]:
        """Give (shot_var, read_var) at an ISO, or the one measured level for None; ValueError outside the range."""
        if self.limits is None or (iso is None and len(self.levels) == 1):
            return self.levels[0].shot_var, self.levels[0].read_var
        if iso is None:
            raise ValueError(f"the noise of {self.camera} depends on the ISO, which the file does not say")
        low, _ = iso_limits(self.camera, iso, self.limits)
        known = next((level for level in self.levels if level.iso == iso), None)
        if known is not None:
            return known.shot_var, known.read_var
        shot_var, read_var = interpolate_levels(self.table, torch.tensor([low]))
        return float(shot_var), float(read_var)

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw an ISO for each picture, log-uniformly over the measured range, and its levels, ``(batch,)``."""
        device = generator.device
        if self.limits is None or len(self.levels) == 1:
            return FixedLevels(*self.at(None)).sample(batch, generator)
        return interpolate_levels(self.table.to(device), log_uniform(self.limits, batch, generator))

    def within(self, iso: float | tuple[float, float]) -> NoiseLevels:
        """The law at one ISO, or between two; ValueError outside the measured range.

        Example:
            >>> law = MeasuredLevels([IsoLevel(100, 1e-4, 1e-7), IsoLevel(400, 4e-4, 1.6e-6)], "Maker Model")
            >>> shot_var, _ = law.within((100, 200)).sample(1000, torch.Generator().manual_seed(0))
            >>> bool(shot_var.max() < 2.001e-4)
            True
        """
        if self.limits is None:
            raise ValueError(f"the noise of {self.camera} was measured at no ISO; omit iso")
        low, high = iso_limits(self.camera, iso, self.limits)
        if low == high:
            return FixedLevels(*self.at(low))
        ends = [IsoLevel(end, *self.at(end)) for end in (low, high)]
        between = [level for level in self.levels if level.iso is not None and low < level.iso < high]
        return MeasuredLevels([ends[0], *between, ends[1]], self.camera)

    def spec(self) -> dict[str, Any]:
        """Write the law as a name with settings, which files of weights hold and :func:`noise_model` reads."""
        rows = [{key: value for key, value in level._asdict().items() if value is not None} for level in self.levels]
        return {"name": "MeasuredNoise", "settings": {"camera": self.camera, "levels": rows}}


def camera_law(stored: Mapping[str, Any]) -> MeasuredLevels:
    """Read the law in the entry ``noise`` of an ISP's file; ValueError if it is no law of a camera."""
    if "shot_var" in stored:  # a single level, as in the shipped canon-powershot
        return MeasuredLevels([IsoLevel(None, stored["shot_var"], stored["read_var"], stored.get("r2"))])
    if stored.get("name") != "MeasuredNoise":
        raise ValueError(f"expected the noise law of a camera, got {dict(stored)}; fit the ISP again")
    return MeasuredNoise(**stored["settings"]).law


class RoundedNoise(ShotReadNoise):
    """Shot and read noise of RAW that is rounded to digital numbers.

    Args:
        levels: whose ``read_var`` contains the rounding, as it does where it is measured on RAW files.
        quantum: step of the digital numbers, white = 1; None rounds nothing.

    Raises:
        ValueError: if the step is not in (0, 1).
    """

    def __init__(self, levels: NoiseLevels, quantum: float | None = None) -> None:
        if quantum is not None and not 0.0 < quantum < 1.0:
            raise ValueError(f"quantum must be between 0 and 1, got {quantum}")
        self.quantum = quantum
        super().__init__(levels)

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw ``shot_var``, ``read_var`` (without the rounding), ``seed`` and, where RAW is rounded, ``quantum``."""
        params = super().sample(batch, generator)
        if self.quantum is not None:
            quantum = torch.full_like(params["read_var"], self.quantum)
            params["read_var"] = (params["read_var"] - quantum.square() / 12).clamp_min(0.0)
            params["quantum"] = quantum
        return params

    def apply(self, clean: Tensor, params: Params) -> Tensor:
        """Make noisy RAW ``(B, 4, h, w)``, rounded where the camera rounds; see :meth:`NoiseModel.apply`."""
        noisy = super().apply(clean, params)
        return _round_to(noisy, params) if "quantum" in params else noisy

    def apply_with_variance(self, clean: Tensor, params: Params) -> tuple[Tensor, Tensor]:
        """Make noisy RAW and its variance map, both ``(B, 4, h, w)``."""
        if "quantum" not in params:
            return super().apply_with_variance(clean, params)
        noisy = self.apply(clean, params)
        return noisy, self.variance(noisy, params)

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the noise to ``clean`` ``(B, 4, h, w)`` without the clip at white."""
        noisy = super().disturb(clean, params, out)
        return _round_to(noisy, params) if "quantum" in params else noisy

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Compute ``shot_var max(clean, 0) + read_var``, ``(B, 4, h, w)``, where ``read_var`` contains the rounding."""
        variance = super().variance(clean, params)
        if "quantum" in params:
            variance += per_picture(params["quantum"].square() / 12, clean)
        return variance


@NOISE.register("MeasuredNoise")
class MeasuredNoise(RoundedNoise):
    """Shot and read noise of a camera measured at several ISO values; each picture draws an ISO.

    Args:
        levels: for each ISO ``{iso, shot_var, read_var}``, besides ``r2`` and ``frames`` if known.
        camera: make and model.
        quantum: as for :class:`RoundedNoise`.
        iso: one ISO, or (lowest, highest), from which the levels are drawn; by default all that was measured.

    Raises:
        ValueError: if a level is incomplete, the step is not in (0, 1), or the ISO was not measured.
    """

    def __init__(
        self,
        levels: Sequence[Mapping[str, Any]],
        camera: str = "unknown",
        quantum: float | None = None,
        iso: Iso = None,
    ) -> None:
        rows = []
        for row in levels:
            if not {"shot_var", "read_var"} <= row.keys() <= set(IsoLevel._fields):
                raise ValueError(f"MeasuredNoise: a level is {{iso, shot_var, read_var}}, got {dict(row)}")
            rows.append(IsoLevel(**{"iso": None, **row}))

        self.law = MeasuredLevels(rows, camera)
        super().__init__(self.law if iso is None else self.law.within(iso), quantum)


def measured_noise(specs: Sequence[Mapping[str, Any]], iso: Iso = None) -> RoundedNoise:
    """The noise of one or several cameras, of which each picture draws one.

    Args:
        specs: laws as an ISP's file holds them.
        iso: one ISO, limits, or None for what was measured.

    Raises:
        ValueError: if a law is none of a camera, or the cameras round to different digital numbers.
    """
    laws: list[NoiseLevels] = []
    quanta = set()
    for spec in specs:
        law = camera_law(spec)
        laws.append(law if iso is None else law.within(iso))
        quanta.add(spec["settings"].get("quantum") if "settings" in spec else None)
    if len(quanta) > 1:
        raise ValueError("the cameras round to different digital numbers; give the noise of one, or leave out bits")
    return RoundedNoise(laws[0] if len(laws) == 1 else MixedLevels(laws), quanta.pop())


def _round_to(noisy: Tensor, params: Params) -> Tensor:
    """Round RAW ``(B, 4, h, w)`` in place to multiples of the drawn steps."""
    quantum = per_picture(params["quantum"], noisy)
    return noisy.div_(quantum).round_().mul_(quantum)


NoiseSpec = Spec | Sequence[float] | Sequence[str]
"""A name with or without settings, (shot_var, read_var), or several names of which each picture draws one."""


@cache
def _by_iso() -> dict[str, Callable[[Iso], SiddLevels | PmridLevels | EldLevels]]:
    data = load_presets()
    sidd = {name: partial(SiddLevels, name) for name in data["sidd_noise_level_function"]["cameras"]}
    return {**sidd, "pmrid": PmridLevels, **{name: partial(EldLevels, name) for name in data["eld"]["cameras"]}}


def camera_names() -> list[str]:
    """List the cameras that were measured one by one."""
    return list(_by_iso())


def measured_ranges() -> dict[str, tuple[float, float]]:
    """Give the lowest and highest ISO of each camera that was measured one by one."""
    return {name: levels(None).iso for name, levels in _by_iso().items()}


def noise_names() -> list[str]:
    """List every name that :func:`noise_model` knows."""
    return [*NOISE, *load_presets()["presets"], *camera_names(), ANY_CAMERA, *load_profiles().names]


def noise_levels(spec: NoiseSpec | NoiseLevels | NoiseModel, *, iso: Iso = None) -> NoiseLevels:
    """Make the levels of a name, of a mixture of names, or fixed ones of (shot_var, read_var).

    Args:
        spec: a preset or camera, several of which each picture draws one, or two variances, white = 1; or a law of your
            own, such as :class:`MeasuredLevels`, a model with one, or ``{name: MeasuredNoise, settings: ...}``.
        iso: of a camera: one ISO, limits, or None for its whole measured range.

    Raises:
        ValueError: if the name is unknown, has no law by ISO, or the ISO is outside the measured range.
    """
    own = _own_law(spec)
    if own is not None:
        return _levels_at(own, iso)
    if isinstance(spec, str) and spec in _by_iso():
        return _by_iso()[spec](iso)
    if isinstance(spec, str) and spec not in load_presets()["presets"]:
        return _of_profile(spec, iso)
    if isinstance(spec, Sequence) and not isinstance(spec, str) and spec and all(isinstance(v, str) for v in spec):
        return MixedLevels([noise_levels(str(name), iso=iso) for name in spec])
    if iso is not None:
        raise ValueError(f"noise {spec!r} does not depend on ISO; omit iso, or use one of {', '.join(camera_names())}")
    if isinstance(spec, str):
        return Preset(spec)
    fixed = FixedLevels.of(spec)
    if 0 < fixed.shot_var < fixed.read_var:
        warn_of_swapped_levels(fixed.shot_var, fixed.read_var)
    return fixed


def _own_law(spec: Any) -> NoiseLevels | None:
    """The law of levels that is given as an object or as settings; None for names and pairs."""
    if isinstance(spec, Mapping) and spec.get("name") == "MeasuredNoise":
        model: MeasuredNoise = NOISE.make(spec)
        return model.levels
    if isinstance(spec, ShotReadModel):
        return spec.levels
    if isinstance(spec, NoiseModel):
        raise ValueError(f"{type(spec).__name__} has more than levels of shot and read noise")
    return spec if is_law(spec) else None


def is_law(value: object) -> bool:
    """Whether a value is a law of levels, such as :class:`MeasuredLevels`, and not a model of noise."""
    return callable(getattr(value, "sample", None)) and not isinstance(value, NoiseModel)


def _levels_at(law: NoiseLevels, iso: Iso) -> NoiseLevels:
    """A law of one's own at an ISO, or between two."""
    if iso is None:
        return law
    if not isinstance(law, MeasuredLevels):
        raise ValueError(f"{type(law).__name__} does not depend on ISO; omit iso, or give MeasuredLevels")
    return law.within(iso)


@cache
def warn_of_swapped_levels(shot_var: float, read_var: float) -> None:
    """Warn, once for each pair of levels, of more read noise than shot noise at white, which no sensor has."""
    said = f"noise ({shot_var:g}, {read_var:g}): read_var is above shot_var, as in no sensor"
    warnings.warn(f"{said}; the order is (shot_var, read_var)", stacklevel=3)


def _of_profile(spec: str, iso: Iso) -> ProfileLevels:
    if spec.casefold() != ANY_CAMERA:
        try:
            find_camera(spec, load_profiles().names)
        except ValueError as unknown:
            short = [*load_presets()["presets"], *camera_names(), *NOISE]
            raise ValueError(
                f"noise {spec!r} is unknown: {unknown}; use one of {', '.join(short)}, {ANY_CAMERA!r}, maker and model "
                f"of a camera, or (shot_var, read_var){suggest(spec, short)}; one of your own: rawaug --import FILE.py"
            ) from None
    return ProfileLevels(spec, iso)


def noise_model(spec: NoiseSpec | NoiseLevels | NoiseModel, *, iso: Iso = None, poisson: bool = False) -> NoiseModel:
    """Make the noise model of a name or of (shot_var, read_var); a model is returned as it is.

    Args:
        spec: one of :func:`noise_names`, with settings as ``{"name": ..., "settings": {...}}``, a list of names (each
            picture draws one), a pair of variances on the scale white = 1, a law such as :class:`MeasuredLevels`, or a
            :class:`NoiseModel`.
        iso: of a camera: one ISO, limits, or None for its whole measured range.
        poisson: exact photon statistics instead of the Gaussian.

    Raises:
        ValueError: if a name or setting is unknown, ``iso`` does not fit it, or options are given beside a model.

    Example:
        >>> import torch
        >>> params = noise_model("Google Pixel", iso=800).sample(1, torch.Generator().manual_seed(0))
        >>> round(params["shot_var"].item(), 6)
        0.001764
        >>> len(noise_model({"name": "SensorNoise", "settings": {"levels": "upi", "row_var": 1e-6}}).models)
        2
    """
    if isinstance(spec, Mapping) and "pair_psnr" in spec:
        spec = {"name": "CalibratedNoise", "settings": dict(spec)}
    if isinstance(spec, Mapping) and "settings" not in spec:  # {name: DarkFrames, path: ...}
        spec = {"name": spec.get("name"), "settings": {key: spec[key] for key in spec if key != "name"}}
    if isinstance(spec, (str, Mapping)):
        return _named_model(spec, iso, poisson)
    if isinstance(spec, ShotReadModel) and iso is not None and not poisson:
        return _model_at(spec, iso)
    if isinstance(spec, NoiseModel):
        if iso is not None or poisson:
            raise ValueError(f"iso and poisson apply to levels by name, not to a noise model, {type(spec).__name__}")
        return spec
    return _shot_read(spec, iso, poisson)


def _named_model(spec: Spec, iso: Iso, poisson: bool) -> NoiseModel:
    name, settings = split_spec(spec)
    if _has_law(name) or name not in NOISE:
        noise_levels(name)  # an unknown name is reported before its settings
        options = check_settings(f"noise {name!r}", partial(_shot_read, name), settings)
        return _shot_read(name, **{"iso": iso, "poisson": poisson, **options})

    if iso is not None and name in ("MeasuredNoise", "EldNoise"):
        spec, iso = {"name": name, "settings": {**settings, "iso": iso}}, None
    if iso is not None or poisson:
        raise ValueError(f"iso and poisson apply to the levels of a camera, not to {name}")
    model: NoiseModel = NOISE.make(spec)
    return model


def _model_at(model: ShotReadModel, iso: Iso) -> ShotReadModel:
    """A copy of a model with a law by ISO, at one ISO or between two."""
    law = model.law if isinstance(model, MeasuredNoise) else model.levels
    other = copy(model)
    other.levels = _levels_at(law, iso)
    return other


def _has_law(name: str) -> bool:
    """Whether a name is that of a preset or camera; then no room of noise models has to be loaded."""
    known = {*load_presets()["presets"], *camera_names()}
    return name in known or camera_key(name) in map(camera_key, (ANY_CAMERA, *load_profiles().names))


def _shot_read(spec: NoiseSpec | NoiseLevels, iso: Iso = None, poisson: bool = False) -> NoiseModel:
    levels = noise_levels(spec, iso=iso)
    return PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)


_DRAWS = 2**14

TYPICAL_SIGNAL = 0.104
"""Geometric mean of the mean signals of 137 photographs, each made RAW by four draws of the ISP ``universal``."""


class ScaledLevels:
    """The levels of a law, with both variances multiplied by a factor."""

    def __init__(self, law: NoiseLevels, factor: float) -> None:
        self.law, self.factor = law, factor

    def sample(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw levels from the law and multiply them, ``(batch,)``."""
        shot_var, read_var = self.law.sample(batch, generator)
        return shot_var * self.factor, read_var * self.factor


@NOISE.register("CalibratedNoise")
class CalibratedNoise(ShotReadNoise):
    """Shot and read noise at a stated mean PSNR of the pairs; the ratio of read to shot noise is that of the law.

    In recipes ``noise: {pair_psnr: 41.18}``.

    Args:
        pair_psnr: in dB, over all pairs; a single one scatters as the law and the pictures do.
        signal: mean signal of the clean RAW, a number or one for each of some pictures; by default that of photographs
            made RAW by ``universal``. Of other pictures or another ISP measure it, by
            :meth:`rawaug.RawAugment.measure_signals`.
        levels: the law that is scaled, as :func:`rawaug.noise.noise_levels` knows it.

    Raises:
        ValueError: if the PSNR is not finite, a signal is not in (0, 1], or the law has no noise.
    """

    levels: ScaledLevels

    def __init__(
        self,
        pair_psnr: float,
        signal: float | Sequence[float] = TYPICAL_SIGNAL,
        levels: str | Sequence[float] | Sequence[str] = "cycleisp_sidd",
    ) -> None:
        signals = list(signal) if isinstance(signal, Sequence) else [signal]
        if not math.isfinite(pair_psnr):
            raise ValueError(f"pair_psnr must be finite, got {pair_psnr}")
        if not signals or not all(0.0 < mean <= 1.0 for mean in signals):
            raise ValueError(f"signal: mean signals must be above 0 and at most 1, got {signal}")
        law = noise_levels(levels)
        shot_var, read_var = law.sample(_DRAWS, keyed_generator(0, "pair_psnr"))
        square = torch.outer(torch.tensor(signals, dtype=torch.float64), shot_var.double()) + read_var.double()
        uncalibrated = -10.0 * float(square.log10().mean())
        if not math.isfinite(uncalibrated):
            raise ValueError(f"levels {levels!r} have no noise, which no factor brings to {pair_psnr:g} dB")
        super().__init__(ScaledLevels(law, 10.0 ** ((uncalibrated - pair_psnr) / 10.0)))
