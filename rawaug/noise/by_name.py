"""Noise by name: the published presets and the measured cameras.

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

Anything in :data:`rawaug.registry.NOISE` goes by its name as well. ``{"name": ..., "settings": {...}}`` gives settings:
``iso`` and ``poisson`` for a name of the table, the keyword arguments of its class for a model. CalibratedNoise needs
no name: ``{"pair_psnr": 41.18}``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial

from rawaug.camera_names import spelled
from rawaug.noise.iso import EldLevels, Iso, PmridLevels, SiddLevels
from rawaug.noise.levels import FixedLevels, MixedLevels, NoiseLevels, Preset, published
from rawaug.noise.models import NoiseModel, PoissonGaussianNoise, ShotReadNoise
from rawaug.noise.profiles import ANY_CAMERA, ProfileLevels, profile_names
from rawaug.registry import NOISE, Spec, checked_settings, name_and_settings, nearest

NoiseSpec = Spec | Sequence[float] | Sequence[str]
"""A name with or without settings, (shot_var, read_var), or several names of which each picture draws one."""


@cache
def _by_iso() -> dict[str, Callable[[Iso], NoiseLevels]]:
    """The cameras that were measured one by one."""
    data = published()
    sidd = {name: partial(SiddLevels, name) for name in data["sidd_noise_level_function"]["cameras"]}
    return {**sidd, "pmrid": PmridLevels, **{name: partial(EldLevels, name) for name in data["eld"]["cameras"]}}


def camera_names() -> list[str]:
    """The cameras that were measured one by one: names that take ``iso=``, as those of the profiles do."""
    return list(_by_iso())


def noise_names() -> list[str]:
    """Every name that :func:`noise_model` knows."""
    return [*NOISE, *published()["presets"], *camera_names(), ANY_CAMERA, *profile_names()]


def noise_levels(spec: str | Sequence[float] | Sequence[str], *, iso: Iso = None) -> NoiseLevels:
    """The levels of a name, of a mixture of names, or the fixed levels (shot_var, read_var).

    Raises:
        ValueError: if the name is unknown, has no law by ISO, or the ISO is outside the measured range.
    """
    if isinstance(spec, str):
        return _of_name(spec, iso)
    if spec and all(isinstance(name, str) for name in spec):
        return MixedLevels([noise_levels(str(name), iso=iso) for name in spec])
    _require_no_iso(spec, iso)
    if not isinstance(spec, Sequence) or len(spec) != 2:
        raise ValueError(f"fixed noise must be a pair (shot_var, read_var), got {spec}")
    return FixedLevels(*(float(value) for value in spec))


def _of_name(name: str, iso: Iso) -> NoiseLevels:
    if name in _by_iso():
        return _by_iso()[name](iso)
    if name in published()["presets"]:
        _require_no_iso(name, iso)
        return Preset(name)
    return _of_profile(name, iso)


def _require_no_iso(spec: str | Sequence[float] | Sequence[str], iso: Iso) -> None:
    if iso is not None:
        raise ValueError(
            f"noise {spec!r} does not depend on ISO; omit iso, or use one of the cameras {', '.join(camera_names())}"
        )


def _of_profile(spec: str, iso: Iso) -> ProfileLevels:
    if spec.casefold() != ANY_CAMERA:
        try:
            spelled(spec, profile_names())
        except ValueError as unknown:
            short = [*published()["presets"], *camera_names(), *NOISE]
            listed = ", ".join(short)
            raise ValueError(
                f"noise {spec!r} is unknown: {unknown}; use one of {listed}, {ANY_CAMERA!r}, maker and model of a "
                f"camera, or (shot_var, read_var){nearest(spec, short)}"
            ) from None
    return ProfileLevels(spec, iso)


def noise_model(spec: NoiseSpec | NoiseModel, *, iso: Iso = None, poisson: bool = False) -> NoiseModel:
    """The noise model of a name or of (shot_var, read_var); a model is returned as it is.

    Args:
        spec: one of :func:`noise_names`, with settings as ``{"name": ..., "settings": {...}}``, a list of names (each
            picture draws one), a pair of variances on the scale white = 1, or a :class:`NoiseModel`.
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
    if isinstance(spec, (str, Mapping)):
        name, settings = name_and_settings(spec)
        if name not in NOISE:
            noise_levels(name)  # an unknown name is reported before its settings
            options = checked_settings(f"noise {name!r}", partial(_shot_read, name), settings)
            return _shot_read(name, **{"iso": iso, "poisson": poisson, **options})
        model: NoiseModel = NOISE.make(spec)
    elif isinstance(spec, NoiseModel):
        model = spec
    else:
        return _shot_read(spec, iso, poisson)
    if iso is not None or poisson:
        raise ValueError("iso and poisson apply to noise given by name, not to a noise model")
    return model


def _shot_read(
    spec: str | Sequence[float] | Sequence[str], iso: Iso = None, poisson: bool = False
) -> PoissonGaussianNoise | ShotReadNoise:
    levels = noise_levels(spec, iso=iso)
    return PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)
