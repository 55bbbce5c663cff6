"""The noise that belongs to an ISP: measured when it was fitted, or stated by the user's own cameras."""

from __future__ import annotations

from collections.abc import Mapping

from rawaug.camera.own import own_cameras
from rawaug.isp.model import DictionaryISP
from rawaug.noise import Iso, MeasuredLevels, NoiseModel, NoiseSpec, noise_model
from rawaug.noise.names import CAMERA, is_law
from rawaug.registry import spec_label

USUAL = "cycleisp_sidd"
"""The default noise where no camera states its own."""


def usual_noise(isp: DictionaryISP) -> str:
    """The default noise of an ISP: ``"camera"`` if all its cameras are the user's own and state theirs."""
    cameras = own_cameras(isp.info)
    if cameras and all(camera.levels for camera in cameras):
        return CAMERA
    return USUAL


def with_iso(noise: NoiseSpec, iso: Iso) -> NoiseSpec:
    """The noise of a measured camera at an ISO, or between two; ValueError if it does not depend on the ISO."""
    if iso is None:
        return noise
    if isinstance(noise, str):
        return {"name": noise, "settings": {"iso": iso}}
    return noise_model(noise, iso=iso)


def noise_label(noise: NoiseSpec) -> str:
    """Describe a noise in one line."""
    if isinstance(noise, str) or (isinstance(noise, Mapping) and "name" in noise):
        return spec_label(noise)
    if isinstance(noise, MeasuredLevels):
        return noise.camera
    if isinstance(noise, NoiseModel) or is_law(noise):
        return type(noise).__name__
    return str(noise)
