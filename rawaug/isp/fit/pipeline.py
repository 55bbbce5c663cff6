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
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug.camera.own import Camera
from rawaug.files import digest
from rawaug.isp import functional, stages
from rawaug.isp.config import POINTWISE_STAGES, SMALL, ISPConfig
from rawaug.isp.fit.atoms import REACH_ATOMS, measure_gain_errors, set_dictionaries
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.descent import Descent, adam, cycle_error, draw_batch, mean_psnr, reading_error, trained_tensors
from rawaug.isp.fit.end_to_end import Refit, gain_left_out, train_encoders, train_jointly
from rawaug.isp.fit.samples import FitFrames, FramePair, FrameSummary, PixelSamples, sample_pixels
from rawaug.isp.fit.start import FEWEST_PIXELS, FrameColour, fit_colours, fit_fall_off, set_curve, shaded_light, tie
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import Gamma, LensShading, ToneMap
from rawaug.isp.tone import ToneCurve, to_linear
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

    # A kept state is used only by a fit with the same settings and pixels.
    facts: list[Any] = [__version__, config]
    facts.append([(shot.name, shot.camera, shot.white_balance) for shot in frames.shots])
    if camera is not None:
        facts.append(camera)
    settings = repr(tuple(facts)).encode()
    key = digest(settings, frames.pixels.srgb.numpy().tobytes(), frames.pixels.target.numpy().tobytes())
    descent = Descent(None if state is None else Path(state), key, config.seed, progress)

    def refit(some: FitFrames, part: str, config: FitConfig) -> DictionaryISP:
        isp, _ = fit_reverse(some, config, descent, part, camera)
        return isp

    with one_thread():
        config, gain = choose_tone(frames, config, refit)
        isp, colour = fit_reverse(frames, config, descent, camera=camera, report=report)
        train_encoders(isp, frames, config, descent, refit)
        fit_forward(isp, colour, frames, config, descent)
        held_out = train_jointly(isp, frames, config, descent, held_out)
        measure_gain_errors(isp, held_out)

    descent.finish()
    if gain is not None:
        isp.info["curve_gain_db"] = round(gain, 2)
    isp.info["registered"] = sum(shot.registered for shot in frames.shots)
    isp.info["frames"] = [shot.name for shot in frames.shots]
    isp.info["steps"] = config.steps
    isp.info["seed"] = config.seed
    return isp.eval()


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


def choose_tone(frames: FitFrames, config: FitConfig, refit: Refit) -> tuple[FitConfig, float | None]:
    """Decide the setting ``tone``; also return the gain of the curve in dB if both were compared."""
    if config.tone != "auto":
        return config, None
    if len(frames.shots) < 2:
        return replace(config, tone="learned"), None

    def better(out: FitFrames, kept: FitFrames, part: str) -> float:
        learned = refit(kept, f", learned{part}", replace(config, tone="learned"))
        curve = refit(kept, f", curve{part}", replace(config, tone="curve"))
        return mean_psnr(curve, out, True) - mean_psnr(learned, out, True)

    gain = gain_left_out(frames, better)
    return replace(config, tone="curve" if gain > 0 else "learned"), gain


def _make_isp(shots: Sequence[FrameSummary], config: FitConfig) -> DictionaryISP:
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


def fit_reverse(
    frames: FitFrames,
    config: FitConfig,
    descent: Descent,
    part: str = "",
    camera: Camera | None = None,
    report: Callable[[DictionaryISP], str] | None = None,
) -> tuple[DictionaryISP, FrameColour]:
    """Run stages 1 to 3, which fit the reverse pass, without encoders.

    Args:
        frames: the frames to fit.
        config: the settings of the fit.
        descent: runs stages 1 and 2.
        part: ends the names of the stages, if the frames are a part of all.
        camera: the camera's figures, from which the frames' matrices start.
        report: gets the ISP as it would be now, every 50 steps of stage 2.

    Returns:
        The ISP, and every frame's colour, of which its atoms were made.
    """
    isp = _make_isp(frames.shots, config)
    known_matrix: Tensor | None = None
    if camera is not None:
        known_matrix = torch.stack([camera.matrix_for(shot.white_balance) for shot in frames.shots])

    colour = _fit_curve(isp, frames, config, descent, part, known_matrix)
    if config.start is not None:
        start = DictionaryISP.from_pretrained(config.start)
        colour = _start_from(isp, start, colour, frames.pixels, known_matrix)
    _fit_tone(isp, colour, frames, config, descent, part, report)
    set_dictionaries(isp, colour, frames, config)
    return isp, colour


def _fit_curve(
    isp: DictionaryISP,
    frames: FitFrames,
    config: FitConfig,
    descent: Descent,
    part: str,
    known_matrix: Tensor | None,
) -> FrameColour:
    """Run stage 1 without the mask and, if the readings fall off towards the corners, with it as well.

    Stages of ``isp`` change, and that of the shading goes if it does not pay. Returns every frame's colour.
    """
    # The start: least squares under the curve of the standard that fits best.
    starts = []
    for curve in _STANDARD_CURVES:
        set_curve(isp, *curve)
        with torch.no_grad():
            colour, error = fit_colours(shaded_light(isp, frames.pixels), frames.pixels, known_matrix)
        starts.append((error, curve, colour))
    _, curve, colour = min(starts, key=lambda start: start[0])
    set_curve(isp, *curve)

    def loss(generator: torch.Generator) -> Tensor:
        chosen, pixels = draw_batch(frames.pixels, config.batch, generator)
        predicted = functional.correct_colour(shaded_light(isp, pixels), colour.pick(chosen).product())
        return reading_error(predicted, pixels) + tie(colour, frames)

    def current_error() -> float:
        with torch.no_grad():
            predicted = functional.correct_colour(shaded_light(isp, frames.pixels), colour.product())
            return float(reading_error(predicted, frames.pixels))

    shading = isp.stages.find(LensShading)
    mode = config.shading if shading else "off"
    steps = CURVE_STEPS if config.curve_steps is None else config.curve_steps
    numbers = trained_tensors(isp, forward=False, up_to=2) | colour._asdict()
    if mode != "on":
        descent.run(f"curve{part}", loss, numbers, steps, _CURVE_RATE)

    keeps_mask = False
    if shading is not None and mode != "off":
        with torch.no_grad():
            mean, precision = fit_fall_off(shaded_light(isp, frames.pixels), frames.pixels, colour.product())
        keeps_mask = mode == "on" or _darkens_corners(mean, precision)

    if shading is not None and keeps_mask:
        error = current_error()
        before = {name: tensor.detach().clone() for name, tensor in numbers.items()}
        shading.mask.set(mean, precision)
        mask = {f"{shading.name}.mask.{key}": parameter for key, parameter in shading.mask.named_parameters()}
        descent.run(f"curve and shading{part}", loss, numbers | mask, steps, _CURVE_RATE)

        if mode == "auto" and current_error() > _SHADING_PAYS * error:
            keeps_mask = False
            for name, tensor in numbers.items():
                tensor.data.copy_(before[name])

    if shading is not None and not keeps_mask:
        isp.configure(stages=tuple(name for name in isp.config.stages if name != shading.name))

    # From now on the tone network takes the place of the toe.
    tone = isp.stages.find(ToneMap)
    if tone is not None and tone.toe is not None:
        tone.reverse_network.start_from(float(tone.toe))
        tone.toe = None
    return colour


def _darkens_corners(mean: Tensor, precision: Tensor) -> bool:
    """Whether a mask of mean ``(2,)`` and precision ``(2, 2)`` takes more than :data:`_DIMMEST` of a corner's light."""
    corners = torch.tensor([[0.6, 0.8], [0.6, -0.8], [-0.6, 0.8], [-0.6, -0.8]]) - mean
    exponent = 0.5 * torch.einsum("ki,ij,kj->k", corners, precision, corners)
    return bool((exponent > _DIMMEST).any())


def _start_from(
    isp: DictionaryISP, start: DictionaryISP, colour: FrameColour, pixels: PixelSamples, known_matrix: Tensor | None
) -> FrameColour:
    """Start the tone from that of another ISP, or the best of its curves, if that improves the frames.

    Returns every frame's colour under the tone that the fit starts from.
    """

    @torch.no_grad()
    def fit_under(curve: Callable[[Tensor], Tensor]) -> tuple[FrameColour, float]:
        return fit_colours(shaded_light(isp, pixels, curve), pixels, known_matrix)

    curves: list[Callable[[Tensor], Tensor]] = [start.stages.linear]
    if start.tone is not None:
        curves = [partial(_apply_table, table) for table in start.tone.curves]
    errors = [fit_under(curve)[1] for curve in curves]
    best = curves[errors.index(min(errors))]
    _, error = fit_under(isp.stages.linear)
    if min(errors) >= error:
        return colour

    # Descend towards x2 by its tone, on greys and on the colours of a cube.
    greys = torch.linspace(0.0, 1.0, 256).expand(1, 3, 1, -1)
    colours = torch.cat([greys, stages.node_colours(9).flatten(2)[:, :, None]], dim=3)
    with torch.no_grad():
        target = best(colours)
    tensors = list(trained_tensors(isp, forward=False, up_to=2).values())
    before = [tensor.detach().clone() for tensor in tensors]
    for tensor in tensors:
        tensor.requires_grad_()

    descent = adam(
        tensors,
        _START_RATE,
        lambda step: ((isp.stages.linear(colours) - target) ** 2 / (target + 0.01)).mean(),
        lambda step: step / _START_STEPS,
    )
    for _ in descent:
        pass

    for tensor in tensors:
        tensor.requires_grad_(isinstance(tensor, torch.nn.Parameter))

    started_colour, started_error = fit_under(isp.stages.linear)
    if started_error < error:
        return started_colour

    for tensor, old in zip(tensors, before, strict=True):
        tensor.data.copy_(old)
    return colour


def _apply_table(table: Tensor, srgb: Tensor) -> Tensor:
    """Map pictures ``(B, 3, H, W)`` to linear light by a table ``(1021,)``."""
    return to_linear(srgb, table.expand(len(srgb), -1))


def _fit_tone(
    isp: DictionaryISP,
    colour: FrameColour,
    frames: FitFrames,
    config: FitConfig,
    descent: Descent,
    part: str,
    report: Callable[[DictionaryISP], str] | None,
) -> None:
    """Run stage 2, the tone and each frame's colour; ``report`` gets the ISP as it would be now."""

    def loss(generator: torch.Generator) -> Tensor:
        chosen, pixels = draw_batch(frames.pixels, config.batch, generator)
        predicted = isp.stages.reverse(pixels.srgb, colour.pick(chosen).params(), pixels.coordinates)
        return reading_error(predicted, pixels) + tie(colour, frames)

    def status() -> str:
        if report is None:
            return ""

        current = deepcopy(isp)
        set_dictionaries(current, colour, frames, config)
        return report(current.eval())

    tensors = colour._asdict() | trained_tensors(isp, forward=False)
    descent.run(f"sRGB to RAW{part}", loss, tensors, config.steps, config.learning_rate, status)


def fit_forward(
    isp: DictionaryISP, colour: FrameColour, frames: FitFrames, config: FitConfig, descent: Descent
) -> None:
    """Run stage 5: fit the forward pass of ``isp`` to its reverse pass, in the frames' own colours."""
    # It starts with the power of the reverse pass, or with its curves, which keep their slopes.
    power, table = isp.stages.find(Gamma), isp.stages.find(ToneCurve)
    with torch.no_grad():
        if power is not None:
            power.forward_gamma.copy_(power.reverse_gamma)
        if table is not None:
            table.dictionary.curves.copy_(table.bend())
            table.slopes = None

    def loss(generator: torch.Generator) -> Tensor:
        chosen, pixels = draw_batch(frames.pixels, config.batch, generator)
        params = colour.pick(chosen).params()
        back: dict[str, Tensor] = {}
        with torch.no_grad():
            back["raw"] = isp.stages.reverse(pixels.cell_srgb, params, pixels.coordinates, back)
        return cycle_error(isp, pixels, params, back, config)

    tensors = trained_tensors(isp, forward=True)
    if tensors:
        descent.run("RAW to sRGB", loss, tensors, config.steps, config.learning_rate)
