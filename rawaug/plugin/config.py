"""The settings of a :class:`rawaug.RawAugment` by names and numbers, as commands and files have them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch
from pydantic import TypeAdapter

from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from rawaug.plugin.targets import Burst, Srgb, Target
from rawaug.seeding import keyed_generator


def pair_generator(seed: int, name: str, number: int) -> torch.Generator:
    """The generator of a pair on the command line, keyed by the seed, the picture's name and the pair's number."""
    return keyed_generator(seed, "synth", name, number)


@dataclass(frozen=True)
class AugmentConfig:
    """The cameras, the noise and the target of pairs.

    Args:
        isp: ISP file, or the name of a shipped ISP.
        camera: maker and model of a published camera, in place of the ISP's cameras.
        noise: a preset, a measured camera, camera (as measured by the fit), or [shot_var, read_var].
        iso: ISO of a measured camera's noise, instead of a draw from its measured range.
        draw: how the camera settings are drawn.
        target: raw, rgb for clean linear camera RGB, or srgb for noisy and clean developed pictures.
        burst: number of noisy frames of each scene; a single one by default.
        cfa: pattern of the RAW: RGGB, BGGR, GRBG, GBRG, XTRANS, or QUAD-RGGB and the like; the ISP's by default.
    """

    isp: str = "universal"
    camera: str | None = None
    noise: tuple[float, float] | str = "cycleisp_sidd"
    iso: float | None = None
    draw: Draw = Draw()
    target: Target | Srgb = "raw"
    burst: int | Burst | None = None
    cfa: str | None = None

    def __post_init__(self) -> None:
        if self.noise is None:
            raise ValueError("noise must be a name or a pair (shot_var, read_var) of variances, got None")

    def make(self) -> RawAugment:
        """The augmentation of these settings; it raises what :meth:`rawaug.RawAugment.from_pretrained` raises."""
        return RawAugment.from_pretrained(**vars(self))

    @property
    def target_name(self) -> Target:
        """``"raw"``, ``"rgb"`` or ``"srgb"``, also where the target is an :class:`rawaug.Srgb`."""
        return "srgb" if isinstance(self.target, Srgb) else self.target

    def to_json(self) -> dict[str, Any]:
        """The settings as a dict for JSON, without those that are None."""
        options: dict[str, Any] = {"mode": "json", "exclude_none": True, "warnings": False}  # 5500 for 5500.0 is right
        return cast(dict[str, Any], TypeAdapter(AugmentConfig).dump_python(self, **options))

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> "AugmentConfig":
        """The settings that :meth:`to_json` has written; ValueError if they are none."""
        return TypeAdapter(AugmentConfig).validate_python(content)
