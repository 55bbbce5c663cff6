"""The noise of a RAW frame: from its NoiseProfile tag, by an estimate, by a camera's law at its ISO, or as given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import denoisers
from denoisers.pretrained import find
from rawaug.io import RawFrame
from rawaug.isp.model import DictionaryISP
from rawaug.noise import (
    EldLevels,
    FixedLevels,
    MeasuredLevels,
    camera_law,
    camera_names,
    estimate_noise,
    noise_levels,
)
from rawaug.seeding import keyed_generator

Noise = str | Sequence[float] | MeasuredLevels
"""``"auto"``, ``"profile"``, ``"estimate"``, a measured camera's name or law (at the file's ISO), or two variances."""


def levels_of(frame: RawFrame, noise: Noise = "auto") -> tuple[float, float, str]:
    """(shot_var, read_var) of a frame and their source; ``auto`` is the profile, else the estimate.

    Raises:
        ValueError: if the frame has no profile, its noise cannot be estimated, or the name is unknown or needs an ISO.
    """
    if isinstance(noise, MeasuredLevels):
        return *_of_law(noise, frame), "camera"
    if not isinstance(noise, str):
        fixed = FixedLevels(*noise)
        return fixed.shot_var, fixed.read_var, "given"
    if noise == "profile" or (noise == "auto" and frame.noise_profile is not None):
        if frame.noise_profile is None:
            raise ValueError(
                f"{frame.name}: has no NoiseProfile tag; pass --noise estimate or --noise '[shot_var, read_var]'"
            )
        return *frame.noise_profile, "profile"
    if noise in ("auto", "estimate"):
        try:
            estimate = estimate_noise(frame.mosaic, frame.cfa)
        except ValueError as error:
            raise ValueError(
                f"{frame.name}: {error}; or pass --noise '[shot_var, read_var]' or a camera's name"
            ) from None
        return estimate.shot_var, estimate.read_var, "estimate"
    if noise not in camera_names():
        raise ValueError(
            f"noise {noise!r} is unknown; use auto, profile, estimate, [shot_var, read_var] or one of {camera_names()}"
        )
    if frame.iso is None:
        raise ValueError(
            f"{frame.name}: has no ISO tag, needed for {noise}'s noise levels; pass --noise '[shot_var, read_var]'"
        )
    try:
        levels = noise_levels(noise, iso=frame.iso)
    except ValueError as error:
        raise ValueError(f"{frame.name}: {error}") from None
    if isinstance(levels, EldLevels):
        return *levels.typical(), noise
    shot_var, read_var = levels.sample(1, keyed_generator(0, "denoise"))  # at one ISO the draw is deterministic
    return float(shot_var), float(read_var), noise


def _of_law(law: MeasuredLevels, frame: RawFrame) -> tuple[float, float]:
    """The law at the frame's ISO.

    Raises:
        ValueError: if the law is of another camera, or does not reach the ISO.
    """
    known = {law.camera, frame.camera} - {"unknown"}
    if len(known) > 1:
        raise ValueError(f"{frame.name}: is from {frame.camera}, but the noise law is of {law.camera}; use another")
    try:
        return law.at(frame.iso)
    except ValueError as error:
        raise ValueError(f"{frame.name}: {error}; pass --noise estimate or --noise '[shot_var, read_var]'") from None


def stored_noise(noise: Noise, denoiser: str | Path) -> Noise:
    """``"camera"`` as the law in the denoiser's file, an ISP's file as the law in it; anything else as it is.

    Raises:
        FileNotFoundError, ValueError: if there is no such file, or no law in it.
    """
    if not isinstance(noise, str) or not (noise == "camera" or noise.endswith(".safetensors")):
        return noise
    stored = denoisers.load(find(denoiser))[1] if noise == "camera" else DictionaryISP.from_pretrained(noise).info
    law = stored.get("noise")
    if not isinstance(law, Mapping):
        file = denoiser if noise == "camera" else noise
        raise ValueError(f"{file}: holds no camera's noise law; give an ISP's file that does, or --noise estimate")
    return camera_law(law)


def as_json(noise: Noise) -> Any:
    """As ``denoise.json`` states it."""
    if isinstance(noise, MeasuredLevels):
        return noise.spec()
    return noise if isinstance(noise, str) else list(noise)
