"""The stages of a fit, in order.

1. Curve. ``x2 = (x + a (1 - x))^gamma`` (sRGB, BT.709 and plain gamma have this form), each frame's matrix ``M_f`` and,
   if there is fall-off, the Gaussian mask: first least squares, then gradient descent on these few numbers.
2. Tone. The tone network starts as that curve and is refined together with all of stage 1; or the curve itself is
   bent (:mod:`rawaug.isp.tone`). With ``tone="auto"`` both are compared on frames left out, given their as-shot gains.
3. Atoms. The frames' matrices and gains become the dictionaries, with the constant weights that serve best.
4. Encoders, if frames that were left out of stages 1 to 3 as well show that they help.
5. Forward. The forward networks, given the reverse pass: l2 on sRGB and on every intermediate image.
6. Joint. With many frames, everything at once, kept as far as frames left out of it gain.
7. Errors. How far off the chosen and the as-shot gains are, so that they can be fused (:mod:`rawaug.isp.fusion`).

Model and losses are those of Conde et al., AAAI 2022; a global and a per-frame part make the fit work with a handful of
frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug.camera.own import Camera
from rawaug.files import digest
from rawaug.isp import functional, stages
from rawaug.isp.config import POINTWISE_STAGES, SMALL, ISPConfig
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.curve import StartCurve, start_forward, trained_tensors
from rawaug.isp.fit.descent import (
    Descent,
    adam,
    cycle_error,
    reading_error,
    train_encoders,
    train_jointly,
    with_better_tone,
)
from rawaug.isp.fit.samples import FitFrames, FramePair, FrameSummary, PixelSamples, sample_pixels
from rawaug.isp.fit.start import (
    FEWEST_PIXELS,
    REACH_ATOMS,
    FrameColour,
    Tie,
    fit_fall_off,
    least_squares,
    measure_gain_errors,
    set_dictionaries,
)
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading
from rawaug.isp.tone import to_linear
from rawaug.kernels.runtime import one_thread
from rawaug.progress import progress as progress_of
from rawaug.seeding import derive_seed
from rawaug.version import __version__

_STANDARD_CURVES = ((2.2, 0.0), (2.4, 0.055 / 1.055), (1.0 / 0.45, 0.099 / 1.099))
"""The gamma and toe a of a plain gamma camera, of sRGB (IEC 61966-2-1) and of ITU-R BT.709."""
CURVE_STEPS, _CURVE_RATE = 150, 2e-2
"""Default number of steps, and rate, of stage 1."""
_DIMMEST = 0.01
"""Minimum share of a corner's light that a mask must take to be tried."""
_SHADING_PAYS = 0.5
"""Maximum ratio of the squared errors with and without a mask for keeping the mask."""
FRAMES_A_STEP = 16
"""Maximum number of frames in a step."""
_START_STEPS, _START_RATE = 1000, 3e-3
"""Number of steps, and rate, of the descent that brings the tone near that of the ISP that a fit starts from."""
_MOST_LEFT_OUT = 0.1
"""Share of the frames that may be left out because they have too few unclipped pixels."""


def fit_isp(
    pairs: Iterable[FramePair],
    config: FitConfig | None = None,
    progress: bool = True,
    state: str | Path | None = None,
    report: Callable[[DictionaryISP], str] | None = None,
    camera: Camera | None = None,
    watched: Iterable[FramePair] | None = None,
) -> DictionaryISP:
    """Fit a dictionary ISP to pairs of RAW and sRGB.

    Args:
        pairs: one or more frames, from one or several cameras; they are read once.
        config: settings; see :class:`FitConfig`.
        progress: show progress bars.
        state: file with the state of the fit, to resume it; removed at the end.
        report: function that gets the ISP in its current state, every 50 steps of stage 2; its text goes to the
            progress bar.
        camera: the camera's figures, from which the frames' matrices start.
        watched: frames on which end-to-end training is watched; by default a tenth of the pairs, which is held out.

    Raises:
        ValueError: if there is no pair, more than a tenth of the frames have too few unclipped pixels (fewer are left
            out, with a note), or ``state`` cannot be read.
    """
    config = (config or FitConfig()).settled()
    reading = progress_of(pairs, label="read", unit="frame", shown=progress)
    frames = sample_pixels(reading, config.pixels, config.seed, config.noisy)
    frames = _with_enough_pixels(frames)
    held_out: FitFrames | None = None
    if watched is not None:
        held_out = sample_pixels(watched, config.pixels, config.seed, config.noisy)
    path = None if state is None else Path(state)
    descent = Descent(path, _key(config, frames, camera), config.seed, progress)

    def refit(some: FitFrames, part: str, config: FitConfig) -> DictionaryISP:
        return _Fit(some, config, descent, part, camera).fit_reverse()

    with one_thread():
        config, gain = with_better_tone(frames, config, refit)
        fit = _Fit(frames, config, descent, camera=camera)
        fit.fit_reverse(report)
        train_encoders(fit.isp, frames, config, descent, refit)
        fit.fit_forward()
        held_out = train_jointly(fit.isp, frames, config, descent, held_out)
        measure_gain_errors(fit.isp, held_out)

    descent.finish()
    info = fit.isp.info
    if gain is not None:
        info["curve_gain_db"] = round(gain, 2)
    info["registered"] = sum(shot.registered for shot in frames.shots)
    info["frames"] = [shot.name for shot in frames.shots]
    info["steps"] = config.steps
    info["seed"] = config.seed
    return fit.isp.eval()


def _with_enough_pixels(frames: FitFrames) -> FitFrames:
    """Leave out frames with too few pixels that are not clipped, such as black ones, and report them.

    Raises:
        ValueError: if they are more than a tenth of the frames.
    """
    counts = frames.pixels.known[:, :, 0].sum(2).amin(1)
    good: list[int] = []
    bad: list[int] = []
    for k, count in enumerate(counts.tolist()):
        if count < FEWEST_PIXELS:
            bad.append(k)
        else:
            good.append(k)

    if not bad:
        return frames

    first = frames.shots[bad[0]].name
    if len(bad) > _MOST_LEFT_OUT * len(counts):
        raise ValueError(f"{first}: too few unclipped pixels to fit; use a better exposed frame or more pixels")

    print(f"note: {len(bad)} of {len(counts)} frames have too few unclipped pixels to fit, such as {first}: left out")
    return frames.some(good)


def _key(config: FitConfig, frames: FitFrames, camera: Camera | None) -> str:
    """Hash the settings and pixels that identify a kept state."""
    facts: list[Any] = [__version__, config]
    facts.append([(shot.name, shot.camera, shot.white_balance) for shot in frames.shots])
    if camera is not None:
        facts.append(camera)

    settings = repr(tuple(facts)).encode()
    return digest(settings, frames.pixels.srgb.numpy().tobytes(), frames.pixels.target.numpy().tobytes())


def _new_isp(shots: Sequence[FrameSummary], config: FitConfig) -> DictionaryISP:
    """Make an ISP of the size that these frames need, drawn from the seed."""
    patterns = {shot.cfa for shot in shots}
    count = min(config.most_atoms, len(shots))
    more = REACH_ATOMS if config.reach > 1.0 else 0

    settings: dict[str, Any] = {
        "colour_atoms": count,
        "gain_atoms": min(config.most_atoms, count + more),
        "attention": config.attention,
    }
    if config.tone == "curve":
        settings |= {"stages": ("curve", *POINTWISE_STAGES[2:]), "tone_atoms": 1}
    if config.size == "small":
        settings["encoder_widths"] = SMALL.encoder_widths
    if len(patterns) == 1:
        settings["cfa"] = str(patterns.pop())
    settings |= config.isp

    fewest, highest = settings["colour_atoms"], settings["colour_atoms"] + more
    if not fewest <= settings["gain_atoms"] <= highest:
        raise ValueError(f"isp: gain_atoms is {settings['gain_atoms']}, but these frames need {fewest} to {highest}")
    return DictionaryISP(ISPConfig(**settings), derive_seed(config.seed, "isp"))


class _Fit:
    """The ISP being fitted, with every frame's own colour; ``part`` ends the names of its stages."""

    def __init__(
        self, frames: FitFrames, config: FitConfig, descent: Descent, part: str = "", camera: Camera | None = None
    ) -> None:
        self.samples, self.shots = frames
        self.known_matrix: Tensor | None = None
        if camera is not None:
            self.known_matrix = torch.stack([camera.matrix_for(shot.white_balance) for shot in self.shots])

        self.config, self.descent, self.part = config, descent, part
        self.isp = _new_isp(self.shots, config)
        self.curve = StartCurve(self.isp)
        self.tie = Tie(self.shots)
        self.colour = self._start()

    @torch.no_grad()
    def _start(self) -> FrameColour:
        """Solve by least squares under the curve of the standard that fits best."""
        tried = []
        for curve in _STANDARD_CURVES:
            self.curve.set(*curve)
            self.colour = FrameColour.from_product(self._least_squares())
            tried.append((self._error(), curve, self.colour))

        _, curve, colour = min(tried, key=lambda one: one[0])
        self.curve.set(*curve)
        return colour

    def _least_squares(self) -> Tensor:
        return least_squares(self._apply_curve(self.samples), self.samples, self.known_matrix)

    def fit_reverse(self, report: Callable[[DictionaryISP], str] | None = None) -> DictionaryISP:
        """Run stages 1 to 3, which fit the reverse pass, without encoders."""
        self.fit_curve()
        self.fit_tone(report)
        self.set_atoms(self.isp)
        return self.isp

    # -- stage 1 ----------------------------------------------------------------------------------------------------

    def fit_curve(self) -> None:
        """Run stage 1 without the mask and, if the readings fall off towards the corners, with it as well."""
        shading = self.isp.find(LensShading)
        mode = self.config.shading if shading else "off"
        if mode != "on":
            self._descend_on_curve("curve", with_mask=False)
        if shading is None:
            return
        without_shading = tuple(name for name in self.isp.config.stages if name != shading.name)
        if mode == "off":
            self.isp.configure(stages=without_shading)
            return

        mean, precision = fit_fall_off(self._apply_curve(self.samples), self.samples, self.colour.product())
        if mode == "auto" and not _darkens_corners(mean, precision):
            self.isp.configure(stages=without_shading)
            return

        error = self._error()
        before = {}
        for name, tensor in self._few_numbers(with_mask=False).items():
            before[name] = tensor.detach().clone()

        shading.mask.set(mean, precision)
        self._descend_on_curve("curve and shading")
        if mode == "auto" and self._error() > _SHADING_PAYS * error:
            self.isp.configure(stages=without_shading)
            for name, tensor in self._few_numbers().items():
                tensor.data.copy_(before[name])

    @torch.no_grad()
    def _error(self) -> float:
        predicted = functional.correct_colour(self._apply_curve(self.samples), self.colour.product())
        return float(reading_error(predicted, self.samples))

    def _apply_curve(self, part: PixelSamples) -> Tensor:
        """Compute x2 by the curve, times the mask, which a frame's matrix takes to RAW."""
        return self.curve.apply(part.srgb, part.coordinates)

    def _descend_on_curve(self, stage: str, with_mask: bool = True) -> None:
        tensors = self._few_numbers(with_mask)

        def loss(generator: torch.Generator) -> Tensor:
            frames, part = self._draw(generator)
            predicted = functional.correct_colour(self._apply_curve(part), self.colour.pick(frames).product())
            return reading_error(predicted, part) + self.tie(self.colour)

        steps = CURVE_STEPS if self.config.curve_steps is None else self.config.curve_steps
        self.descent.run(stage + self.part, loss, tensors, steps, _CURVE_RATE)

    # -- stage 2 ----------------------------------------------------------------------------------------------------

    def fit_tone(self, report: Callable[[DictionaryISP], str] | None) -> None:
        """Run stage 2, the tone and each frame's colour; ``report`` gets the ISP as it would be now."""
        self.curve.start_networks()
        if self.config.start is not None:
            self._start_from(DictionaryISP.from_pretrained(self.config.start))

        tensors = self._colours() | trained_tensors(self.isp, forward=False)

        def loss(generator: torch.Generator) -> Tensor:
            frames, part = self._draw(generator)
            predicted = self.isp.reverse_pixels(part.srgb, self.colour.pick(frames).params(), part.coordinates)
            return reading_error(predicted, part) + self.tie(self.colour)

        def status() -> str:
            if report is None:
                return ""

            isp = deepcopy(self.isp)  # as it would be if this stage ended now
            self.set_atoms(isp)
            return report(isp.eval())

        name = f"sRGB to RAW{self.part}"
        self.descent.run(name, loss, tensors, self.config.steps, self.config.learning_rate, status)

    def _start_from(self, other: DictionaryISP) -> None:
        """Start the tone from that of another ISP, or the best of its curves, if that improves the frames."""
        greys = torch.linspace(0.0, 1.0, 256).expand(1, 3, 1, -1)
        colours = torch.cat([greys, stages.node_colours(9).flatten(2)[:, :, None]], dim=3)
        tensors = list(trained_tensors(self.isp, forward=False, up_to=2).values())

        before = [tensor.detach().clone() for tensor in tensors]
        colour = self.colour
        error, _ = self._tone_error(self.isp.linear)
        best, target = self._best_tone(other, colours)
        if best >= error:
            return

        for tensor in tensors:
            tensor.requires_grad_()

        descent = adam(
            tensors,
            _START_RATE,
            lambda step: ((self.isp.linear(colours) - target) ** 2 / (target + 0.01)).mean(),
            lambda step: step / _START_STEPS,
        )
        for _ in descent:
            pass

        for tensor in tensors:
            tensor.requires_grad_(isinstance(tensor, torch.nn.Parameter))

        started, self.colour = self._tone_error(self.isp.linear)
        if started >= error:
            self.colour = colour
            for tensor, old in zip(tensors, before, strict=True):
                tensor.data.copy_(old)

    @torch.no_grad()
    def _best_tone(self, other: DictionaryISP, colours: Tensor) -> tuple[float, Tensor]:
        """Compute the least error under another ISP's tone, or one of its curves, and x2 of ``colours`` by it."""
        curves: list[Callable[[Tensor], Tensor]] = [other.linear]
        if other.tone is not None:
            curves = [partial(_apply_table, table) for table in other.tone.curves]

        errors = [self._tone_error(curve)[0] for curve in curves]
        best = errors.index(min(errors))
        return errors[best], curves[best](colours)

    @torch.no_grad()
    def _tone_error(self, linear: Callable[[Tensor], Tensor]) -> tuple[float, FrameColour]:
        """Compute the error under a tone with each frame's best colour, and that colour."""
        shading = self.isp.find(LensShading)
        x = linear(self.samples.srgb)
        if shading is not None:
            x = x * shading.mask(self.samples.coordinates)

        colour = FrameColour.from_product(least_squares(x, self.samples, self.known_matrix))
        return float(reading_error(functional.correct_colour(x, colour.product()), self.samples)), colour

    def _few_numbers(self, with_mask: bool = True) -> dict[str, Tensor]:
        return self.curve.numbers(with_mask) | self._colours()

    def _colours(self) -> dict[str, Tensor]:
        return {"log_scale": self.colour.log_scale, "matrix": self.colour.matrix}

    def _draw(self, generator: torch.Generator) -> tuple[Tensor | slice, PixelSamples]:
        """Draw the frames of a step (all, if there are few) and their pixels."""
        count, pixels = self.samples.srgb.shape[0], self.samples.srgb.shape[-1]
        frames: Tensor | slice = slice(None)
        if count > FRAMES_A_STEP:
            frames = torch.randperm(count, generator=generator)[:FRAMES_A_STEP]

        index = torch.randint(pixels, (min(self.config.batch, pixels),), generator=generator)
        return frames, self.samples.pick(index, frames)

    # -- stage 3 ----------------------------------------------------------------------------------------------------

    def set_atoms(self, isp: DictionaryISP) -> None:
        """Run stage 3: make the frames' colours the atoms of ``isp``."""
        set_dictionaries(isp, self.colour, self.samples, self.shots, self.config)

    # -- stage 5 ----------------------------------------------------------------------------------------------------

    def fit_forward(self) -> None:
        """Run stage 5: fit the forward networks to the reverse pass."""
        isp = self.isp
        start_forward(isp)
        tensors = trained_tensors(isp, forward=True)

        def loss(generator: torch.Generator) -> Tensor:
            frames, part = self._draw(generator)
            params = self.colour.pick(frames).params()
            back: dict[str, Tensor] = {}
            with torch.no_grad():
                back["raw"] = isp.reverse_pixels(part.cell_srgb, params, part.coordinates, back)
            return cycle_error(isp, part, params, back, self.config)

        if tensors:
            self.descent.run("RAW to sRGB", loss, tensors, self.config.steps, self.config.learning_rate)


def _apply_table(table: Tensor, srgb: Tensor) -> Tensor:
    """Map pictures ``(B, 3, H, W)`` to linear light by a table ``(1021,)``."""
    return to_linear(srgb, table.expand(len(srgb), -1))


def _darkens_corners(mean: Tensor, precision: Tensor) -> bool:
    """Whether a mask of mean ``(2,)`` and precision ``(2, 2)`` takes more than :data:`_DIMMEST` of a corner's light."""
    corners = torch.tensor([[0.6, 0.8], [0.6, -0.8], [-0.6, 0.8], [-0.6, -0.8]]) - mean
    exponent = 0.5 * torch.einsum("ki,ij,kj->k", corners, precision, corners)
    return bool((exponent > _DIMMEST).any())
