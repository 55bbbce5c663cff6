"""The noise that belongs to an ISP: measured when it was fitted, or stated by the user's own cameras."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeGuard

from rawaug.isp.model import DictionaryISP
from rawaug.isp.own_sampler import own_cameras
from rawaug.noise import Iso, MeasuredLevels, NoiseLevels, NoiseModel, NoiseSpec, noise_model
from rawaug.noise.cameras import is_law
from rawaug.noise.measured import measured_noise
from rawaug.registry import Spec, check_settings, spec_label, split_spec

AnyNoise = NoiseSpec | NoiseLevels | NoiseModel
"""Anything that stands for noise: a name, levels, a law of levels, or a model."""

USUAL = "cycleisp_sidd"
"""The default noise where no camera states its own."""


def usual_noise(isp: DictionaryISP) -> str:
    """The default noise of an ISP: ``"camera"`` if all its cameras are the user's own and state theirs."""
    cameras = own_cameras(isp.info)
    if cameras and all(camera.levels for camera in cameras):
        return "camera"
    return USUAL


def noise_for(isp: DictionaryISP, noise: AnyNoise) -> NoiseModel:
    """The noise model that ``noise`` means for this ISP.

    ``"camera"`` is the law in the ISP's file, at any ISO that was measured; ``{name: camera, settings: {iso: ...}}`` is
    that law at an ISO. Raises ValueError if there is none.
    """
    if _has_name(noise):
        name, settings = split_spec(noise)
        if name == "camera":
            options = check_settings("noise camera", _iso_of, settings)
            return measured_noise(_laws_of(isp), **options)
    return noise_model(noise)


def with_iso(noise: AnyNoise, iso: Iso) -> AnyNoise:
    """The noise of a measured camera at an ISO, or between two; ValueError if it does not depend on the ISO."""
    if iso is None:
        return noise
    if isinstance(noise, str):
        return {"name": noise, "settings": {"iso": iso}}
    return noise_model(noise, iso=iso)


def noise_label(noise: AnyNoise) -> str:
    """Describe a noise in one line."""
    if _has_name(noise):
        return spec_label(noise)
    if isinstance(noise, MeasuredLevels):
        return noise.camera
    if isinstance(noise, NoiseModel) or is_law(noise):
        return type(noise).__name__
    return str(noise)


def _has_name(noise: Any) -> TypeGuard[Spec]:
    return isinstance(noise, str) or (isinstance(noise, Mapping) and "name" in noise)


def _iso_of(iso: Iso = None) -> Iso:
    """The settings of the noise ``camera``."""
    return iso


def _laws_of(isp: DictionaryISP) -> list[Mapping[str, Any]]:
    """The noise laws in an ISP's file, one for each of its cameras; ValueError if one is missing."""
    if "noise" in isp.info:
        return [isp.info["noise"]]

    laws: list[Mapping[str, Any]] = []
    for camera in own_cameras(isp.info):
        law = camera.noise_spec()
        if law is None:
            raise ValueError(f'noise "camera": camera {camera.name!r} states no noise; give noise= by name')
        laws.append(law)

    if not laws:
        raise ValueError('noise "camera": this ISP was fitted without measuring noise; fit it again or use a preset')
    return laws
