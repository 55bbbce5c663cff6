"""What is drawn for a picture, by names and numbers: the settings of a RawAugment as commands and files have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from rawaug.plugin.augment import RawAugment, Sampling
from rawaug.registry import Spec
from rawaug.seeding import keyed_generator


def draw_key(seed: int, name: str, number: int) -> torch.Generator:
    """What a pair is drawn from on the command line: the seed, the picture's name in its folder, the pair's number."""
    return keyed_generator(seed, "synth", name, number)


@dataclass(frozen=True)
class SamplingConfig:
    """Which cameras, lights, curves, exposures and noise are drawn; None draws from all of them.

    Args:
        isp: ISP file, or the name of a shipped ISP.
        camera: maker and model of a published camera, in place of the ISP's cameras.
        light: colour temperature in kelvin, or a lamp such as LED-B3 or FL11.
        tone: one tone curve of the ISP, by name (rawaug info lists them).
        exposure: fixed exposure in stops, instead of a draw from the ISP's range.
        noise: a preset, a measured camera, camera (as measured by the fit), or [shot_var, read_var].
        iso: ISO of a measured camera's noise, instead of a draw from its measured range.
        sampling: how camera settings are drawn.
        cfa: pattern of the RAW: RGGB, BGGR, GRBG, GBRG, XTRANS, or QUAD-RGGB and the like; the ISP's by default.
    """

    isp: str = "universal"
    camera: str | None = None
    light: float | str | None = None
    tone: str | None = None
    exposure: float | None = None
    noise: tuple[float, float] | str = "cycleisp_sidd"
    iso: float | None = None
    sampling: Sampling = "convex"
    cfa: str | None = None

    @property
    def noise_spec(self) -> Spec | Sequence[float]:
        """Noise and ISO, as :func:`rawaug.noise.noise_model` takes them."""
        if self.iso is None:
            return self.noise if isinstance(self.noise, str) else tuple(self.noise)
        if not isinstance(self.noise, str) or self.noise == "camera":
            raise ValueError(f"iso is for the noise of a measured camera by name, not for {self.noise!r}; omit it")
        return {"name": self.noise, "settings": {"iso": self.iso}}

    def draws(self) -> dict[str, Any]:
        """The arguments of :meth:`rawaug.RawAugment.redrawn`."""
        stops = self.exposure
        exposure = None if stops is None else (stops, stops)
        sampling = None if self.sampling == "convex" else self.sampling
        given = {"light": self.light, "tone": self.tone, "exposure": exposure, "sampling": sampling}
        return {"noise": self.noise_spec, **{key: value for key, value in given.items() if value is not None}}

    def arguments(self) -> dict[str, Any]:
        """The arguments of :meth:`rawaug.RawAugment.from_pretrained` besides the ISP."""
        made_for = {"camera": self.camera, "cfa": self.cfa}
        return {**{key: value for key, value in made_for.items() if value is not None}, **self.draws()}

    def make(self) -> RawAugment:
        """The augmentation."""
        return RawAugment.from_pretrained(self.isp, **self.arguments())

    def stored(self) -> dict[str, Any]:
        """What was given, as JSON."""
        given = {key: value for key, value in vars(self).items() if value is not None}
        return given | {"noise": self.noise if isinstance(self.noise, str) else list(self.noise)}
