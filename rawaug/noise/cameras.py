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

The presets and the single cameras are in :mod:`rawaug.noise.levels`, the profiles in :mod:`rawaug.noise.profiles`.
Anything in :data:`rawaug.noise.models.NOISE` can be named as well. ``{"name": ..., "settings": {...}}`` adds settings:
``iso`` and ``poisson`` for a name in the table, the keyword arguments of its class for a model. CalibratedNoise needs
no name: ``{"pair_psnr": 41.18}``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cache, partial
from typing import Any, TypeGuard

from rawaug.camera.names import camera_key, find_camera
from rawaug.noise.levels import (
    EldLevels,
    FixedLevels,
    Iso,
    MixedLevels,
    NoiseLevels,
    PmridLevels,
    Preset,
    SiddLevels,
    load_presets,
)
from rawaug.noise.measured import MeasuredLevels, MeasuredNoise
from rawaug.noise.models import NOISE, NoiseModel, PoissonGaussianNoise, ShotReadModel, ShotReadNoise
from rawaug.noise.profiles import ANY_CAMERA, ProfileLevels, load_profiles
from rawaug.registry import Spec, check_settings, split_spec, suggest

NoiseSpec = Spec | Sequence[float] | Sequence[Spec]
"""A name with or without settings, (shot_var, read_var), or several names, of which each picture draws one."""


@cache
def _single_cameras() -> dict[str, Callable[[Iso], SiddLevels | PmridLevels | EldLevels]]:
    """Map the name of each camera that was measured on its own to a function that makes its levels."""
    presets = load_presets()
    cameras: dict[str, Callable[[Iso], SiddLevels | PmridLevels | EldLevels]] = {}
    for phone in presets["sidd_noise_level_function"]["cameras"]:
        cameras[phone] = partial(SiddLevels, phone)

    cameras["pmrid"] = PmridLevels
    for camera in presets["eld"]["cameras"]:
        cameras[camera] = partial(EldLevels, camera)
    return cameras


def camera_names() -> list[str]:
    """List the cameras that were measured one by one."""
    return list(_single_cameras())


def measured_ranges() -> dict[str, tuple[float, float]]:
    """Give the lowest and highest ISO of each camera that was measured one by one."""
    return {name: make_levels(None).iso for name, make_levels in _single_cameras().items()}


def noise_names() -> list[str]:
    """List every name that :func:`noise_model` knows."""
    return [*NOISE, *load_presets()["presets"], *camera_names(), ANY_CAMERA, *load_profiles().names]


# -- levels ------------------------------------------------------------------------------------------------------------


def noise_levels(spec: NoiseSpec | NoiseLevels | NoiseModel, *, iso: Iso = None) -> NoiseLevels:
    """Make levels from a name, from a mixture of names, or fixed ones from (shot_var, read_var).

    Args:
        spec: a preset or camera, several of them of which each picture draws one, or two variances, white = 1. A camera
            within a range of ISO is ``{name: any camera, settings: {iso: [50, 200]}}``. Or a law of your own, such as
            :class:`MeasuredLevels`, a model with one, or ``{name: MeasuredNoise, settings: ...}``.
        iso: ISO of a camera: one value, limits, or None for its whole measured range.

    Raises:
        ValueError: if the name is unknown, has no law by ISO, or the ISO is outside the measured range.
    """
    law = _own_law(spec)
    if law is not None:
        return _levels_at(law, iso)
    if isinstance(spec, str):
        return _levels_by_name(spec, iso)
    if isinstance(spec, Mapping):
        name, settings = split_spec(spec)
        make_levels = partial(_levels_by_name, name)
        return make_levels(**check_settings(f"noise {name!r}", make_levels, {"iso": iso, **settings}))
    if _is_list_of_names(spec):
        return MixedLevels([noise_levels(name, iso=iso) for name in spec])

    if iso is not None:
        raise _no_iso(spec)
    levels = FixedLevels.of(spec)
    if 0 < levels.shot_var < levels.read_var:
        _warn_of_swapped_levels(levels.shot_var, levels.read_var)
    return levels


def _own_law(spec: Any) -> NoiseLevels | None:
    """The law of levels that is given as an object or as settings; None for names and for pairs of variances."""
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
    """Restrict the user's own law to an ISO, or to the range between two."""
    if iso is None:
        return law
    if not isinstance(law, MeasuredLevels):
        raise ValueError(f"{type(law).__name__} does not depend on ISO; omit iso, or give MeasuredLevels")
    return law.within(iso)


def _levels_by_name(name: str, iso: Iso) -> NoiseLevels:
    if name in _single_cameras():
        return _single_cameras()[name](iso)
    if name not in load_presets()["presets"]:
        return _levels_of_profile(name, iso)
    if iso is not None:
        raise _no_iso(name)
    return Preset(name)


def _levels_of_profile(name: str, iso: Iso) -> ProfileLevels:
    if name.casefold() != ANY_CAMERA:
        try:
            find_camera(name, load_profiles().names)
        except ValueError as unknown:
            short = [*load_presets()["presets"], *camera_names(), *NOISE]
            raise ValueError(
                f"noise {name!r} is unknown: {unknown}; use one of {', '.join(short)}, {ANY_CAMERA!r}, maker and model "
                f"of a camera, or (shot_var, read_var){suggest(name, short)}; one of your own: rawaug --import FILE.py"
            ) from None
    return ProfileLevels(name, iso)


def _is_list_of_names(spec: Any) -> TypeGuard[Sequence[Spec]]:
    if not isinstance(spec, Sequence) or not spec:
        return False
    return all(isinstance(name, (str, Mapping)) for name in spec)


def _no_iso(spec: object) -> ValueError:
    return ValueError(f"noise {spec!r} does not depend on ISO; omit iso, or use one of {', '.join(camera_names())}")


@cache
def _warn_of_swapped_levels(shot_var: float, read_var: float) -> None:
    """Warn, once for each pair of levels, of more read noise than shot noise at white, which no sensor has."""
    problem = f"noise ({shot_var:g}, {read_var:g}): read_var is above shot_var, as in no sensor"
    warnings.warn(f"{problem}; the order is (shot_var, read_var)", stacklevel=3)


# -- models ------------------------------------------------------------------------------------------------------------


def noise_model(spec: NoiseSpec | NoiseLevels | NoiseModel, *, iso: Iso = None, poisson: bool = False) -> NoiseModel:
    """Make the noise model of a name or of (shot_var, read_var); a model is returned unchanged.

    Args:
        spec: one of :func:`noise_names`, with settings as ``{"name": ..., "settings": {...}}``, a list of names (each
            picture draws one), a pair of variances on the scale white = 1, a law such as :class:`MeasuredLevels`, or a
            :class:`NoiseModel`.
        iso: ISO of a camera: one value, limits, or None for its whole measured range.
        poisson: use exact photon statistics instead of the Gaussian.

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
    if isinstance(spec, Mapping):
        return _model_by_name(_with_settings(spec), iso, poisson)
    if isinstance(spec, str):
        return _model_by_name(spec, iso, poisson)
    if not isinstance(spec, NoiseModel):
        return _shot_read(spec, iso, poisson)

    if isinstance(spec, ShotReadModel) and iso is not None and not poisson:
        return _model_at(spec, iso)
    if iso is not None or poisson:
        raise ValueError(f"iso and poisson apply to levels by name, not to a noise model, {type(spec).__name__}")
    return spec


def _with_settings(spec: Mapping[str, Any]) -> Mapping[str, Any]:
    """Complete ``{pair_psnr: 41.18}`` and ``{name: DarkFrames, path: ...}`` to a name with settings."""
    if "pair_psnr" in spec:
        return {"name": "CalibratedNoise", "settings": dict(spec)}
    if "settings" in spec:
        return spec
    return {"name": spec.get("name"), "settings": {key: value for key, value in spec.items() if key != "name"}}


def _model_by_name(spec: Spec, iso: Iso, poisson: bool) -> NoiseModel:
    name, settings = split_spec(spec)
    if _has_levels(name) or name not in NOISE:
        noise_levels(name)  # an unknown name is reported before its settings
        options = check_settings(f"noise {name!r}", partial(_shot_read, name), settings)
        return _shot_read(name, **{"iso": iso, "poisson": poisson, **options})

    if iso is not None and name in ("MeasuredNoise", "EldNoise"):
        spec = {"name": name, "settings": {**settings, "iso": iso}}
        iso = None
    if iso is not None or poisson:
        raise ValueError(f"iso and poisson apply to the levels of a camera, not to {name}")
    model: NoiseModel = NOISE.make(spec)
    return model


def _has_levels(name: str) -> bool:
    """Whether a name is that of a preset or camera, so that no package of noise models has to be loaded."""
    if name in load_presets()["presets"] or name in _single_cameras():
        return True
    return camera_key(name) in map(camera_key, (ANY_CAMERA, *load_profiles().names))


def _model_at(model: ShotReadModel, iso: Iso) -> ShotReadModel:
    """Copy a model whose law depends on the ISO, restricted to one ISO or to the range between two."""
    law = model.law if isinstance(model, MeasuredNoise) else model.levels
    other = copy(model)
    other.levels = _levels_at(law, iso)
    return other


def _shot_read(spec: NoiseSpec | NoiseLevels, iso: Iso = None, poisson: bool = False) -> NoiseModel:
    levels = noise_levels(spec, iso=iso)
    return PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)
