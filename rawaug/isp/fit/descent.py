r"""The losses of a fit, and gradient descent in stages, between which it can be stopped and resumed.

The loss on RAW is ``(y_hat - y)^2 / (4 (y_hat + 0.01))``, with the denominator taken as a constant: shot noise makes
the error of a reading proportional to its square root, and weights that do not depend on ``y`` keep noise unbiased.
The loss on sRGB takes in the images between the stages (Conde et al., AAAI 2022, "Training").

A fit has stages; one is a loss and its tensors. What a step draws is keyed by (seed, stage, step), so that a resumed
fit ends with the same bits as one that was not stopped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from rawaug.files import read_tensors, write_tensors
from rawaug.isp.config import ISPParams
from rawaug.isp.fit.config import FitConfig
from rawaug.isp.fit.samples import FitFrames, PixelSamples
from rawaug.isp.model import DictionaryISP
from rawaug.isp.staged import with_white_balance
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

    From noisy readings the pass would learn to denoise, so there it starts where the reverse pass ended.

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
    for name in ahead:
        error = error + config.intermediate * (ahead[name] - back[name]) ** 2 if name in back else error
    return (error * part.cell_weight).sum() / (3.0 * part.cell_weight.sum()).clamp_min(1.0)


def mean_square(isp: DictionaryISP, part: PixelSamples, params: ISPParams) -> Tensor:
    """Compute the mean squared error of every frame ``(F,)`` on its unclipped pixels."""
    count = len(part.srgb)
    params = ISPParams(*(value.expand(count, *value.shape[1:]) for value in params))
    error = (isp.reverse_pixels(part.srgb, params, part.coordinates) - part.target) ** 2 * part.known
    return error.sum((1, 2, 3)) / part.known.sum((1, 2, 3)).clamp_min(1.0)


def weight_distance(ours: ISPParams, theirs: ISPParams) -> Tensor:
    """Compute ``|w_r - w_f|^2``, the sum over both dictionaries, a scalar."""
    colour = (ours.colour_weights - theirs.colour_weights).square().sum()
    return colour + (ours.gain_weights - theirs.gain_weights).square().sum()


@torch.no_grad()
def mean_psnr(isp: DictionaryISP, frames: FitFrames, as_shot: bool = False) -> float:
    """Average the PSNR of the frames, each in the setting that the ISP chooses for it, or under as-shot gains."""
    values = []
    for k, shot in enumerate(frames.shots):
        given = shot.white_balance if as_shot else None
        params = with_white_balance(isp, isp.choose(shot.srgb), given, None)
        values.append(mean_square(isp, frames.some([k]).pixels, params))
    return float(-10.0 * torch.cat(values).log10().mean())


def adam(
    tensors: Sequence[Tensor],
    learning_rate: float,
    loss: Callable[[int], Tensor],
    spent: Callable[[int], float],
    clip_norm: float | None = None,
) -> Iterator[Tensor]:
    """Descend on a loss by Adam under a cosine, and yield the loss of each step, a scalar.

    Args:
        tensors: what is changed, in place, tensors of any shape.
        learning_rate: at the start; it falls to 0.
        loss: ``loss(step)`` gives the scalar to minimise.
        spent: ``spent(step)`` says which share of the budget is used up; the descent ends at 1.
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


class BestScore(NamedTuple):
    """The score of a watched stage at its start, and the best one with the step at which it was reached."""

    start: float
    step: int
    best: float


class Descent:
    """Runs the stages of a fit, and writes the end of each, so that a stopped fit goes on with the next one.

    Args:
        path: file of the state; None keeps none.
        key: what the state belongs to; a file of another fit is ignored.
        seed: keys the draws of every step.
        progress: whether to show progress bars.
    """

    report_steps: ClassVar[int] = 50

    def __init__(self, path: Path | None, key: str, seed: int, progress: bool) -> None:
        self.path, self.key, self.seed, self.progress = path, key, seed, progress
        self.watched: dict[str, BestScore] = {}
        self._ends: dict[str, Tensor] = {}
        if path is not None and path.is_file():
            header, tensors = read_tensors(path, "delete this state of an interrupted fit")
            if header.get("key") == key:
                self.watched = {k: BestScore(*values) for k, values in json.loads(header["watched"]).items()}
                self._ends = tensors

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
        """Minimise a loss by Adam; a stage that ran already takes its end from the state.

        Args:
            stage: name of the stage.
            loss: ``loss(generator)`` draws a batch and gives a scalar.
            tensors: what is changed in place, tensors of any shape by name.
            steps: number of steps.
            learning_rate: at the start.
            report: gives a text for the progress bar, every :attr:`report_steps` steps.
            watch: gives a score of frames held out; the stage then ends with the tensors that scored best.
        """

        def scores(step: int) -> str:
            reported = report() if report is not None and step else ""
            return reported + ("" if watch is None else self._note(stage, step, watch(), tensors))

        if not all(f"{stage}/{name}" in self._ends for name in tensors):
            scores(0)
            for tensor in tensors.values():
                tensor.requires_grad_()
            descent = adam(
                list(tensors.values()),
                learning_rate,
                lambda step: loss(keyed_generator(self.seed, stage, step)),
                lambda step: step / steps if step < steps else 1.0,
            )
            bar, losses = progress(descent, label=stage, unit="step", total=steps, shown=self.progress), list[Tensor]()
            for done, value in enumerate(bar, 1):
                losses.append(value)
                if done % self.report_steps == 0 or done == steps:
                    bar.set_postfix_str(f"loss {torch.stack(losses).mean():.2e} {scores(done)}", refresh=False)
                    losses.clear()
            if watch is None:
                self._keep(stage, tensors)
            if self.path is not None:
                write_tensors(self._ends, {"key": self.key, "watched": json.dumps(self.watched)}, self.path)
        for name, tensor in tensors.items():
            tensor.data.copy_(self._ends[f"{stage}/{name}"])
            tensor.requires_grad_(isinstance(tensor, torch.nn.Parameter))

    def finish(self) -> None:
        """Remove the state, as the fit is done."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _keep(self, stage: str, tensors: Mapping[str, Tensor]) -> None:
        self._ends |= {f"{stage}/{name}": tensor.detach().clone() for name, tensor in tensors.items()}

    def _note(self, stage: str, step: int, score: float, tensors: Mapping[str, Tensor]) -> str:
        """Note a score, and the tensors if it is the best so far."""
        before = self.watched.get(stage, BestScore(score, step, -math.inf))
        if stage not in self.watched or score > before.best:
            self.watched[stage] = BestScore(before.start, step, score)
            self._keep(stage, tensors)
        return f"held out {score:.2f} dB"
