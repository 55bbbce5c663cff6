r"""The losses of a fit, and gradient descent in stages, between which it can be stopped and resumed.

The loss on RAW is ``(y_hat - y)^2 / (4 (y_hat + 0.01))``, with the denominator taken as a constant. Shot noise makes
the error of a reading proportional to its square root, and weights that do not depend on ``y`` keep noise unbiased.
The loss on sRGB includes the images between the stages (Conde et al., AAAI 2022, "Training").

A fit has stages; a stage is a loss and its tensors. The draws of a step are keyed by (seed, stage, step), so that a
resumed fit ends with the same bits as one that was not stopped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.files import read_tensors, write_tensors
from rawaug.isp.config import ISPParams
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.samples import FitFrames, PixelSamples
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import ToneMap
from rawaug.isp.tone import ToneCurve
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

_MOST_FRAMES = 16
"""Maximum number of frames in a step of the fit without encoders."""


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
    error = (isp.stages.forward(start, params, part.coordinates, ahead) - part.cell_srgb) ** 2
    for name, image in ahead.items():
        if name in back:
            error = error + config.intermediate * (image - back[name]) ** 2
    return (error * part.cell_weight).sum() / (3.0 * part.cell_weight.sum()).clamp_min(1.0)


def frame_mse(isp: DictionaryISP, part: PixelSamples, params: ISPParams) -> Tensor:
    """Compute the mean squared error of every frame ``(F,)`` on its unclipped pixels."""
    count = len(part.srgb)
    params = params.map(lambda tensor: tensor.expand(count, *tensor.shape[1:]))
    error = (isp.stages.reverse(part.srgb, params, part.coordinates) - part.target) ** 2 * part.known
    return error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)


@torch.no_grad()
def mean_psnr(isp: DictionaryISP, frames: FitFrames, as_shot: bool = False) -> float:
    """Average the PSNR of the frames, each in the setting that the ISP chooses for it, or under as-shot gains."""
    values = []
    for number, shot in enumerate(frames.shots):
        balance = shot.white_balance if as_shot else None
        params = isp.with_white_balance(isp.choose(shot.srgb), balance)
        values.append(frame_mse(isp, frames.some([number]).pixels, params))

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


def draw_batch(pixels: PixelSamples, count: int, generator: torch.Generator) -> tuple[Tensor | slice, PixelSamples]:
    """Draw the frames of a step (all, if there are few) and ``count`` random pixels, the same numbers of each frame."""
    frames: Tensor | slice = slice(None)
    if len(pixels.srgb) > _MOST_FRAMES:
        frames = torch.randperm(len(pixels.srgb), generator=generator)[:_MOST_FRAMES]

    drawn = pixels.srgb.shape[-1]
    index = torch.randint(drawn, (min(count, drawn),), generator=generator)
    return frames, pixels.pick(index, frames)


def trained_tensors(isp: DictionaryISP, forward: bool, up_to: int = 5) -> dict[str, Tensor]:
    """The tensors of the stages that a fit of a pass changes, as ``stage.name``, of the stages that make x1 ... x_k.

    Parameters whose names start with ``forward_`` belong to the forward pass, all others to the reverse pass. At the
    start of a fit, the toe stands for the tone network.
    """
    tensors: dict[str, Tensor] = {}
    for stage in isp.stages.ordered:
        if stage.makes > up_to:
            continue
        if isinstance(stage, ToneMap) and stage.toe is not None and not forward:
            tensors[f"{stage.name}.toe"] = stage.toe
            continue

        for key, parameter in stage.named_parameters():
            if key.startswith("forward_") == forward:
                tensors[f"{stage.name}.{key}"] = parameter
        if isinstance(stage, ToneCurve) and stage.slopes is not None and not forward:
            tensors[f"{stage.name}.slopes"] = stage.slopes
    return tensors


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

        def evaluate(step: int) -> str:
            text = ""
            if report is not None and step:
                text += report()
            if watch is not None:
                score = watch()
                scores = self.scores.setdefault(stage, [])
                if not scores or score > self.best(stage)[1]:
                    self._keep(stage, tensors)
                scores.append((step, score))
                text += f"held out {score:.2f} dB"
            return text

        is_done = all(f"{stage}/{name}" in self._ends for name in tensors)
        if not is_done:
            evaluate(0)
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
                    bar.set_postfix_str(f"loss {torch.stack(losses).mean():.2e} {evaluate(step)}", refresh=False)
                    losses.clear()

            if watch is None:
                self._keep(stage, tensors)
            if self.path is not None:
                write_tensors(self._ends, {"key": self.key, "scores": json.dumps(self.scores)}, self.path)

        for name, tensor in tensors.items():
            tensor.data.copy_(self._ends[f"{stage}/{name}"])
            tensor.requires_grad_(isinstance(tensor, torch.nn.Parameter))

    def _keep(self, stage: str, tensors: Mapping[str, Tensor]) -> None:
        for name, tensor in tensors.items():
            self._ends[f"{stage}/{name}"] = tensor.detach().clone()

    def best(self, stage: str) -> tuple[int, float]:
        """The first step of a watched stage that scored best, and its score."""
        step, score = max(self.scores[stage], key=lambda entry: entry[1])
        return step, score

    def finish(self) -> None:
        """Remove the state, because the fit is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)
