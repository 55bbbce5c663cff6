r"""Noise by every spelling of it: published presets, measured cameras, numbers, files.

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
``camera`` is the noise that the file of an ISP or a denoiser states. The ``.safetensors`` file of an ISP that was
fitted to a camera names its noise, and so does a camera's ``.yaml`` sheet. Anything in
:data:`rawaug.noise.models.NOISE` can be named as well. ``{"name": ..., ...}`` adds settings: ``iso`` and ``poisson``
for a camera, the keyword arguments of its class for a model. CalibratedNoise needs no name: ``{"pair_psnr": 41.18}``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cache, partial
from typing import Any, TypeGuard

from rawaug.camera.names import camera_key, find_camera
from rawaug.camera.own import Camera, is_camera_file, own_cameras
from rawaug.files import find_weights, parse_object, read_header
from rawaug.noise.levels import EldLevels, FixedLevels, Iso, MixedLevels, NoiseLevels, PmridLevels, Preset, load_presets
from rawaug.noise.measured import MeasuredLevels, MeasuredNoise, RoundedNoise, measured_noise, sidd_levels
from rawaug.noise.models import NOISE, NoiseModel, PoissonGaussianNoise, ShotReadModel, ShotReadNoise
from rawaug.noise.profiles import ANY_CAMERA, ProfileLevels, load_profiles
from rawaug.registry import Spec, check_settings, split_spec, suggest

NoiseSpec = Spec | Sequence[float] | Sequence[Spec] | NoiseLevels | NoiseModel
"""Whatever stands for noise: a name with or without settings, (shot_var, read_var), several names, of which each
picture draws one, a law of levels, or a model."""

CAMERA = "camera"
"""The name of the noise that belongs to an ISP or a denoiser."""


@cache
def _single_cameras() -> dict[str, Callable[[Iso], MeasuredLevels | PmridLevels | EldLevels]]:
    """Map the name of each camera that was measured on its own to a function that makes its levels."""
    presets = load_presets()
    cameras: dict[str, Callable[[Iso], MeasuredLevels | PmridLevels | EldLevels]] = {}
    for phone in presets["sidd_noise_level_function"]["cameras"]:
        cameras[phone] = partial(sidd_levels, phone)

    cameras["pmrid"] = PmridLevels
    for camera in presets["eld"]["cameras"]:
        cameras[camera] = partial(EldLevels, camera)
    return cameras


def camera_names() -> list[str]:
    """List the cameras that were measured one by one."""
    return list(_single_cameras())


def measured_ranges() -> dict[str, tuple[float, float]]:
    """Give the lowest and highest ISO of each camera that was measured one by one."""
    ranges = {}
    for name, make_levels in _single_cameras().items():
        lowest, highest = make_levels(None).iso or (0.0, 0.0)
        ranges[name] = lowest, highest
    return ranges


def noise_names() -> list[str]:
    """List every name that :func:`noise_model` knows."""
    return [*NOISE, *load_presets()["presets"], *camera_names(), ANY_CAMERA, *load_profiles().names]


def noise_model(
    spec: NoiseSpec, *, iso: Iso = None, poisson: bool = False, info: Mapping[str, Any] | None = None
) -> NoiseModel:
    """Make the noise model that any spelling of noise stands for; a model is returned unchanged.

    Args:
        spec: a preset or a camera (:func:`noise_names`), ``"camera"``, the ``.safetensors`` file of an ISP that
            ``rawaug fit`` wrote, the ``.yaml`` sheet of a camera, or a model of :data:`NOISE`, with settings as
            ``{"name": ..., "iso": ...}``; several names, of which each picture draws one; a pair of variances on the
            scale white = 1; a law such as :class:`MeasuredLevels`; or a :class:`NoiseModel`.
        iso: ISO of a camera: one value, limits, or None for its whole measured range.
        poisson: use exact photon statistics instead of the Gaussian.
        info: what the file of an ISP or a denoiser says of itself, for the noise ``"camera"``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a name or setting is unknown, ``iso`` does not fit it, or options are given beside a model.

    Example:
        >>> import torch
        >>> params = noise_model("Google Pixel", iso=800).sample(1, torch.Generator().manual_seed(0))
        >>> round(params["shot_var"].item(), 6)
        0.001764
        >>> len(noise_model({"name": "SensorNoise", "levels": "upi", "row_var": 1e-6}).models)
        2
    """
    if isinstance(spec, NoiseModel):
        return _restrict(spec, iso, poisson)
    if not isinstance(spec, (str, Mapping)):
        return _shot_read(noise_levels(spec, iso=iso), poisson)

    if isinstance(spec, Mapping) and "pair_psnr" in spec:
        spec = {"name": "CalibratedNoise", **spec}
    name, settings = split_spec(spec)
    if not _has_levels(name) and name in NOISE:
        if iso is not None and name in ("MeasuredNoise", "EldNoise"):
            settings, iso = {**settings, "iso": iso}, None
        if iso is not None or poisson:
            raise ValueError(f"iso and poisson apply to the levels of a camera, not to {name}")
        registered: NoiseModel = NOISE.make({"name": name, "settings": settings})
        return registered

    levels = noise_levels(name, info=info)  # an unknown name is reported before its settings
    options = {"iso": iso, "poisson": poisson, **check_settings(f"noise {name!r}", _choose, settings)}
    if options["iso"] is not None:
        levels = noise_levels(name, iso=options["iso"], info=info)
    if _names_a_file(name) and not options["poisson"]:
        return measured_noise(camera_laws(name, info), options["iso"])  # it also rounds as the camera does
    return _shot_read(levels, options["poisson"])


def noise_levels(spec: NoiseSpec, *, iso: Iso = None, info: Mapping[str, Any] | None = None) -> NoiseLevels:
    """Make the law of levels, (shot_var, read_var) of each picture, that any spelling of noise stands for.

    Args:
        spec: as for :func:`noise_model`; a model must have a law of levels and no other noise. A camera within a range
            of ISO is ``{"name": "any camera", "iso": (50, 200)}``.
        iso: ISO of a camera: one value, limits, or None for its whole measured range.
        info: what the file of an ISP or a denoiser says of itself, for the noise ``"camera"``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the name is unknown, has no law by ISO, or the ISO is outside the measured range.
    """
    if isinstance(spec, str):
        if _names_a_file(spec):
            return measured_noise(camera_laws(spec, info), iso).levels
        return _levels_by_name(spec, iso)
    if isinstance(spec, Mapping):
        return _shot_read_law(noise_model(spec, iso=iso, info=info))
    if isinstance(spec, NoiseModel):
        return _restrict_law(_shot_read_law(spec), iso)
    if is_law(spec):
        return _restrict_law(spec, iso)

    if isinstance(spec, Sequence):
        parts = [part for part in spec if isinstance(part, (str, Mapping))]
        if parts and len(parts) == len(spec):
            return MixedLevels([noise_levels(part, iso=iso, info=info) for part in parts])
    if iso is not None:
        raise _no_iso(spec)
    levels = FixedLevels.of(spec)
    if 0 < levels.shot_var < levels.read_var:
        _warn_of_swapped_levels(levels.shot_var, levels.read_var)
    return levels


def is_law(value: object) -> TypeGuard[NoiseLevels]:
    """Whether a value is a law of levels, such as :class:`MeasuredLevels`, and not a model of noise."""
    return callable(getattr(value, "sample", None)) and not isinstance(value, NoiseModel)


# -- by name -----------------------------------------------------------------------------------------------------------


def _levels_by_name(name: str, iso: Iso) -> NoiseLevels:
    presets = load_presets()["presets"]
    if name in _single_cameras():
        return _single_cameras()[name](iso)
    if name in presets:
        if iso is not None:
            raise _no_iso(name)
        return Preset(name)

    if name.casefold() != ANY_CAMERA:
        try:
            find_camera(name, load_profiles().names)
        except ValueError as unknown:
            short = [*presets, *camera_names(), *NOISE]
            raise ValueError(
                f"noise {name!r} is unknown: {unknown}; use one of {', '.join(short)}, {ANY_CAMERA!r}, maker and model "
                "of a camera, (shot_var, read_var), 'camera' for the noise that an ISP or a denoiser was fitted or "
                "trained with, a .safetensors file that rawaug fit wrote, or a camera's .yaml sheet"
                f"{suggest(name, short)}; one of your own: rawaug --import FILE.py"
            ) from None
    return ProfileLevels(name, iso)


def _has_levels(name: str) -> bool:
    """Whether a name is that of levels, so that no package of noise models has to be loaded."""
    if name in load_presets()["presets"] or name in _single_cameras() or _names_a_file(name):
        return True
    return camera_key(name) in map(camera_key, (ANY_CAMERA, *load_profiles().names))


def _choose(iso: Iso = None, poisson: bool = False) -> None:
    """The settings that a name of levels takes."""


def _shot_read(levels: NoiseLevels, poisson: bool) -> NoiseModel:
    effects = sorted(getattr(levels, "effects", ()))
    if poisson and effects:
        raise ValueError(f"poisson: these levels state {', '.join(effects)}, which come with Gaussian counts; omit it")
    if effects:
        return RoundedNoise(levels)
    return PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)


def _no_iso(spec: object) -> ValueError:
    return ValueError(f"noise {spec!r} does not depend on ISO; omit iso, or use one of {', '.join(camera_names())}")


@cache
def _warn_of_swapped_levels(shot_var: float, read_var: float) -> None:
    """Warn, once for each pair of levels, of more read noise than shot noise at white, which no sensor has."""
    problem = f"noise ({shot_var:g}, {read_var:g}): read_var is above shot_var, as in no sensor"
    warnings.warn(f"{problem}; the order is (shot_var, read_var)", stacklevel=3)


# -- in files ----------------------------------------------------------------------------------------------------------


def _names_a_file(name: str) -> bool:
    return name == CAMERA or name.endswith(".safetensors") or is_camera_file(name)


def camera_laws(name: str, info: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """Read the noise of each camera of an ISP or a sheet, as ``{"name": "MeasuredNoise", "settings": ...}``.

    Args:
        name: ``"camera"``, the ``.safetensors`` file of an ISP, of which only the header is read, or a ``.yaml`` sheet.
        info: what the file of an ISP or a denoiser says of itself, which is ``"camera"``.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if a camera states no noise.
    """
    if is_camera_file(name):
        cameras = [Camera.load(name)]
    else:
        if name != CAMERA:
            info = parse_object(read_header(find_weights(name)).get("info", "{}"))
        law = (info or {}).get("noise")
        if isinstance(law, Mapping) and law.get("name") == "MeasuredNoise":
            return [dict(law)]
        cameras = own_cameras(info or {})

    laws = []
    for camera in cameras:
        law = camera.noise_spec()
        if law is None:
            raise ValueError(f"noise {name!r}: camera {camera.name!r} states no noise; give noise by another name")
        laws.append(law)
    if not laws:
        raise ValueError(
            f"noise {name!r}: no noise of a camera was measured or stated; use an ISP that rawaug fit measured, a "
            "camera's .yaml sheet, a preset or the name of a camera"
        )
    return laws


# -- at an ISO ---------------------------------------------------------------------------------------------------------


def _restrict(model: NoiseModel, iso: Iso, poisson: bool) -> NoiseModel:
    """Copy a model whose law depends on the ISO, restricted to one ISO or to the range between two."""
    if iso is None and not poisson:
        return model
    if poisson or not isinstance(model, ShotReadModel):
        raise ValueError(f"iso and poisson apply to levels by name, not to a noise model, {type(model).__name__}")

    restricted = copy(model)
    restricted.levels = _restrict_law(model.law if isinstance(model, MeasuredNoise) else model.levels, iso)
    return restricted


def _restrict_law(law: NoiseLevels, iso: Iso) -> NoiseLevels:
    if iso is None:
        return law
    if not isinstance(law, MeasuredLevels):
        raise ValueError(f"{type(law).__name__} does not depend on ISO; omit iso, or give MeasuredLevels")
    return law.within(iso)


def _shot_read_law(model: NoiseModel) -> NoiseLevels:
    if not isinstance(model, ShotReadModel):
        raise ValueError(f"{type(model).__name__} has more than levels of shot and read noise")
    return model.levels
