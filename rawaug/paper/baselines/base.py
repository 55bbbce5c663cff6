r"""What the methods that the dictionary ISP is compared with have in common, and how they are fitted.

``y = mosaic(u(x))``, u being the method: sRGB ``x`` ``(B, 3, H, W)`` becomes linear camera colour of the same size, of
which the mosaic keeps one channel a site. Whatever a method predicts, RAW leaves it within [0, 1]; training sees the
values as they are.

Networks are trained by Adam, each with its own loss, on random crops of the pairs, which start where the frame's CFA is
that of the model, so frames of any pattern train one model. The learning rate falls to 0 by half a cosine over the
budget, whichever of the two, seconds or steps, is further spent. Given steps alone, the same seed gives the same
weights.
"""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.fit.descent import adam
from rawaug.isp.fit.samples import FramePair
from rawaug.isp.stages import as_float
from rawaug.progress import progress as progress_bar
from rawaug.seeding import keyed_generator

CLIP_NORM = 1.0
"""The gradient's largest norm. Short fits need high rates, at which the U-Net diverges without this limit."""


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

    def share_done(self, seconds: float, steps: int) -> float:
        """How far the training has come, from 0 to 1: the share of the time or of the steps, whichever is larger."""
        by_time = 0.0 if self.seconds is None or not steps else seconds / self.seconds  # one step is done in any case
        return max(by_time, 0.0 if self.steps is None else steps / self.steps)


class BaselineISP(nn.Module, ABC):
    """A method that the dictionary ISP is compared with.

    The ``setting`` of a pass is what the method may know of a shot, such as its gains; None leaves it to its own.

    Args:
        cfa: the pattern of the RAW that it makes.
    """

    name: ClassVar[str]

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__()
        self.cfa = CFA(cfa)
        self.info: dict[str, Any] = {}

    def setting_of(self, white_balance: tuple[float, float, float]) -> Any:
        """The setting for as-shot multipliers R, G, B; None if the method makes no use of them."""
        return None

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to a mosaic ``(B, 1, H, W)`` under a random setting, if the method has any to draw."""
        return self.reverse(srgb)

    def learn(self, pairs: Sequence[FramePair], training: Training) -> tuple[int, float]:
        """Fit to the pairs and return the number of steps and the last loss; by default there is nothing to fit."""
        return 0, math.nan

    @abstractmethod
    def unprocess(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """Float sRGB ``(B, 3, H, W)`` to linear camera colour ``(B, 3, H, W)``, not clipped."""

    def reverse(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides, to the mosaic ``(B, 1, H, W)`` in [0, 1]."""
        return bayer.mosaic(self.unprocess(as_float(srgb), setting).clamp(0.0, 1.0), self.cfa)


class Crops(NamedTuple):
    """A training batch, in the CFA of the model: sRGB ``(B, 3, H, W)``, mosaics ``(B, 1, H, W)``."""

    srgb: Tensor
    raw: Tensor


class CropTrainedISP(BaselineISP):
    """A network that learns by gradient descent on random crops.

    ``reverse_network`` maps sRGB to camera colour; the published numbers of parameters count it alone.
    """

    reverse_network: nn.Module
    learning_rate: ClassVar[float]
    """Adam's learning rate at the start."""

    def unprocess(self, srgb: Tensor, setting: Any = None) -> Tensor:
        """sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape, by ``reverse_network``."""
        made: Tensor = self.reverse_network(srgb)
        return made

    def loss(self, crops: Crops) -> Tensor:
        """The :meth:`raw_error` of a batch, which training lowers."""
        return self.raw_error(bayer.mosaic(self.unprocess(crops.srgb), self.cfa), crops.raw)

    def raw_error(self, predicted: Tensor, raw: Tensor) -> Tensor:
        """The error of predicted mosaics ``(B, 1, H, W)``, a scalar: by default l1."""
        return F.l1_loss(predicted, raw)

    def learn(self, pairs: Sequence[FramePair], training: Training) -> tuple[int, float]:
        """Train on crops; ValueError if there is no budget, or a pair is too small or not registered."""
        given = [limit for limit in (training.seconds, training.steps) if limit is not None]
        if not given or min(given) <= 0:
            raise ValueError(f"give seconds or steps above 0, got {training.seconds} and {training.steps}")
        require_crops(pairs, training.crop)
        self.train()
        parameters = [parameter for parameter in self.parameters() if parameter.requires_grad]
        start, done, value = time.perf_counter(), 0, math.nan
        descent = adam(
            parameters,
            self.learning_rate,
            lambda step: self.loss(random_crops(pairs, self.cfa, training, step, parameters[0].device)),
            lambda step: training.share_done(time.perf_counter() - start, step),
            clip_norm=CLIP_NORM,
        )
        bar = progress_bar(
            descent, label=f"fit {self.name}", unit="step", total=training.steps, shown=training.progress
        )
        for loss in bar:
            done, value = done + 1, loss.item()
            bar.set_postfix_str(f"loss {value:.2e}, {time.perf_counter() - start:.0f} s", refresh=False)
        return done, value


def require_crops(pairs: Sequence[FramePair], side: int) -> None:
    """Raise ValueError unless every pair is registered, and has room for a crop wherever its pattern begins."""
    for pair in pairs:
        if not pair.registered:
            raise ValueError(f"{pair.name}: RAW and sRGB are not registered pixel by pixel, which crops need")
        if min(pair.raw.shape[-2:]) < side + 2:
            height, width = pair.raw.shape[-2:]
            raise ValueError(f"{pair.name}: {height} x {width} is smaller than {side + 2}; use a smaller crop")


def random_crops(
    pairs: Sequence[FramePair], cfa: CFA, training: Training, step: int, device: torch.device | str = "cpu"
) -> Crops:
    """The batch of a step, the same for the same seed and step.

    Args:
        pairs: registered frames of any pattern.
        cfa: the pattern in which all crops arrive.
        training: says the crops' number, side and seed.
        step: counts from 0.
        device: where the batch is put.
    """
    generator = keyed_generator(training.seed, "baseline crops", step)
    crop = bayer.RandomCrop(training.crop)

    def draw() -> Iterator[Crops]:
        for k in torch.randint(len(pairs), (training.batch,), generator=generator).tolist():
            pair = pairs[k]
            srgb, raw = (bayer.crop_to_cfa(image, CFA(pair.cfa), cfa) for image in (pair.srgb, pair.raw))
            corner = crop.sample(raw.shape[-2], raw.shape[-1], generator)
            yield Crops(as_float(crop.apply(srgb, corner)), crop.apply(raw, corner))

    return Crops(*(torch.stack(values).to(device) for values in zip(*draw(), strict=True)))


Model = TypeVar("Model", bound=BaselineISP)


def fit_baseline(model: Model, pairs: Sequence[FramePair], training: Training) -> Model:
    """Fit a method in place and return it in eval mode; ``model.info`` records frames, steps, seconds and loss.

    UPI as published has nothing to fit; tuned UPI is solved in closed form, whatever the budget.
    """
    if not pairs:
        raise ValueError("no RAW-sRGB pair to fit; give at least one RAW file")
    start = time.perf_counter()
    done, loss = model.learn(pairs, training)
    model.info = {"frames": [frame.name for frame in pairs], "seed": training.seed, "steps": done}
    model.info["seconds"] = round(time.perf_counter() - start, 2)
    if not math.isnan(loss):
        model.info["loss"] = loss
    return model.eval()
