"""What is drawn for a picture, by names and numbers: the settings of a RawAugment as commands and files have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from rawaug.plugin.augment import RawAugment, Sampling
from rawaug.plugin.targets import Target
from rawaug.registry import Spec
from rawaug.seeding import keyed_generator


def draw_key(seed: int, name: str, number: int) -> torch.Generator:
    """What a pair is drawn from on the command line: the seed, the picture's name in its folder, the pair's number."""
    return keyed_generator(seed, "synth", name, number)


@dataclass(frozen=True)
class SamplingConfig:
    """Which cameras, lights, curves, exposures and noise are drawn, and for which target; None draws from all of them.

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
        target: raw (the default), rgb for clean linear camera RGB, or srgb for noisy and clean developed pictures.
        jpeg: of srgb, lowest and highest JPEG quality of the noisy pictures; not compressed by default.
        burst: number of noisy frames of each scene; a single one by default.
        motion: of bursts, largest shift in pixels and rotation in degrees; 2 and 0.5 by default.
        stops: of bursts, exposure of each frame in stops, as "[0, -2, 2]"; all alike by default.
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
    target: Target | None = None
    jpeg: tuple[int, int] | None = None
    burst: int | None = None
    motion: tuple[float, float] | None = None
    stops: tuple[float, ...] | None = None

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

    def form(self) -> dict[str, Any]:
        """Target and burst, as :class:`rawaug.RawAugment` takes them."""
        return self._given("target", "jpeg", "burst", "motion", "stops")

    def arguments(self) -> dict[str, Any]:
        """The arguments of :meth:`rawaug.RawAugment.from_pretrained` besides the ISP."""
        return {**self._given("camera", "cfa"), **self.draws(), **self.form()}

    def make(self) -> RawAugment:
        return RawAugment.from_pretrained(self.isp, **self.arguments())

    def stored(self) -> dict[str, Any]:
        given = self._given(*vars(self))
        return {key: list(value) if isinstance(value, tuple) else value for key, value in given.items()}

    def _given(self, *names: str) -> dict[str, Any]:
        return {name: value for name in names if (value := getattr(self, name)) is not None}
