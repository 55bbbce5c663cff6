r"""The camera settings that pictures are given: cameras, lights, tone curves and exposures, drawn for each picture.

A setting is a colour matrix C, gains g and a tone curve T. It comes from the hulls of the dictionaries' atoms or, for
an ISP of published cameras, is one camera in one light (:mod:`rawaug.isp.dictionary`). An exposure of e stops divides
the gains of the forward direction by :math:`2^e`.

Lens, optical low-pass filter and pixel aperture blur the light before the mosaic, while pictures for the screen have
been scaled down and sharpened. Light is therefore blurred by a Gaussian (:mod:`rawaug.kernels.reference`). Its
modulation is half at a frequency of :math:`\sqrt{\ln 2 / 2} / (\pi \sigma) = 0.187 / \sigma` cycles a pixel (MTF50).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from rawaug.camera.own import own_cameras
from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import perturb
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import EXPOSURE, camera_sampler, draw_setting
from rawaug.kernels.runtime import one_thread
from rawaug.registry import suggest
from rawaug.seeding import Generators, draw_rows

_FAR = sys.float_info.max
"""The largest finite number."""

Sampling = Literal["convex", "independent", "perturb", "chosen"]


@dataclass(frozen=True)
class Draw:
    """How the camera setting of each picture is drawn.

    Args:
        sampling: ``convex`` draws without looking at the picture: a camera in a light and a mixture of tone curves
            if the ISP knows published cameras, as ``universal`` does, and mixtures of the atoms for a fitted ISP.
            ``independent`` does the same with the gains of another camera in another light, to measure the value of
            consistency. ``perturb`` adds Gaussian noise to the weights that the ISP chooses for the picture;
            ``chosen`` takes them as they are. The choice is made on the whole picture, whose crops share it; where only
            a crop is at hand, the ISP's constants serve.
        strength: standard deviation of the noise that ``perturb`` adds to the weights. 0.03 moves the gains of
            ``phones`` by a tenth of a stop, where what it chooses differs by half a stop from picture to picture.
        exposure: lowest and highest exposure of the RAW in stops, or a single one. The default is the range of the
            frames for a fitted ISP, and -0.5 to 1 for published cameras, whose headroom above white is not known. To
            train for cameras other than the fitted one, use -1.5 to 0.
        light: colour temperature in kelvin of the light that published cameras are drawn in, or one of
            :data:`rawaug.camera.lights.LAMPS` by name, such as ``LED-B3``. Any light by default.
        tone: one tone curve of an ISP of published cameras, by name (``rawaug info`` lists them), instead of mixtures.
        blur: lowest and highest standard deviation, or a single one, of the Gaussian that blurs linear light before the
            mosaic, in pixels of the mosaic, from 0 to 1. Pictures for the screen are sharper, pixel by pixel, than RAW
            of a lens and an optical low-pass filter. 0 leaves them as they are. The default is what was measured when
            an ISP was fitted or what a :class:`rawaug.Camera` states, else 0; :data:`rawaug.camera.softness.PUBLISHED`
            is a range for cameras of which nothing is known.

    Example:
        An exposure of +1 makes the RAW brighter by a stop.

        >>> import rawaug
        >>> grey = torch.full((3, 16, 16), 0.4)
        >>> means = []
        >>> for exposure in (0.0, 1.0):
        ...     augment = rawaug.RawAugment.from_pretrained("universal", draw=rawaug.Draw(exposure=exposure))
        ...     means.append(augment(grey, torch.Generator().manual_seed(0)).clean.mean())
        >>> round(float(means[1] / means[0]), 3)
        2.0

    Raises:
        ValueError: if the sampling is unknown, or the strength, the exposure or the blur is out of range.
    """

    sampling: Sampling = "convex"
    strength: float = 0.03
    exposure: tuple[float, float] | float | None = None
    light: float | str | None = None
    tone: str | None = None
    blur: tuple[float, float] | float | None = None

    def __post_init__(self) -> None:
        if self.sampling not in get_args(Sampling):
            raise ValueError(f"sampling {self.sampling!r} is unknown; use one of {', '.join(get_args(Sampling))}")
        if not self.strength >= 0:
            raise ValueError(f"strength must be at least 0, got {self.strength}")
        if self.exposure is not None:
            _require_range("exposure", self.exposure, "stops")
        if self.blur is not None:
            _require_range("blur", self.blur, "pixels", limits=(0.0, 1.0))

    @property
    def exposure_range(self) -> tuple[float, float] | None:
        """The lowest and highest exposure in stops; None means the range of the ISP."""
        if isinstance(self.exposure, (int, float)):
            return self.exposure, self.exposure
        return self.exposure

    @property
    def blur_range(self) -> tuple[float, float] | None:
        """The least and the largest standard deviation of the blur, in pixels; None means those of the ISP."""
        if isinstance(self.blur, (int, float)):
            return self.blur, self.blur
        return self.blur


def _require_range(key: str, value: Any, unit: str, limits: tuple[float, float] = (-_FAR, _FAR)) -> None:
    """Refuse anything that is neither a finite number within limits nor (lowest, highest) of such numbers."""
    ends = value if isinstance(value, (list, tuple)) else (value, value)

    is_range = len(ends) == 2
    for end in ends:
        is_range = is_range and isinstance(end, Real) and limits[0] <= float(end) <= limits[1]
    if is_range and ends[0] <= ends[1]:
        return

    within = ""
    if limits[1] < _FAR:
        within = f" within {limits[0]:g} to {limits[1]:g}"
    raise ValueError(f"{key} must be (lowest, highest) in {unit} or one number{within}, got {value!r:.100}")


class SettingSampler:
    """Draws camera settings of one ISP.

    Args:
        draw: how to draw.
        isp: the camera, which chooses settings for pictures, where they are.
        baked: the same camera, from whose copy on the host settings are drawn.

    Raises:
        ValueError: if light or tone is given for an ISP that was fitted to frames, or is unknown.
    """

    def __init__(self, draw: Draw, isp: DictionaryISP, baked: BakedISP) -> None:
        has_cameras = bool(isp.config.cameras)
        if draw.light is not None or draw.tone is not None:
            rule = "light and tone are drawn for published cameras, as in universal"
            if not has_cameras:
                raise ValueError(f"{rule}, not of a fitted ISP; omit them")
            if draw.sampling not in ("convex", "independent"):
                raise ValueError(f"{rule}, not with sampling {draw.sampling!r}; omit them")
        self.draw, self.isp, self.host = draw, isp, baked.host

        usual = EXPOSURE if has_cameras else (0.0, 0.0)
        self.exposure: tuple[float, float] = draw.exposure_range or usual
        self.blur: tuple[float, float] = draw.blur_range or isp_blur(isp)
        self._cameras = camera_sampler(isp, draw.sampling == "convex", draw.light)
        self._tone = None if draw.tone is None else tone_weights(isp, draw.tone)

    @property
    def looks(self) -> bool:
        """Whether the draws depend on what is in the pictures."""
        return self.draw.sampling in ("perturb", "chosen") and self.isp.config.encoders

    @property
    def constants(self) -> ISPParams:
        """The setting ``(1, ...)`` of an unknown picture."""
        return self.host.typical_setting()

    def choose(self, srgb: Tensor) -> ISPParams:
        """Choose the settings of whole pictures ``(B, 3, H, W)``, before any draw, and wait for them."""
        if not self.isp.config.encoders:
            return self.host.choose(srgb)
        with torch.no_grad(), one_thread():  # the same choice in every process
            return self.isp.choose(srgb).map(Tensor.cpu)

    def sample(self, srgb: Tensor, generator: Generators, chosen: ISPParams | None = None) -> ISPParams:
        """Draw the settings of pictures, exposure included.

        Args:
            srgb: ``(B, 3, H, W)``.
            generator: a generator on the CPU, or one for each picture if the sampler :attr:`takes_rows`.
            chosen: settings of B pictures, or a single one for all, to use where the sampling looks at the pictures;
                by default those of :meth:`choose`.
        """
        setting = self._sample_at_exposure_0(srgb, generator, chosen)
        if not any(self.exposure):
            return setting

        low, high = self.exposure
        uniform = draw_rows(generator, torch.rand, len(srgb), 1)
        stops = low + (high - low) * uniform
        return setting._replace(gains=setting.gains * torch.exp2(-stops).to(setting.gains))

    def sample_blur(self, batch: int, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw ``blur`` ``(batch,)``, standard deviations in pixels; nothing if pictures are left as they are."""
        low, high = self.blur
        if not high:
            return {}
        return {"blur": low + (high - low) * torch.rand(batch, generator=generator, dtype=torch.float32)}

    @property
    def takes_rows(self) -> bool:
        """Whether settings may be drawn from a generator for each picture, with the bits of each alone."""
        return self._cameras is not None and self.draw.sampling in ("convex", "independent")

    def _sample_at_exposure_0(self, srgb: Tensor, generator: Generators, chosen: ISPParams | None) -> ISPParams:
        if self.draw.sampling in ("perturb", "chosen"):
            if chosen is None:
                chosen = self.choose(srgb)
            setting = chosen.map(lambda tensor: tensor.expand(len(srgb), *tensor.shape[1:]))
            if self.draw.sampling == "perturb":
                setting = self._perturb(setting, generator)
            return setting

        setting = draw_setting(self.host, len(srgb), generator, self._cameras)
        if self._tone is None:
            return setting
        return setting._replace(tone_weights=self._tone.to(setting.tone_weights).expand_as(setting.tone_weights))

    def _perturb(self, setting: ISPParams, generator: Generators) -> ISPParams:
        weights = []
        for atoms in (setting.colour_weights, setting.gain_weights, setting.tone_weights):
            if atoms.shape[1]:
                weights.append(perturb(atoms, self.draw.strength, generator))
        return self.host.params_from_weights(*weights)

    def __repr__(self) -> str:
        """Describe the camera, the sampling, the light, the exposure and the blur in a line."""
        count = self.isp.config.cameras
        if count == 1:
            line = str(self.isp.info["cameras"][0])
        elif count:
            line = f"mixtures of {count} published"
        else:
            line = "the fitted one"

        line += f", {self.draw.sampling}"
        if self.draw.light is not None:
            line += f", light {self.draw.light}"
        line += f", exposure {self.exposure[0]:g} to {self.exposure[1]:g} stops"

        low, high = self.blur
        if high:
            line += f", blur {low:g} to {high:g} pixels"
        return line


def isp_blur(isp: DictionaryISP) -> tuple[float, float]:
    """The blur of an ISP in pixels, lowest and highest: as its fit has measured or its cameras state, else none."""
    if "blur" in isp.info:
        return isp.info["blur"], isp.info["blur"]

    ranges = [camera.blur_range for camera in own_cameras(isp.info)] or [(0.0, 0.0)]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def tone_weights(isp: DictionaryISP, name: str) -> Tensor:
    """Weights ``(K,)`` that select one of the ISP's K tone curves; ValueError if it has none of this name."""
    names = list(isp.info.get("tones", []))
    if isp.tone is None or name not in names:
        listed = ", ".join(names) or "none by name: its tone is learned"
        raise ValueError(f"tone {name!r} is no curve of this ISP, which has {listed}{suggest(name, names)}")
    return torch.eye(len(names))[names.index(name)]
