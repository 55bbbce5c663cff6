r"""Denoising of cameras' frames in memory.

    x = f(y, shot_var max(y, 0) + read_var)

This is done on the mosaic as the sensor gave it, before any gain map. The result has the source's levels, colour, lens
corrections, orientation and EXIF; it differs by noise and by errors of the sensor
(:mod:`rawaug.denoising.corrections`). Its noise profile is removed along with the noise, so that a RAW developer does
not smooth once more. With a strength s below 1 the result is y + s (x - y): (1 - s)^2 of the noise's variance is left,
and the noise profile says so. A network that also demosaics gives camera RGB.

A monochrome frame is denoised as the mosaic of a grey scene, which it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

from torch import Tensor

from rawaug.bayer import CFA
from rawaug.denoising.base import Levels
from rawaug.denoising.corrections import Corrected, Correction, Corrections
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.levels import Noise, as_json, find_levels, load_noise
from rawaug.files import require_output
from rawaug.io import RawFrame, read_raw, write_dng
from rawaug.io.dng import LINEAR_WHITE, cell_of_planes
from rawaug.io.raw import MONOCHROME

OTHER_PATTERNS = "rawaug-xtrans"
"""X-Trans and Quad-Bayer frames are denoised by this if no denoiser is named."""
DNG_ADVICE = "the output is a DNG; give a name ending in .dng"


@dataclass(frozen=True)
class DenoisedFrame:
    """A denoised frame, and what was done to it.

    Attributes:
        frame: the frame with the denoised mosaic, and the noise that is left.
        rgb: linear camera RGB ``(3, H, W)``, if the denoiser demosaics.
        levels: (shot_var, read_var) that the denoiser was given; None if it needs none.
        noise_source: where the levels come from.
        below_zero: the share of sites whose result was below the digital number 0.
        corrected: errors of the sensor that were taken out.
    """

    frame: RawFrame
    rgb: Tensor | None
    levels: Levels | None
    noise_source: str
    below_zero: float
    corrected: Corrected


class FrameDenoiser:
    """Denoises frames of any camera, finding the noise levels of each.

    Args:
        denoiser: whatever :meth:`rawaug.RawDenoiser.of` takes; None for the shipped one of each frame's pattern.
        noise: where the noise levels come from, see :data:`rawaug.denoising.levels.Noise`.
        corrections: which errors of the sensor are taken out.
        device: where a network runs: auto, cpu, cuda, ...
        changes: attributes of the denoiser, such as ``strength`` and ``views``.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if there is no such denoiser.
    """

    def __init__(
        self,
        denoiser: Any = None,
        noise: Noise = "auto",
        corrections: Corrections | None = None,
        device: str = "auto",
        **changes: Any,
    ) -> None:
        self._by_pattern = denoiser is None
        self._options: dict[str, Any] = {"device": device, "precision": "auto", **changes}
        self.usual: RawDenoiser = denoiser
        if not isinstance(denoiser, RawDenoiser) or changes:
            spec = RawDenoiser.default if denoiser is None else denoiser
            self.usual = RawDenoiser.of(spec, **self._options)

        self.noise = load_noise(noise, self.usual)
        self.corrections = corrections or Corrections()

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that the results depend on, as JSON."""
        settings = dict(self.usual.settings)
        if settings:
            settings["self_ensemble"] = self.usual.views > 1
        settings["noise"] = as_json(self.noise)

        if self.corrections.greens != "auto":
            settings["greens"] = self.corrections.greens
        if self.usual.strength != 1.0:
            settings["strength"] = self.usual.strength
        return settings

    @cached_property
    def _of_other_patterns(self) -> RawDenoiser:
        return RawDenoiser.of(OTHER_PATTERNS, **self._options)

    def denoiser_of(self, frame: RawFrame) -> RawDenoiser:
        """Find the denoiser of a frame."""
        if self._by_pattern and frame.cfa not in (*CFA.__members__, MONOCHROME):
            return self._of_other_patterns
        return self.usual

    def __call__(self, frame: RawFrame, noise: Noise | None = None) -> DenoisedFrame:
        """Denoise a frame, with other noise levels if ``noise`` is given.

        Raises:
            ValueError: if the noise levels are unknown, or the denoiser is not for this pattern.
        """
        denoiser = self.denoiser_of(frame)
        if denoiser.strength > 0:
            frame, corrected = self.corrections(frame)
        else:
            corrected = Corrected()

        mosaic = _as_mosaic(frame, denoiser)

        levels, noise_source = None, "not needed"
        if denoiser.reads_levels:
            shot_var, read_var, noise_source = find_levels(mosaic, self.noise if noise is None else noise)
            levels = shot_var, read_var

        image = denoiser.frame(mosaic, levels)
        if denoiser.demosaics:
            below_zero = (image < -0.5 / LINEAR_WHITE).float().mean().item()
            return DenoisedFrame(frame, image, levels, noise_source, below_zero, corrected)

        below_zero = _clip_below_zero(image, frame)
        rest = _rest(levels or frame.noise_profile, denoiser.strength)
        frame = replace(frame, mosaic=image, noise_profile=rest)
        return DenoisedFrame(frame, None, levels, noise_source, below_zero, corrected)


def _as_mosaic(frame: RawFrame, denoiser: RawDenoiser) -> RawFrame:
    """Make of a frame what a denoiser takes: a monochrome one is the mosaic of a grey scene."""
    if frame.cfa != MONOCHROME:
        return frame
    denoiser.require_grey(frame.name)
    return replace(frame, cfa=CFA.RGGB)


def _rest(levels: Levels | None, strength: float) -> Levels | None:
    """Compute the levels of the noise that a strength leaves."""
    rest = (1 - strength) ** 2
    if levels is None or rest == 0:
        return None
    return rest * levels[0], rest * levels[1]


def _clip_below_zero(mosaic: Tensor, frame: RawFrame) -> float:
    """Clip, in place, what a digital number cannot hold; return the share of clipped sites."""
    if frame.floating:
        return 0.0

    cell = cell_of_planes(frame.cfa)
    size = len(cell)

    below = 0
    for i, j in product(range(size), repeat=2):
        plane = mosaic[0, i::size, j::size]
        black = frame.black[cell[i, j]]
        step = 1.0 / (frame.white - black)
        lowest = -black / (frame.white - black)
        below += int((plane < lowest - 0.5 * step).sum())
        plane.clamp_(min=lowest)

    return below / mosaic.numel()


def denoise(
    source: str | Path | RawFrame,
    out: str | Path | None = None,
    *,
    denoiser: Any = None,
    noise: Noise = "auto",
    strength: float = 1.0,
    self_ensemble: bool = False,
    greens: Correction = "auto",
    device: str = "auto",
    overwrite: bool = False,
) -> RawFrame:
    """Denoise a RAW frame in memory, as ``rawaug denoise`` does.

    Args:
        source: a RAW file of any kind that :func:`rawaug.io.read_raw` reads, monochrome ones too, or a frame.
        out: a DNG to write as well; None writes none.
        denoiser: whatever :meth:`rawaug.RawDenoiser.of` takes: a shipped name, a file, a network, a function, ...; by
            default the shipped one for the frame's pattern.
        noise: where the noise levels come from, see :data:`rawaug.denoising.levels.Noise`.
        strength: 1 removes the noise, 0.7 leaves 30% of it, 0 changes nothing.
        self_ensemble: average eight views, at eight times the cost.
        greens: ``"keep"`` leaves greens that differ; see :class:`rawaug.denoising.corrections.Corrections`.
        device: where a network runs: auto, cpu, cuda, cuda:1, mps.
        overwrite: replace ``out`` if it exists.

    Returns:
        The frame with a denoised mosaic, float32 ``(1, H, W)``, black 0 and white 1; its ``noise_profile`` says what
        noise is left.

    Raises:
        FileNotFoundError, OSError: if a file is missing or cannot be read or written.
        ValueError: if the source has no mosaic, its noise is unknown, there is no such denoiser, or the denoiser also
            demosaics; :meth:`rawaug.RawDenoiser.frame` gives its colours.

    Example:
        >>> frame = rawaug.denoise("in.dng", "out.dng", denoiser="rawaug-base")  # doctest: +SKIP
    """
    views = 8 if self_ensemble else 1
    denoise_frame = FrameDenoiser(denoiser, noise, Corrections(greens), device, strength=strength, views=views)
    denoise_frame.usual.require_mosaic()
    if out is not None:
        inputs = [] if isinstance(source, RawFrame) else [source]
        require_output(out, overwrite, (".dng",), inputs, DNG_ADVICE)

    if isinstance(source, RawFrame):
        frame, file = source, None
    else:
        frame, file = read_raw(source, monochrome=True), source

    denoised = denoise_frame(frame).frame
    if out is not None:
        write_dng(out, denoised, file)
    return denoised
