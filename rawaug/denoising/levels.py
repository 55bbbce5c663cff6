r"""The noise levels (shot_var, read_var) of a frame that a denoiser is given.

They come from the NoiseProfile tag, from an estimate, or from a camera's law at the frame's ISO, or the user gives
them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from rawaug.camera.own import is_camera_file
from rawaug.denoising.denoiser import ImageDenoiser
from rawaug.io import RawFrame
from rawaug.noise import (
    EldLevels,
    FixedLevels,
    MeasuredLevels,
    camera_law,
    camera_laws,
    camera_names,
    estimate_noise,
    noise_levels,
)
from rawaug.noise.names import CAMERA
from rawaug.noise.profiles import ProfileLevels
from rawaug.registry import split_spec
from rawaug.seeding import keyed_generator

Noise = str | Mapping[Any, Any] | Sequence[float] | MeasuredLevels
"""Where levels come from: ``"auto"``, ``"profile"`` (the tag), ``"estimate"``, a measured camera's name or law (at the
file's ISO, or at another one as ``{"name": ..., "iso": ...}``), ``"camera"`` (the law that the denoiser was trained
for), an ISP's file or a camera's sheet, a law as ``{"name": "MeasuredNoise", ...}``, two variances, or the levels of
other files by (camera, ISO)."""

LOOSE = 0.9
"""The least R^2 of a reliable estimate."""
DISAGREE = 1.75
"""``auto`` takes the estimate if its variance at the mean signal differs from the tag's by this ratio or more.

On frames whose noise is known, the estimate is right within 1.24; a denoiser that is given half the variance leaves
most of the noise."""
_BY_HAND = "noise=(shot_var, read_var)"


class UnknownNoise(ValueError):
    """The noise levels of a frame that is otherwise sound are not known."""


def find_levels(frame: RawFrame, noise: Noise = "auto") -> tuple[float, float, str]:
    """Find (shot_var, read_var) of a frame, and a word on where they come from.

    ``auto`` takes the tag if the frame's own noise agrees with it, else the estimate, else the camera's published law.

    Raises:
        UnknownNoise: if the levels are not known.
        ValueError: if ``noise`` names no camera, or one other than the frame's.
    """
    # Levels or a law of levels.
    if isinstance(noise, MeasuredLevels):
        return *_measured_levels(frame, noise), "camera"
    if isinstance(noise, Mapping):
        shot = frame.camera, frame.iso
        if shot not in noise:
            raise UnknownNoise(f"{frame.name}: no other file is of {frame.camera} at its ISO")
        return *noise[shot], f"other files of {frame.camera} at ISO {frame.iso:g}"
    if not isinstance(noise, str):
        fixed = FixedLevels.of(noise)
        return fixed.shot_var, fixed.read_var, "given"

    # The file's own statement, or an estimate.
    if noise == "auto" and frame.noise_profile is not None:
        return _check_profile(frame, frame.noise_profile)
    if noise == "profile":
        if frame.noise_profile is not None:
            return *frame.noise_profile, "profile"
        reason = "; ".join(frame.remarks) or "has no NoiseProfile tag"
        raise UnknownNoise(f'{frame.name}: {reason}; pass noise="estimate" or {_BY_HAND}')
    if noise not in ("auto", "estimate"):
        return *_published_levels(frame, noise), noise

    try:
        shot_var, read_var, source = _estimate(frame)
    except UnknownNoise:
        if noise == "auto":
            with suppress(ValueError):
                return *_published_levels(frame, frame.camera), f"the law published for {frame.camera}"
        raise
    if noise == "auto":
        for remark in frame.remarks:
            source += f"; {remark}, and is not used"
    return shot_var, read_var, source


def _estimate(frame: RawFrame) -> tuple[float, float, str]:
    """Estimate the levels; read_var is at least half of the published one, since flat areas say little about it."""
    try:
        estimate = estimate_noise(frame.mosaic, frame.cfa)
    except ValueError as error:
        raise UnknownNoise(f"{frame.name}: {error}; or pass {_BY_HAND} or a camera's name") from None

    source = f"estimate, R^2 {estimate.r2:.2f}"
    if estimate.r2 < LOOSE:
        source += ": uncertain, the points follow no line"

    least = 0.0
    with suppress(ValueError):
        least = _published_levels(frame, frame.camera)[1] / 2
    if estimate.r2 < LOOSE:
        advice = f'compare strength=0.7 and noise="{frame.camera}"' if least else "compare strength=0.7"
        source += f"; {advice} at 100 %"
    if estimate.read_var < least:
        source += "; read_var is half the camera's published one"
    return estimate.shot_var, max(estimate.read_var, least), source


def _published_levels(frame: RawFrame, name: str) -> tuple[float, float]:
    if not isinstance(noise_levels(name), (EldLevels, ProfileLevels)) and name not in camera_names():
        raise ValueError(
            f"noise {name!r} is no camera's: a preset draws its levels, and a file has levels of its own; use auto, "
            "profile, estimate, the name of a camera, 'camera' for the law that the denoiser was trained with, the "
            f".safetensors file of rawaug fit, a camera's .yaml sheet, or {_BY_HAND}"
        )
    if frame.iso is None:
        raise UnknownNoise(f"{frame.name}: has no ISO tag, needed for {name}'s noise levels; pass {_BY_HAND}")

    try:
        levels = noise_levels(name, iso=frame.iso)
    except ValueError as error:
        raise UnknownNoise(f"{frame.name}: {error}") from None
    if isinstance(levels, EldLevels):
        return levels.typical()
    shot_var, read_var = levels.sample(1, keyed_generator(0, "denoise"))  # at one ISO the draw is deterministic
    return float(shot_var), float(read_var)


def _check_profile(frame: RawFrame, profile: tuple[float, float]) -> tuple[float, float, str]:
    """Return the tag's levels, unless the frame's own noise is :data:`DISAGREE` times as strong or as weak."""
    try:
        estimate = estimate_noise(frame.mosaic, frame.cfa)
    except ValueError:  # too little of the frame is flat to tell
        return *profile, "profile"

    signal = frame.mosaic.mean().clamp_min(0.0).item()
    by_tag = profile[0] * signal + profile[1]
    by_estimate = estimate.shot_var * signal + estimate.read_var
    if by_estimate <= 0 or max(by_tag, by_estimate) < DISAGREE * min(by_tag, by_estimate):
        return *profile, "profile"
    ratio = by_tag / by_estimate
    return estimate.shot_var, estimate.read_var, f"estimate; the NoiseProfile tag says {ratio:.2g} times as much"


def _measured_levels(frame: RawFrame, law: MeasuredLevels) -> tuple[float, float]:
    cameras = {law.camera, frame.camera} - {"unknown"}
    if len(cameras) > 1:
        raise ValueError(f"{frame.name}: is from {frame.camera}, but the noise law is of {law.camera}; use another")
    try:
        return law.at(frame.iso)
    except ValueError as error:
        raise UnknownNoise(f'{frame.name}: {error}; pass noise="estimate" or {_BY_HAND}') from None


def load_noise(noise: Noise, denoiser: ImageDenoiser) -> Noise:
    """Turn ``"camera"``, an ISP's file, a camera's sheet or ``{"name": ...}`` into its law; keep all else.

    Raises:
        ValueError: if it holds no camera's noise law, or those of several.
    """
    if isinstance(noise, Mapping) and "name" in noise:
        law = noise_levels(noise, info=denoiser.info)
        if isinstance(law, ProfileLevels) and isinstance(split_spec(noise)[1].get("iso"), (int, float)):
            shot_var, read_var = law.sample(1, keyed_generator(0, "denoise"))  # at one ISO the draw is deterministic
            return float(shot_var), float(read_var)
        if not isinstance(law, (MeasuredLevels, FixedLevels)):
            raise ValueError(
                f"noise {noise}: has no levels by ISO; give MeasuredNoise, a camera's name, or that with one iso"
            )
        return law if isinstance(law, MeasuredLevels) else (law.shot_var, law.read_var)
    if not isinstance(noise, str) or noise in ("auto", "profile", "estimate"):
        return noise
    if noise != CAMERA and not noise.endswith(".safetensors") and not is_camera_file(noise):
        return noise

    try:
        laws = camera_laws(noise, denoiser.info)
    except ValueError as error:
        raise ValueError(f"{denoiser.name}: {error}") from None
    if len(laws) > 1:
        raise ValueError(f"noise {noise!r}: holds the noise of {len(laws)} cameras; give the sheet of one")
    return camera_law(laws[0])


def noise_as_json(noise: Noise) -> Any:
    """Convert the setting to what JSON can hold."""
    if isinstance(noise, MeasuredLevels):
        return noise.spec()
    if isinstance(noise, str):
        return noise
    return list(noise)
