r"""The common base of the methods that the dictionary ISP is compared with, and their fit.

``y = mosaic(u(x))``, where u is the method: sRGB ``x`` ``(B, 3, H, W)`` becomes linear camera colour of the same size,
of which the mosaic keeps one channel for each site. Whatever a method predicts, its RAW is held within [0, 1]; training
sees the values as they are. Some methods also render, ``x = f(y)``.

Networks are trained by Adam, each with its own loss, on random crops of the pairs. Crops start where the frame's CFA is
that of the model, so frames of any pattern train one model. The learning rate falls to 0 by half a cosine over the
budget of seconds or steps, whichever is further spent. Given only steps, the same seed gives the same weights.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.fit.descent import adam
from rawaug.isp.fit.samples import FramePair
from rawaug.isp.functional import as_float
from rawaug.progress import progress as progress_bar
from rawaug.registry import Registry
from rawaug.seeding import keyed_generator

BASELINES = Registry("baseline", "rawaug.baselines", "rawaug.paper.baselines")
"""This maps names to baselines, which are subclasses of :class:`BaselineISP`."""

CLIP_NORM = 1.0
"""The gradient's norm is limited to this. Short fits need high rates, at which the U-Net otherwise diverges."""
CURVE_POINTS = 10
"""Mean losses are recorded for this many equal parts of a training, which shows whether it had ended."""


@dataclass(frozen=True)
class Training:
    """The budget and the samples of a network's training.

    Args:
        seconds: training stops when these have passed; the step under way is finished.
        steps: training stops after this many. One of the two limits must be given; the first step is always done.
        crop: side of the square crops in pixels, even.
        batch: number of crops in a step.
        seed: decides which crops a step sees.
        progress: whether a progress bar is shown.
    """

    seconds: float | None = None
    steps: int | None = None
    crop: int = 128
    batch: int = 4
    seed: int = 0
    progress: bool = True

    def require_budget(self) -> None:
        """Raise ValueError unless seconds or steps are set and above 0."""
        limits = [limit for limit in (self.seconds, self.steps) if limit is not None]
        if not limits or min(limits) <= 0:
            raise ValueError(f"give seconds or steps above 0, got {self.seconds} and {self.steps}")

    def share_done(self, seconds: float, steps: int) -> float:
        """Compute how far training has come, from 0 to 1: its share of the time or of the steps, if that is larger."""
        if steps == 0:  # one step is done in any case
            return 0.0

        share = 0.0
        if self.seconds is not None:
            share = seconds / self.seconds
        if self.steps is not None:
            share = max(share, steps / self.steps)
        return share


class BaselineISP(nn.Module, ABC):
    """A method that the dictionary ISP is compared with.

    The ``setting`` of a pass is what the method may know about a shot, such as its gains; with None it uses its own.

    Args:
        cfa: the pattern of the RAW that it makes and takes.
    """

    name: ClassVar[str]
    renders: ClassVar[bool] = False
    """This says whether the method also has a pass from RAW to sRGB."""

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__()
        self.cfa = CFA(cfa)
        self.info: dict[str, Any] = {}

    def as_shot_setting(self, white_balance: tuple[float, float, float]) -> Any:
        """Make the setting for as-shot multipliers R, G, B; return None if the method does not use them."""
        return None

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to a mosaic ``(B, 1, H, W)``, under a random setting if there are any."""
        return self.reverse(srgb)

    def learn(self, pairs: Sequence[FramePair], training: Training) -> list[float]:
        """Fit to the pairs and return the loss of each step; by default there is nothing to fit."""
        return []

    @abstractmethod
    def unprocess(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """Float sRGB ``(B, 3, H, W)`` to linear camera colour ``(B, 3, H, W)``, not clipped."""

    def reverse(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """Turn even-sided sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], into mosaics ``(B, 1, H, W)`` in [0, 1]."""
        camera_colour = self.unprocess(as_float(srgb), setting)
        return bayer.mosaic(camera_colour.clamp(0.0, 1.0), self.cfa)

    def render(self, raw: Tensor, setting: Any = None) -> Tensor:
        """Render a mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``, not clipped; raise ValueError if it cannot."""
        raise ValueError(f"{self.name} only converts sRGB to RAW")

    def forward(self, raw: Tensor, setting: Any = None) -> Tensor:
        """Render a RAW mosaic ``(B, 1, H, W)`` in :attr:`cfa` to sRGB ``(B, 3, H, W)`` in [0, 1]."""
        return self.render(raw, setting).clamp(0.0, 1.0)

    def cycle(self, srgb: Tensor) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to RAW and back to sRGB of the same shape."""
        return self.forward(self.reverse(srgb))


class Crops(NamedTuple):
    """A training batch, in the CFA of the model: sRGB ``(B, 3, H, W)``, mosaics ``(B, 1, H, W)``, gains ``(B, 3)``."""

    srgb: Tensor
    raw: Tensor
    white_balance: Tensor


class CropTrainedISP(BaselineISP):
    """A network that learns by gradient descent on random crops.

    ``reverse_network`` maps sRGB to camera colour; the published numbers of parameters count it alone.
    """

    reverse_network: nn.Module
    learning_rate: ClassVar[float]
    """Adam starts with this learning rate."""

    def unprocess(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape, by ``reverse_network``."""
        camera_colour: Tensor = self.reverse_network(srgb)
        return camera_colour

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        """Set from the pairs what descent does not learn. This is called once, before training."""

    def loss(self, crops: Crops, share_done: float = 1.0) -> Tensor:
        """Compute the scalar that training minimises, by default :meth:`raw_error`.

        Args:
            crops: the batch.
            share_done: how far the training has come, from 0 to 1, for methods that train in two phases.
        """
        predicted = bayer.mosaic(self.unprocess(crops.srgb), self.cfa)
        return self.raw_error(predicted, crops.raw)

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """Compute the error of predicted mosaics ``(B, 1, H, W)``, a scalar, by default l1."""
        return F.l1_loss(predicted, raw)

    def learn(self, pairs: Sequence[FramePair], training: Training) -> list[float]:
        """Train on crops; raise ValueError if there is no budget, or a pair is too small or not registered."""
        training.require_budget()
        require_crops(pairs, training.crop)
        self.prepare(pairs)
        self.train()

        parameters = [parameter for parameter in self.parameters() if parameter.requires_grad]
        device = parameters[0].device
        start = time.perf_counter()

        def spent(step: int) -> float:
            return training.share_done(time.perf_counter() - start, step)

        def loss(step: int) -> Tensor:
            crops = random_crops(pairs, self.cfa, training, step, device)
            return self.loss(crops, spent(step))

        descent = adam(parameters, self.learning_rate, loss, spent, clip_norm=CLIP_NORM)
        bar = progress_bar(
            descent, label=f"fit {self.name}", unit="step", total=training.steps, shown=training.progress
        )

        losses = []
        for value in bar:
            losses.append(value.item())
            seconds = time.perf_counter() - start
            bar.set_postfix_str(f"loss {losses[-1]:.2e}, {seconds:.0f} s", refresh=False)
        return losses


def require_crops(pairs: Sequence[FramePair], side: int) -> None:
    """Raise ValueError unless every pair is registered, and has room for a crop wherever its pattern begins."""
    for pair in pairs:
        if not pair.registered:
            raise ValueError(f"{pair.name}: RAW and sRGB are not registered pixel by pixel, which crops need")

        height, width = pair.clean.mosaic.shape[-2:]
        if min(height, width) < side + 2:
            raise ValueError(f"{pair.name}: {height} x {width} is smaller than {side + 2}; use a smaller crop")


def random_crops(
    pairs: Sequence[FramePair], cfa: CFA, training: Training, step: int, device: torch.device | str = "cpu"
) -> Crops:
    """Make the batch of a step, which is the same for the same seed and step.

    Args:
        pairs: registered frames of any pattern.
        cfa: the pattern in which all crops arrive.
        training: sets the crops' number, side and seed.
        step: counts from 0.
        device: where the batch is put.
    """
    generator = keyed_generator(training.seed, "baseline crops", step)
    random_crop = bayer.RandomCrop(training.crop)
    indices = torch.randint(len(pairs), (training.batch,), generator=generator).tolist()

    crops = []
    for index in indices:
        pair = pairs[index]
        srgb = bayer.crop_to_cfa(pair.srgb, CFA(pair.cfa), cfa)
        raw = bayer.crop_to_cfa(pair.clean.mosaic, CFA(pair.cfa), cfa)
        corner = random_crop.sample(raw.shape[-2], raw.shape[-1], generator)

        srgb_crop = as_float(random_crop.apply(srgb, corner))
        raw_crop = random_crop.apply(raw, corner)
        crops.append(Crops(srgb_crop, raw_crop, torch.tensor(pair.clean.white_balance)))

    stacked = (torch.stack(values).to(device) for values in zip(*crops, strict=True))
    return Crops(*stacked)


Model = TypeVar("Model", bound=BaselineISP)


def fit_baseline(model: Model, pairs: Sequence[FramePair], training: Training) -> Model:
    """Fit a method in place and return it in eval mode.

    ``model.info`` records the frames, the seed, the number of steps, the seconds and, for a network, ``loss``, the last
    one, and ``curve``, the mean losses of ten equal parts of the training. UPI as published has nothing to fit; tuned
    UPI is solved in closed form, whatever the budget.
    """
    if not pairs:
        raise ValueError("no RAW-sRGB pair to fit; give at least one RAW file")

    start = time.perf_counter()
    losses = model.learn(pairs, training)
    seconds = time.perf_counter() - start

    model.info = {
        "frames": [frame.name for frame in pairs],
        "seed": training.seed,
        "steps": len(losses),
        "seconds": round(seconds, 2),
    }
    if losses and math.isfinite(losses[-1]):
        model.info["loss"] = losses[-1]
        model.info["curve"] = mean_curve(losses)
    return model.eval()


def mean_curve(losses: Sequence[float], points: int = CURVE_POINTS) -> list[float]:
    """Average losses over equal parts of a training; one shorter than ``points`` steps keeps the losses themselves.

    Example:
        >>> mean_curve([4.0, 2.0, 1.0, 1.0], points=2)
        [3.0, 1.0]
    """
    points = min(points, len(losses))
    curve = []
    for part in range(points):
        begin = part * len(losses) // points
        end = (part + 1) * len(losses) // points
        curve.append(fmean(losses[begin:end]))
    return curve
