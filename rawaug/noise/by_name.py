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
"""

from __future__ import annotations

from collections.abc import Sequence

from rawaug.camera_names import spelled
from rawaug.noise.iso import EldLevels, Iso, PmridLevels, SiddLevels
from rawaug.noise.levels import FixedLevels, MixedLevels, NoiseLevels, Preset, published
from rawaug.noise.models import NoiseModel, PoissonGaussianNoise, ShotReadNoise
from rawaug.noise.profiles import ANY_CAMERA, ProfileLevels, profile_names


def camera_names() -> list[str]:
    """The cameras that were measured one by one: names that take ``iso=``, as those of the profiles do."""
    data = published()
    return [*data["sidd_noise_level_function"]["cameras"], "pmrid", *data["eld"]["cameras"]]


def noise_names() -> list[str]:
    """Every name that :func:`noise_model` knows."""
    return [*published()["presets"], *camera_names(), ANY_CAMERA, *profile_names()]


def noise_levels(spec: str | Sequence[float] | Sequence[str], *, iso: Iso = None) -> NoiseLevels:
    """The levels of a name, of a mixture of names, or the fixed levels (shot_var, read_var).

    Raises:
        ValueError: if the name is unknown, has no law by ISO, or the ISO is outside the measured range.
    """
    data = published()
    if isinstance(spec, str) and spec in camera_names():
        if spec == "pmrid":
            return PmridLevels(iso)
        return SiddLevels(spec, iso) if spec in data["sidd_noise_level_function"]["cameras"] else EldLevels(spec, iso)
    if isinstance(spec, str) and spec not in data["presets"]:
        return _of_profile(spec, iso)
    if not isinstance(spec, str) and spec and all(isinstance(name, str) for name in spec):
        return MixedLevels([noise_levels(str(name), iso=iso) for name in spec])
    if iso is not None:
        raise ValueError(
            f"noise {spec!r} does not depend on ISO; omit iso, or use one of the cameras {', '.join(camera_names())}"
        )
    if isinstance(spec, str):
        return Preset(spec)
    if not isinstance(spec, Sequence) or len(spec) != 2:
        raise ValueError(f"fixed noise must be a pair (shot_var, read_var), got {spec}")
    return FixedLevels(*(float(value) for value in spec))


def _of_profile(spec: str, iso: Iso) -> ProfileLevels:
    if spec.casefold() != ANY_CAMERA:
        try:
            spelled(spec, profile_names())
        except ValueError as unknown:
            listed = ", ".join([*published()["presets"], *camera_names()])
            raise ValueError(
                f"noise {spec!r} is unknown: {unknown}; use one of {listed}, {ANY_CAMERA!r}, maker and model of a "
                "camera, or (shot_var, read_var)"
            ) from None
    return ProfileLevels(spec, iso)


def noise_model(
    spec: str | Sequence[float] | Sequence[str] | NoiseModel, *, iso: Iso = None, poisson: bool = False
) -> NoiseModel:
    """The shot and read noise of a name or of (shot_var, read_var); a model is returned as it is.

    Args:
        spec: one of :func:`noise_names`, a list of them (each picture draws one), a pair of variances on the scale
            white = 1, or a :class:`NoiseModel`.
        iso: of a camera: one ISO, limits, or None for its whole measured range.
        poisson: exact photon statistics instead of the Gaussian.

    Raises:
        ValueError: if the name is unknown, ``iso`` does not fit it, or options are given together with a model.

    Example:
        >>> import torch
        >>> params = noise_model("Google Pixel", iso=800).sample(1, torch.Generator().manual_seed(0))
        >>> round(params["shot_var"].item(), 6)
        0.001764
    """
    if isinstance(spec, NoiseModel):
        if iso is not None or poisson:
            raise ValueError("iso and poisson apply to noise given by name, not to a noise model")
        return spec
    levels = noise_levels(spec, iso=iso)
    return PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)
