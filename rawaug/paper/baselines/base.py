r"""What the methods that the dictionary ISP is compared with have in common, and how they are fitted.

``y = mosaic(u(x))``, u being the method: sRGB ``x`` ``(B, 3, H, W)`` becomes linear camera colour of the same size, of
which the mosaic keeps one channel a site. Whatever a method predicts, RAW and sRGB leave it within [0, 1]; training
sees the values as they are.

One loop fits all that learn by descent, each with its own loss, on random crops of the pairs. A step draws ``batch``
frames and as many crops from a generator keyed by the seed and the step's number. The crops start where the frame's CFA
is that of the model, so frames of any pattern train one model. The learning rate falls to 0 by half a cosine over the
budget, whichever of the two, seconds or steps, is further spent. Given steps alone, the same seed gives the same
weights.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.config import ReverseISP
from rawaug.isp.fit.descent import adam
from rawaug.isp.fit.samples import FramePair
from rawaug.isp.stages import as_float
from rawaug.progress import progress as progress_bar
from rawaug.seeding import keyed_generator


class BaselineISP(ReverseISP):
    """A method that the dictionary ISP is compared with; ``cfa`` is the pattern of the RAW that it makes and takes."""

    trainable: ClassVar[bool]
    """Whether :func:`fit_baseline` changes anything in it."""

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__()
        self._cfa = CFA(cfa)

    @property
    def cfa(self) -> CFA:
        return self._cfa

    @property
    def reverse_network(self) -> nn.Module:
        """The part that the reverse pass uses: what the published numbers of parameters count."""
        return self

    @property
    def reverse_parameters(self) -> int:
        return sum(parameter.numel() for parameter in self.reverse_network.parameters())

    @abstractmethod
    def unprocess(self, srgb: Tensor) -> Tensor:
        """Float sRGB ``(B, 3, H, W)`` to linear camera colour ``(B, 3, H, W)``, not clipped."""

    def render(self, raw: Tensor) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``, not clipped; overridden where the method has it."""
        raise ValueError(
            f"{self.name} only converts sRGB to RAW; rawaug.paper.baselines lists the methods that also render RAW"
        )

    def reverse(self, srgb: Tensor) -> Tensor:
        """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides, to the mosaic ``(B, 1, H, W)`` in [0, 1]."""
        return self.to_mosaic(self.unprocess(checked_srgb(srgb)))

    def make(self, srgb: Tensor, setting: Any = None, place: Tensor | None = None) -> Tensor:
        return self.reverse(srgb)

    def forward(self, raw: Tensor) -> Tensor:
        """RAW mosaic ``(B, 1, H, W)`` in :attr:`cfa` to sRGB ``(B, 3, H, W)`` in [0, 1]."""
        return self.render(checked_raw(raw)).clamp(0.0, 1.0)

    def cycle(self, srgb: Tensor) -> Tensor:
        return self.forward(self.reverse(srgb))

    def to_mosaic(self, linear: Tensor) -> Tensor:
        """Linear colour ``(B, 3, H, W)`` to the mosaic ``(B, 1, H, W)``, clipped to [0, 1]."""
        return bayer.mosaic(linear.clamp(0.0, 1.0), self.cfa)


class Crops(NamedTuple):
    """A training batch, in the CFA of the model that is trained."""

    srgb: Tensor
    raw: Tensor
    white_balance: Tensor


class CropTrainedISP(BaselineISP):
    """A network that learns by gradient descent on random crops."""

    trainable = True
    learning_rate: ClassVar[float]
    """For Adam, at the start."""

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        """Set from the pairs what descent does not learn; called once, before training."""

    @abstractmethod
    def loss(self, crops: Crops, both: bool) -> Tensor:
        """The method's own loss, a scalar; ``both``: of the two directions where it has them, else of the reverse."""


def checked_srgb(srgb: Tensor) -> Tensor:
    """``(B, 3, H, W)``, uint8 or float, as float in [0, 1]."""
    if srgb.ndim != 4 or srgb.shape[1] != 3:
        raise ValueError(f"sRGB must have shape (B, 3, H, W), got {tuple(srgb.shape)}")
    if srgb.dtype != torch.uint8 and not srgb.is_floating_point():
        raise ValueError(f"sRGB must be uint8 or float in [0, 1], got {srgb.dtype}")
    if srgb.shape[2] % 2 or srgb.shape[3] % 2:
        raise ValueError(
            f"a Bayer mosaic must have even sides, got sRGB of {tuple(srgb.shape[2:])}; crop a row or column"
        )
    return as_float(srgb)


def checked_raw(raw: Tensor) -> Tensor:
    """``(B, 1, H, W)`` with even sides."""
    if raw.ndim != 4 or raw.shape[1] != 1:
        raise ValueError(f"a mosaic must have shape (B, 1, H, W), got {tuple(raw.shape)}")
    if raw.shape[2] % 2 or raw.shape[3] % 2:
        raise ValueError(
            f"a Bayer mosaic must have even sides, got {tuple(raw.shape[2:])}; crop the last row or column"
        )
    return raw


Model = TypeVar("Model", bound=BaselineISP)

CLIP_NORM = 1.0
"""The gradient's largest norm: short fits need high rates, at which the U-Net blows up without."""


def fit_baseline(
    model: Model,
    pairs: Sequence[FramePair],
    seconds: float | None = None,
    steps: int | None = None,
    *,
    crop: int = 128,
    batch: int = 4,
    learning_rate: float | None = None,
    both: bool = True,
    seed: int = 0,
    progress: bool = True,
) -> Model:
    """Fit a baseline in place; ``model.info`` records the steps, the seconds and the last loss.

    UPI as published has nothing to fit: it comes back as it is, after 0 steps. Tuned UPI is solved in closed form, in
    one step, whatever the budget.

    Args:
        model: one of :data:`rawaug.paper.baselines.BASELINES`, on any device.
        pairs: frames; read once and kept in memory.
        seconds: stop after these, reading not counted; the step under way is finished.
        steps: stop after these. At least one of the two is given, and one step is done in any case.
        crop: side of the crops, even.
        batch: crops a step.
        learning_rate: at the start; the model's own by default.
        both: also train the forward pass where the method has one.
        seed: of the crops.
        progress: show a progress bar.

    Raises:
        ValueError: if there is no budget or no pair, or a frame is smaller than a crop or not registered.
    """
    frames = list(pairs)
    if not frames:
        raise ValueError("no RAW-sRGB pair to fit; give at least one RAW file")
    start = time.perf_counter()
    steps_done, loss = 0, math.nan
    if isinstance(model, SolvedISP):
        model.tune(frames, seed)
        steps_done = 1
    elif isinstance(model, CropTrainedISP):
        budget, draw = _Budget(seconds, steps), _CropDrawer(frames, model.cfa, crop, batch, seed)
        model.prepare(frames)
        steps_done, loss = _descend(model, draw, budget, learning_rate, both, progress)
    model.info = {"frames": [frame.name for frame in frames], "seed": seed, "steps": steps_done}
    model.info["seconds"] = round(time.perf_counter() - start, 2)
    if not math.isnan(loss):
        model.info["loss"] = loss
    return model.eval()


@runtime_checkable
class SolvedISP(Protocol):
    """A method that is solved in closed form."""

    def tune(self, pairs: Sequence[FramePair], seed: int = 0) -> Any:
        """Solve for what it learns from the pairs."""


@dataclass(frozen=True)
class _Budget:
    """Seconds, steps, or both."""

    seconds: float | None
    steps: int | None

    def __post_init__(self) -> None:
        given = [limit for limit in (self.seconds, self.steps) if limit is not None]
        if not given or min(given) <= 0:
            raise ValueError(f"give seconds or steps above 0, got seconds={self.seconds}, steps={self.steps}")

    def spent(self, seconds: float, steps: int) -> float:
        """The part of the budget that is used up, of that limit which is nearer."""
        by_time = 0.0 if self.seconds is None or not steps else seconds / self.seconds  # one step is done in any case
        by_steps = 0.0 if self.steps is None else steps / self.steps
        return max(by_time, by_steps)


@dataclass(frozen=True)
class _CropDrawer:
    """Random crops of frames, keyed by the step, in one CFA."""

    frames: Sequence[FramePair]
    cfa: CFA
    side: int
    batch: int
    seed: int

    def __post_init__(self) -> None:
        if self.side < 2 or self.side % 2 or self.batch < 1:
            raise ValueError(f"crop must be even and batch at least 1, got crop {self.side}, batch {self.batch}")
        for frame in self.frames:
            height, width = frame.raw.shape[-2:]
            if not frame.registered:
                raise ValueError(f"{frame.name}: RAW and sRGB are not registered pixel by pixel, which crops need")
            if min(height, width) < self.side + 2:
                needed = self.side + 2
                raise ValueError(f"{frame.name}: {height} x {width} is smaller than {needed}; use a smaller crop")

    def __call__(self, step: int, device: torch.device) -> Crops:
        generator = keyed_generator(self.seed, "baseline crops", step)
        chosen = torch.randint(len(self.frames), (self.batch,), generator=generator).tolist()
        places = torch.rand(self.batch, 2, generator=generator).tolist()
        cuts = [self._cut(self.frames[k], *place) for k, place in zip(chosen, places, strict=True)]
        return Crops(*(torch.stack(values).to(device) for values in zip(*cuts, strict=True)))

    def _cut(self, frame: FramePair, *place: float) -> Crops:
        """One crop of a frame at ``place`` in [0, 1)^2 of where it can be, without the leading dimension."""
        shift = CFA(frame.cfa).shift_to(self.cfa)
        free = ((size - self.side) // 2 for size in frame.raw.shape[-2:])
        top, left = (first + 2 * int(part * room) for first, part, room in zip(shift, place, free, strict=True))
        window = (..., slice(top, top + self.side), slice(left, left + self.side))
        return Crops(as_float(frame.srgb[window]), frame.raw[window], torch.tensor(frame.white_balance))


def _descend(
    model: CropTrainedISP,
    draw: _CropDrawer,
    budget: _Budget,
    learning_rate: float | None,
    both: bool,
    progress: bool,
) -> tuple[int, float]:
    """Adam until the budget is spent; the number of steps and the last loss."""
    model.train()
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    rate = model.learning_rate if learning_rate is None else learning_rate
    start, done, value = time.perf_counter(), 0, math.nan
    descent = adam(
        parameters,
        rate,
        lambda step: model.loss(draw(step, parameters[0].device), both),
        lambda step: budget.spent(time.perf_counter() - start, step),
        clip_norm=CLIP_NORM,
    )
    bar = progress_bar(descent, label=f"fit {model.name}", unit="step", total=budget.steps, shown=progress)
    for _, loss in bar:
        done, value = done + 1, loss.item()
        bar.set_postfix_str(f"loss {value:.2e}, {time.perf_counter() - start:.0f} s", refresh=False)
    return done, value
