r"""The losses of a fit, and gradient descent in stages, between which it can be stopped and resumed.

The loss on RAW is ``(y_hat - y)^2 / (4 (y_hat + 0.01))``, with the denominator taken as a constant. Shot noise makes
the error of a reading proportional to its square root, and weights that do not depend on ``y`` keep noise unbiased.
The loss on sRGB includes the images between the stages (Conde et al., AAAI 2022, "Training").

*Encoders* are trained last, with tone and dictionaries frozen, on the RAW that either direction's weights make:
``L = sum_f log(MSE_f(w_r) + eps) + log(MSE_f(w_f) + eps) + c |w_r - w_f|^2``. For every fold, curve, tone and atoms are
fitted anew without its frames, then constants and encoders are compared on these. *End-to-end training* refines an ISP
that is already fitted: ``L = |y_hat - y|^2 + |x_hat - x|^2 + 0.1 sum_k |x_k^f - x_k^r|^2 + 0.01 |w_r - w_f|^2`` on
random pixels of random frames, with the weights that both encoders choose. A tenth of the frames is watched, and the
best parameters are restored.

A fit has stages; a stage is a loss and its tensors. The draws of a step are keyed by (seed, stage, step), so that a
resumed fit ends with the same bits as one that was not stopped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.files import read_tensors, write_tensors
from rawaug.isp.config import ISPParams
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.samples import FitFrames, FrameSummary, PixelSamples
from rawaug.isp.fit.start import measure_lights
from rawaug.isp.model import DictionaryISP
from rawaug.progress import progress
from rawaug.seeding import keyed_generator


def reading_error(predicted: Tensor, part: PixelSamples) -> Tensor:
    """Average the weighted squared error of RAW ``(F, 3, 1, P)`` on unclipped readings, first within frames."""
    weight = part.known / (4.0 * (predicted.detach().clamp_min(0.0) + 0.01))
    error = (predicted - part.target) ** 2 * weight
    return (error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)).mean()


def cycle_error(
    isp: DictionaryISP, part: PixelSamples, params: ISPParams, back: Mapping[str, Tensor], config: FitConfig
) -> Tensor:
    """Compute the squared error of the forward pass on sRGB and on every image between the stages.

    On noisy readings the pass would learn to denoise, so there it starts where the reverse pass ended.

    Args:
        isp: the ISP being fitted.
        part: the pixels, F frames of P.
        params: the settings of the F frames.
        back: the images ``(F, 3, 1, P)`` of the reverse pass, x1 ... x5 and ``raw``.
        config: gives the weight of the images between the stages, and whether readings are noisy.

    Returns:
        A scalar.
    """
    ahead: dict[str, Tensor] = {}
    start = back["raw"].detach() if config.noisy else part.cell_raw
    error = (isp.forward_pixels(start, params, part.coordinates, ahead) - part.cell_srgb) ** 2
    for name, image in ahead.items():
        if name in back:
            error = error + config.intermediate * (image - back[name]) ** 2
    return (error * part.cell_weight).sum() / (3.0 * part.cell_weight.sum()).clamp_min(1.0)


def mean_square(isp: DictionaryISP, part: PixelSamples, params: ISPParams) -> Tensor:
    """Compute the mean squared error of every frame ``(F,)`` on its unclipped pixels."""
    count = len(part.srgb)
    params = params.map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))
    error = (isp.reverse_pixels(part.srgb, params, part.coordinates) - part.target) ** 2 * part.known
    return error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)


def _weight_distance(ours: ISPParams, theirs: ISPParams) -> Tensor:
    """Compute ``|w_r - w_f|^2``, the sum over both dictionaries, a scalar."""
    colour = (ours.colour_weights - theirs.colour_weights).square().sum()
    return colour + (ours.gain_weights - theirs.gain_weights).square().sum()


@torch.no_grad()
def mean_psnr(isp: DictionaryISP, frames: FitFrames, as_shot: bool = False) -> float:
    """Average the PSNR of the frames, each in the setting that the ISP chooses for it, or under as-shot gains."""
    values = []
    for number, shot in enumerate(frames.shots):
        balance = shot.white_balance if as_shot else None
        params = isp.with_white_balance(isp.choose(shot.srgb), balance)
        values.append(mean_square(isp, frames.some([number]).pixels, params))

    return float(-10.0 * torch.cat(values).log10().mean())


def adam(
    tensors: Sequence[Tensor],
    learning_rate: float,
    loss: Callable[[int], Tensor],
    spent: Callable[[int], float],
    clip_norm: float | None = None,
) -> Iterator[Tensor]:
    """Descend on a loss by Adam with cosine decay, and yield the loss of each step, a scalar.

    Args:
        tensors: the tensors to change in place, of any shape.
        learning_rate: learning rate at the start; it falls to 0.
        loss: ``loss(step)`` gives the scalar to minimise.
        spent: ``spent(step)`` gives the share of the budget that is used up; the descent ends at 1.
        clip_norm: gradients are scaled down to this norm.
    """
    optimiser = torch.optim.Adam(tensors, lr=learning_rate)
    step = 0
    while (share := spent(step)) < 1.0:
        optimiser.param_groups[0]["lr"] = learning_rate * 0.5 * (1.0 + math.cos(math.pi * share))
        value = loss(step)
        optimiser.zero_grad(set_to_none=True)
        value.backward()
        if clip_norm is not None:
            torch.nn.utils.clip_grad_norm_(tensors, clip_norm)

        optimiser.step()
        step += 1
        yield value.detach()


class Descent:
    """Runs the stages of a fit, and saves the end of each, so that a stopped fit goes on with the next one.

    Args:
        path: file of the state; None keeps none.
        key: identifies the fit that the state belongs to; a file of another fit is ignored.
        seed: keys the draws of every step.
        progress: whether to show progress bars.
    """

    report_steps: ClassVar[int] = 50

    def __init__(self, path: Path | None, key: str, seed: int, progress: bool) -> None:
        self.path, self.key, self.seed, self.progress = path, key, seed, progress
        self.scores: dict[str, list[tuple[int, float]]] = {}
        """Of every watched stage, its steps and their scores on held-out frames."""
        self._ends: dict[str, Tensor] = {}
        if path is not None and path.is_file():
            header, tensors = read_tensors(path, "delete this state of an interrupted fit")
            if header.get("key") == key and "scores" in header:
                self._ends = tensors
                self.scores = json.loads(header["scores"])

    def run(
        self,
        stage: str,
        loss: Callable[[torch.Generator], Tensor],
        tensors: Mapping[str, Tensor],
        steps: int,
        learning_rate: float,
        report: Callable[[], str] | None = None,
        watch: Callable[[], float] | None = None,
    ) -> None:
        """Minimise a loss by Adam; a stage that has already run takes its end from the state.

        Args:
            stage: name of the stage.
            loss: ``loss(generator)`` draws a batch and gives a scalar.
            tensors: the tensors to change in place, of any shape, by name.
            steps: number of steps.
            learning_rate: learning rate at the start.
            report: gives a text for the progress bar, every :attr:`report_steps` steps.
            watch: gives a score on held-out frames; the stage then ends with the tensors that scored best.
        """

        def scores(step: int) -> str:
            text = ""
            if report is not None and step:
                text += report()
            if watch is not None:
                text += self._note(stage, step, watch(), tensors)
            return text

        if not self._has_end(stage, tensors):
            scores(0)
            for tensor in tensors.values():
                tensor.requires_grad_()

            descent = adam(
                list(tensors.values()),
                learning_rate,
                lambda step: loss(keyed_generator(self.seed, stage, step)),
                lambda step: step / steps if step < steps else 1.0,
            )
            bar = progress(descent, label=stage, unit="step", total=steps, shown=self.progress)
            losses: list[Tensor] = []
            for step, value in enumerate(bar, 1):
                losses.append(value)
                if step % self.report_steps == 0 or step == steps:
                    bar.set_postfix_str(f"loss {torch.stack(losses).mean():.2e} {scores(step)}", refresh=False)
                    losses.clear()

            if watch is None:
                self._keep(stage, tensors)
            if self.path is not None:
                write_tensors(self._ends, {"key": self.key, "scores": json.dumps(self.scores)}, self.path)

        for name, tensor in tensors.items():
            tensor.data.copy_(self._ends[f"{stage}/{name}"])
            tensor.requires_grad_(isinstance(tensor, torch.nn.Parameter))

    def best(self, stage: str) -> tuple[int, float]:
        """The first step of a watched stage that scored best, and its score."""
        step, score = max(self.scores[stage], key=lambda entry: entry[1])
        return step, score

    def curve(self, stage: str) -> list[float]:
        """At most :data:`CURVE_POINTS` scores of a watched stage, with the first and the last, to two decimals."""
        scores = self.scores[stage]
        last = len(scores) - 1
        count = min(CURVE_POINTS, last + 1)
        numbers = [round(k * last / max(1, count - 1)) for k in range(count)]
        return [round(scores[number][1], 2) for number in numbers]

    def finish(self) -> None:
        """Remove the state, because the fit is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _has_end(self, stage: str, tensors: Mapping[str, Tensor]) -> bool:
        return all(f"{stage}/{name}" in self._ends for name in tensors)

    def _keep(self, stage: str, tensors: Mapping[str, Tensor]) -> None:
        for name, tensor in tensors.items():
            self._ends[f"{stage}/{name}"] = tensor.detach().clone()

    def _note(self, stage: str, step: int, score: float, tensors: Mapping[str, Tensor]) -> str:
        """Note a score, and the tensors if it is the best so far."""
        scores = self.scores.setdefault(stage, [])
        if not scores or score > self.best(stage)[1]:
            self._keep(stage, tensors)
        scores.append((step, score))
        return f"held out {score:.2f} dB"


FRAMES_A_STEP = 4
ENCODER_PIXELS, ENCODER_RATE = 1024, 1e-3
FEWEST_FRAMES, FOLDS = 12, 4
"""For encoders with "auto": the minimum number of frames, and the number of folds of the cross-validation."""

_MANY_FRAMES = 50
"""Minimum number of frames for end-to-end training by default."""
STEPS, LEARNING_RATE = 1000, 2e-4
"""Number of steps, and learning rate, of end-to-end training."""
_CONSISTENCY = 0.01
"""Weight of the distance between the weights of both directions."""
PUBLISHED_RATE, PUBLISHED_FRAMES, _PUBLISHED_PIXELS = 2e-3, 8, 256
"""Rate of the published fit, which learns nearly everything end to end, and frames and pixels in a step."""
_LOG_WEIGHT = 0.02
"""Weight of the logarithm of an error beside the squared errors of the other pass."""
CURVE_POINTS = 13
"""Number of scores of a watched training in an ISP's record."""
_LOSS_SCALE = 1e4
"""Factor on squared errors: they are near 1e-4, and the encoders' share would vanish beside Adam's epsilon of 1e-8."""

Refit = Callable[[FitFrames, str, FitConfig], DictionaryISP]
"""A function that fits an ISP without encoders to some frames; the text names the fit in its progress."""


def _gain_left_out(frames: FitFrames, folds: int, gain: Callable[[FitFrames, FitFrames, str], float]) -> float:
    """Average ``gain(left out, kept, name of the fold)`` over the frames, each of which is left out once."""
    count = len(frames.shots)
    total = 0.0
    for fold in range(folds):
        out, kept = frames.split(range(fold, count, folds))
        total += len(out.shots) * gain(out, kept, f" without part {fold + 1} of {folds}")

    return total / count


def with_better_tone(frames: FitFrames, config: FitConfig, refit: Refit) -> tuple[FitConfig, float | None]:
    """Decide the setting ``tone``; also return the gain of the curve in dB if both were compared."""
    if config.tone != "auto":
        return config, None
    if len(frames.shots) < 2:
        return replace(config, tone="learned"), None

    def better(out: FitFrames, kept: FitFrames, part: str) -> float:
        learned = refit(kept, f", learned{part}", replace(config, tone="learned"))
        curve = refit(kept, f", curve{part}", replace(config, tone="curve"))
        return mean_psnr(curve, out, True) - mean_psnr(learned, out, True)

    gain = _gain_left_out(frames, min(FOLDS, len(frames.shots)), better)
    return replace(config, tone="curve" if gain > 0 else "learned"), gain


def train_encoders(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, refit: Refit) -> None:
    """Train the encoders, or keep the constants, as ``config.encoders`` says.

    Args:
        isp: the ISP, fitted up to its atoms.
        frames: all frames of the fit.
        config: the settings of the fit.
        descent: runs the training.
        refit: fits an ISP without encoders to some of the frames, to judge encoders on the others.
    """

    def better(out: FitFrames, kept: FitFrames, part: str) -> float:
        """Compute by how many dB encoders beat constants on frames that no stage of the fit has seen."""
        refitted = refit(kept, part, config)
        refitted.use_encoders(False)
        constants = mean_psnr(refitted, out)
        _train(refitted, kept, config, descent, f"encoders{part}")
        return mean_psnr(refitted, out) - constants

    mode = config.encoders
    isp.use_encoders(False)
    if mode == "auto" and len(frames.shots) >= FEWEST_FRAMES:
        gain = _gain_left_out(frames, FOLDS, better)
        isp.info["encoders_gain_db"] = round(gain, 2)
        mode = "on" if gain > 0 else "off"

    if mode == "on":
        _train(isp, frames, config, descent, "encoders")


def _train(isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, stage: str) -> None:
    isp.use_encoders(True, descent.seed)
    tensors = {}
    for name, parameter in isp.named_parameters():
        if "_encoders." in name and ".layers." in name:
            tensors[name] = parameter

    def loss(generator: torch.Generator) -> Tensor:
        # The frames of a step have the same random pixels.
        numbers = torch.randint(len(frames.shots), (FRAMES_A_STEP,), generator=generator).tolist()
        index = torch.randint(frames.pixels.srgb.shape[-1], (ENCODER_PIXELS,), generator=generator)

        losses = []
        for number in numbers:
            part, shot = frames.pixels.pick(index, torch.tensor([number])), frames.shots[number]
            losses.append(_encoder_loss(isp, part, shot, config, generator))
        return torch.stack(losses).mean()

    descent.run(stage, loss, tensors, config.encoder_steps, ENCODER_RATE)


def _encoder_loss(
    isp: DictionaryISP, part: PixelSamples, shot: FrameSummary, config: FitConfig, generator: torch.Generator
) -> Tensor:
    srgb, raw = _same_piece(shot.srgb, isp.remove_shading(shot.raw, None), generator)
    ours, theirs = isp.choose(srgb), isp.choose_forward(raw)
    our_error = (mean_square(isp, part, ours) + config.mse_floor).log()
    their_error = (mean_square(isp, part, theirs) + config.mse_floor).log()
    return (our_error + their_error).sum() + config.consistency * _weight_distance(ours, theirs)


def _same_piece(srgb: Tensor, raw: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Cut the same random piece from both thumbnails, maybe flipped, so that the encoders cannot learn the frames."""
    share = 0.5 + 0.5 * torch.rand(2, generator=generator)
    start = torch.rand(2, generator=generator) * (1.0 - share)
    flip = bool(torch.rand((), generator=generator) < 0.5)
    pieces = []
    for image in (srgb, raw):
        sides = torch.tensor(image.shape[-2:])
        top, left = (start * sides).long().tolist()
        height, width = (share * sides).long().clamp_min(1).tolist()
        piece = image[..., top : top + height, left : left + width]
        pieces.append(piece.flip(-1) if flip else piece)

    return pieces[0], pieces[1]


def joint_steps(config: FitConfig, frames: int) -> int:
    """The number of steps of end-to-end training on this number of frames."""
    if config.joint_steps is not None:
        return config.joint_steps
    return STEPS if frames >= _MANY_FRAMES else 0


def train_jointly(
    isp: DictionaryISP, frames: FitFrames, config: FitConfig, descent: Descent, watched: FitFrames | None = None
) -> FitFrames | None:
    """Refine everything at once, if ``config.joint_steps`` asks for it; the gain is noted in ``isp.info``.

    The properties of the atoms that as-shot gains depend on are measured anew afterwards.

    Args:
        isp: the fitted ISP.
        frames: all frames of the fit.
        config: the settings of the fit.
        descent: runs the training.
        watched: frames that choose the best step; by default a tenth of the others, which is held out.

    Returns:
        The watched frames; None without a training.
    """
    count = len(frames.shots)
    steps = joint_steps(config, count)
    if steps == 0:
        return None
    if watched is None and count < 2:
        raise ValueError("joint_steps: end-to-end training holds frames out for validation; give two frames or more")

    trained = frames
    if watched is None:
        watched, trained = frames.split(range(0, count, 10)[: max(1, count // 2)])

    published = config.method == "published"
    frames_a_step, pixels, rate = FRAMES_A_STEP, config.batch, LEARNING_RATE
    if published:
        frames_a_step, pixels, rate = PUBLISHED_FRAMES, min(config.batch, _PUBLISHED_PIXELS), PUBLISHED_RATE

    def loss(generator: torch.Generator) -> Tensor:
        losses = []
        for part, srgb, raw in _draw_batches(trained, frames_a_step, pixels, generator):
            raw = isp.remove_shading(raw, None)
            if published:
                srgb, raw = _same_piece(srgb, raw, generator)

            losses.append(len(srgb) * _joint_loss(isp, part, srgb, raw, config))

        return _LOSS_SCALE * torch.stack(losses).sum() / frames_a_step

    tensors = dict(isp.named_parameters())
    descent.run("end to end", loss, tensors, steps, rate, watch=lambda: mean_psnr(isp, watched))

    step, score = descent.best("end to end")
    if step > 0:
        measure_lights(isp, trained)
    _, first_score = descent.scores["end to end"][0]
    isp.info["joint"] = {
        "steps": steps,
        "kept_step": step,
        "gain_db": round(score - first_score, 2),
        "curve": descent.curve("end to end"),
    }
    return watched


def _draw_batches(
    frames: FitFrames, count: int, pixels: int, generator: torch.Generator
) -> list[tuple[PixelSamples, Tensor, Tensor]]:
    """Draw ``count`` frames, with replacement, in batches of one size: pixels, thumbnails of sRGB and of RAW."""
    numbers = torch.randint(len(frames.shots), (count,), generator=generator).tolist()
    index = torch.randint(frames.pixels.srgb.shape[-1], (pixels,), generator=generator)
    groups: dict[tuple[torch.Size, torch.Size], list[int]] = {}
    for k in numbers:
        shot = frames.shots[k]
        groups.setdefault((shot.srgb.shape, shot.raw.shape), []).append(k)

    batches = []
    for members in groups.values():
        shots = [frames.shots[k] for k in members]
        srgb = torch.cat([shot.srgb for shot in shots])
        raw = torch.cat([shot.raw for shot in shots])
        batches.append((frames.pixels.pick(index, torch.tensor(members)), srgb, raw))

    return batches


def _joint_loss(isp: DictionaryISP, part: PixelSamples, srgb: Tensor, raw: Tensor, config: FitConfig) -> Tensor:
    """Compute the loss of B frames: ``srgb`` ``(B, 3, h, w)`` and ``raw`` ``(B, 3, h', w')``, without shading."""
    ours, theirs = isp.choose(srgb), isp.choose_forward(raw)
    back: dict[str, Tensor] = {}
    back["raw"] = isp.reverse_pixels(part.cell_srgb, ours, part.coordinates, back)
    cycle = cycle_error(isp, part, theirs, back, config)
    distance = _weight_distance(ours, theirs) / len(srgb)
    error = mean_square(isp, part, ours)
    if config.raw_loss == "log":
        error = _LOG_WEIGHT * (error + config.mse_floor).log()
    return error.mean() + cycle + _CONSISTENCY * config.consistency * distance
