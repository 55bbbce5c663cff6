r"""Which camera settings pictures are given: cameras, lights, tone curves and exposures, drawn for each picture.

A setting is a colour matrix C, gains g and a tone curve T. It comes from the hulls of the dictionaries' atoms, or it is
one camera in one light, for an ISP of published cameras (:mod:`rawaug.isp.dictionary`). An exposure of e stops divides
the gains of the forward direction by :math:`2^e`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import EXPOSURE, perturb
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.registry import suggest

Sampling = Literal["convex", "independent", "perturb", "chosen"]


@dataclass(frozen=True)
class Draw:
    """How the camera setting of each picture is drawn.

    Args:
        sampling: ``convex`` draws without looking at the picture: a camera in a light and a mixture of tone curves
            where the ISP knows published cameras, as ``universal`` does, and mixtures of the atoms of a fitted ISP.
            ``independent`` is the same with the gains of another camera in another light, to see what consistency is
            worth. ``perturb`` adds Gaussian noise to the weights that the ISP chooses for the picture; ``chosen`` takes
            these as they are.
        strength: standard deviation of the noise that ``perturb`` adds to the weights.
        exposure: lowest and highest exposure of the RAW in stops, or a single one. By default that of the frames for a
            fitted ISP, and -0.5 to 1 for published cameras, whose headroom above white is not known. To train for other
            cameras than the fitted one, use -1.5 to 0.
        light: colour temperature in kelvin of the light that published cameras are drawn in, or one of
            :data:`rawaug.isp.cameras.LAMPS` by name, such as ``LED-B3``. Any light by default.
        tone: one tone curve of an ISP of published cameras, by name (``rawaug info`` lists them), in place of mixtures.

    Raises:
        ValueError: if the sampling is unknown, or the strength or the exposure out of range.
    """

    sampling: Sampling = "convex"
    strength: float = 0.1
    exposure: tuple[float, float] | float | None = None
    light: float | str | None = None
    tone: str | None = None

    def __post_init__(self) -> None:
        if self.sampling not in get_args(Sampling):
            raise ValueError(f"sampling {self.sampling!r} is unknown; use one of {', '.join(get_args(Sampling))}")
        if not self.strength >= 0:
            raise ValueError(f"strength must be at least 0, got {self.strength}")
        if self.exposure is not None:
            require_range("exposure", self.exposure)


def require_range(key: str, given: Any) -> None:
    """Refuse what is neither a finite number nor (lowest, highest)."""
    ends = given if isinstance(given, (list, tuple)) else (given, given)
    if len(ends) != 2 or not all(isinstance(end, Real) and math.isfinite(end) for end in ends) or ends[0] > ends[1]:
        raise ValueError(f"{key} must be (lowest, highest) in stops or one number, got {given!r:.100}")


class SettingSampler:
    """Draws camera settings of one ISP.

    Args:
        draw: says how.
        isp: the camera.
        baked: its tables, which choose settings for pictures.

    Raises:
        ValueError: if light or tone are given for an ISP that was fitted to frames, or are unknown.
    """

    def __init__(self, draw: Draw, isp: DictionaryISP, baked: BakedISP) -> None:
        published = bool(isp.config.cameras)
        if (draw.light, draw.tone) != (None, None) and not (published and draw.sampling in ("convex", "independent")):
            whose = f"with sampling {draw.sampling!r}" if published else "of a fitted ISP"
            raise ValueError(f"light and tone are drawn for published cameras, as in universal, not {whose}; omit them")
        self.draw, self.isp, self.baked = draw, isp, baked
        usual = EXPOSURE if published else (0.0, 0.0)
        given = (draw.exposure, draw.exposure) if isinstance(draw.exposure, (int, float)) else draw.exposure
        self.exposure: tuple[float, float] = usual if given is None else given
        self._cameras = isp.camera_sampler(draw.sampling == "convex", draw.light)
        self._tone = None if draw.tone is None else tone_weights(isp, draw.tone)

    def sample(self, srgb: Tensor, generator: torch.Generator) -> ISPParams:
        """Draw the settings of ``srgb`` ``(B, 3, H, W)``, exposure included, from a generator on the CPU."""
        setting = self._sample(srgb, generator)
        if not any(self.exposure):
            return setting
        low, high = self.exposure
        stops = low + (high - low) * torch.rand(len(srgb), 1, generator=generator, dtype=torch.float32)
        return setting._replace(gains=setting.gains * torch.exp2(-stops).to(setting.gains))

    def _sample(self, srgb: Tensor, generator: torch.Generator) -> ISPParams:
        if self.draw.sampling in ("convex", "independent"):
            if self._cameras is None:
                return self.isp.draw_setting(len(srgb), generator)
            setting = self._cameras.sample(len(srgb), generator, srgb.device)
            if self._tone is None:
                return setting
            return setting._replace(tone_weights=self._tone.to(setting.tone_weights).expand_as(setting.tone_weights))
        chosen = self.baked.choose(srgb)
        if self.draw.sampling == "chosen":
            return chosen
        weights = [w for w in (chosen.colour_weights, chosen.gain_weights, chosen.tone_weights) if w.shape[1]]
        return self.isp.params_from_weights(*(perturb(w, self.draw.strength, generator) for w in weights))

    def __repr__(self) -> str:
        """The camera, the sampling, the light and the exposure in a line."""
        known = self.isp.config.cameras
        camera = (
            self.isp.info["cameras"][0]
            if known == 1
            else f"mixtures of {known} published"
            if known
            else "the fitted one"
        )
        light = "" if self.draw.light is None else f", light {self.draw.light}"
        return f"{camera}, {self.draw.sampling}{light}, exposure {self.exposure[0]:g} to {self.exposure[1]:g} stops"


def tone_weights(isp: DictionaryISP, name: str) -> Tensor:
    """Weights ``(K,)`` that select one of the ISP's K tone curves; ValueError if it has none of this name."""
    names = list(isp.info.get("tones", []))
    if isp.tone is None or name not in names:
        listed = ", ".join(names) or "none by name: its tone is learned"
        raise ValueError(f"tone {name!r} is no curve of this ISP, which has {listed}{suggest(name, names)}")
    return torch.eye(len(names))[names.index(name)]
