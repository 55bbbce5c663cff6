"""The settings of a :class:`rawaug.RawAugment` as names and numbers, as commands and files give them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from pydantic import TypeAdapter

from rawaug.camera.own import Camera, as_camera, is_camera_file
from rawaug.files import parse_object, to_json
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.camera_noise import USUAL
from rawaug.plugin.draw import Draw
from rawaug.plugin.targets import Burst, Srgb, Target
from rawaug.seeding import keyed_generator

_USUAL_NOISE = "auto"
"""The noise of the camera where its file states one, else ``cycleisp_sidd``."""


def pair_generator(seed: int, name: str, number: int) -> torch.Generator:
    """Make the generator of a pair on the command line, keyed by the seed, the picture's name and the pair's number."""
    return keyed_generator(seed, "synth", name, number)


@dataclass(frozen=True)
class AugmentConfig:
    """The cameras, the noise and the target of pairs.

    Args:
        isp: ISP file, or the name of a shipped ISP.
        camera: maker and model of a published camera, or a YAML file with the figures of your own, in place of the
            ISP's cameras.
        noise: a preset, a measured camera, camera (as measured by the fit, or stated by your camera), an ISP's file, a
            camera's .yaml sheet, or [shot_var, read_var]. By default that of your camera where its file states one,
            at an ISO that of a published camera, else cycleisp_sidd.
        iso: ISO of a measured camera's noise, instead of a draw from its measured range.
        draw: how the camera settings are drawn.
        target: raw, rgb for clean linear camera RGB, or srgb for noisy and clean developed pictures.
        burst: number of noisy frames of each scene; a single one by default.
        cfa: pattern of the RAW: RGGB, BGGR, GRBG, GBRG, XTRANS, or QUAD-RGGB and the like; the ISP's by default.
    """

    isp: str = "universal"
    camera: str | None = None
    noise: tuple[float, float] | str = _USUAL_NOISE
    iso: float | None = None
    draw: Draw = Draw()
    target: Target | Srgb = "raw"
    burst: int | Burst | None = None
    cfa: str | None = None

    def __post_init__(self) -> None:
        if self.noise is None:
            raise ValueError("noise must be a name or a pair (shot_var, read_var) of variances, got None")

        # The figures of a camera count, not its file: the file may change or be elsewhere later.
        if self.camera is not None and (isinstance(self.camera, Camera) or is_camera_file(self.camera)):
            camera = as_camera(self.camera)
            object.__setattr__(self, "camera", to_json(camera.to_json()))

        if self.noise == _USUAL_NOISE:
            own = self.own_camera
            noise = "camera" if own is not None and own.levels else USUAL
            if own is None and self.camera is not None and self.iso is not None:
                noise = self.camera  # a preset has no ISO
            object.__setattr__(self, "noise", noise)

    @property
    def own_camera(self) -> Camera | None:
        """The user's own camera; None where the cameras are published ones, or a fitted one."""
        if self.camera is not None and self.camera.startswith("{"):
            return Camera.from_json(parse_object(self.camera))
        if is_camera_file(self.isp):
            return Camera.load(self.isp)
        return None

    def make(self) -> RawAugment:
        """Make the augmentation of these settings, with the errors of :meth:`rawaug.RawAugment.from_pretrained`."""
        settings = dict(vars(self))
        if self.camera is not None and self.own_camera is not None:
            settings["camera"] = self.own_camera

        return RawAugment.from_pretrained(**settings)

    @property
    def target_name(self) -> Target:
        """``"raw"``, ``"rgb"`` or ``"srgb"``, even where the target is an :class:`rawaug.Srgb`."""
        return "srgb" if isinstance(self.target, Srgb) else self.target

    def to_json(self) -> dict[str, Any]:
        """The settings as a dict for JSON, without those that are None."""
        options: dict[str, Any] = {"mode": "json", "exclude_none": True, "warnings": False}  # 5500 for 5500.0 is right
        return cast(dict[str, Any], TypeAdapter(AugmentConfig).dump_python(self, **options))

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "AugmentConfig":
        """Read settings that :meth:`to_json` has written; ValueError if they are none."""
        return TypeAdapter(AugmentConfig).validate_python(content)
