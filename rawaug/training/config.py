"""The settings of a training, its network and its loop, and those of them that the weights depend on."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Interval

from denoisers.network import DENOISERS
from rawaug.registry import require_bounds
from rawaug.training.losses import LOSSES

MOST = 2**31
"""Settings that are numbers of steps, samples or processes are at most this."""

VALIDATIONS = 5
"""A short training has this many validations, which are the points of its curves."""

Count = Annotated[int, Interval(ge=1, le=MOST)]
"""A number of steps, samples, frames or processes."""

Rate = Annotated[float, Interval(ge=0.0, le=float(MOST))]
"""A learning rate, or another limit of a step."""

Decay = Annotated[float, Interval(ge=0.0, lt=1.0)]
"""A share of what was before, which must leave room for what comes."""

Weighing = Literal["linear", "normalised", "stabilised", "mixed", "relative"]
"""The loss weighs light and shade in one of these ways; :mod:`rawaug.training.weighing` has the formulas."""


@dataclass
class DenoiserConfig:
    """The network.

    Args:
        name: name of the network; one other than the recipe's has its own settings.
        settings: keys of its constructor.
        start: weights that training continues from: the name of a shipped denoiser or a file. Name and settings are
            then the file's; if they are given, they must agree with it. Null starts from random weights.
    """

    name: str = field(default="UNet", metadata={"registry": DENOISERS})
    settings: dict[str, Any] = field(default_factory=dict)
    start: str | None = None

    def __post_init__(self) -> None:
        DENOISERS[self.name]  # an unknown name is answered with the nearest


SAME_WEIGHTS = frozenset({"workers", "compile", "checkpoint_every", "logger"})
"""These keys of :class:`TrainConfig` change the speed of a training, but not its weights."""


@dataclass
class TrainConfig:
    """The training loop.

    Args:
        steps: optimiser steps, the same in every arm.
        batch: samples in a step, over all processes.
        crop: side of the mosaic crops in pixels.
        learning_rate: peak learning rate of Adam.
        warmup: steps of linear warm-up.
        schedule: schedule of the learning rate after warm-up: cosine, down to 1%, or step, halved every ``halve_every``
            steps.
        halve_every: steps between halvings.
        loss: l1, l2, rms or log_mse, or {name, settings}.
        weigh: loss weighting of light and shade: linear, normalised, stabilised, mixed or relative,
            see :mod:`rawaug.training.weighing`.
        ema: decay of the running average of the weights, which are validated and saved; 0 disables it.
        start_share: share of the weights that the training started from in those that are validated and saved, from 0
            up to 1. A fine-tuned network forgets part of what its start knew about other pictures; between the two lie
            networks that know both (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022).
        clip_norm: gradient norm limit; 0 disables it.
        validate_every: steps between validations; the best weights are kept. A training with no more steps than that is
            validated five times.
        checkpoint_every: steps between checkpoints, from which a killed run resumes.
        workers: processes that prepare samples; 0 prepares them in the training process. On CUDA they read and cut
            pictures, and the GPU makes RAW of them, if ``augmented`` is 1.
        precision: Fabric's precision, such as 32-true or bf16-mixed.
        channels_last: memory format of the network.
        compile: torch.compile the network; on CUDA its steps are launched as graphs.
        logger: where loss and validation are logged besides ``log.csv``: tensorboard, wandb or csv; null for nowhere.
    """

    steps: Count = 1500
    batch: Count = 8
    crop: Annotated[int, Interval(ge=8, le=MOST)] = 64
    learning_rate: Rate = 7e-4
    warmup: Annotated[int, Interval(ge=0, le=MOST)] = 50
    schedule: Literal["cosine", "step"] = "cosine"
    halve_every: Count = 20000
    loss: str | dict[str, Any] = "l1"
    weigh: Weighing = "linear"
    ema: Decay = 0.99
    start_share: Decay = 0.0
    clip_norm: Rate = 0.1
    validate_every: Count = 100
    checkpoint_every: Count = 200
    workers: Annotated[int, Interval(ge=0, le=MOST)] = 0
    precision: str = "32-true"
    channels_last: bool = True
    compile: bool = False
    logger: Literal["tensorboard", "wandb", "csv"] | None = None

    def __post_init__(self) -> None:
        require_bounds(self, "train.")
        try:
            LOSSES.make(self.loss)
        except ValueError as error:
            raise ValueError(f"train.loss: {error}") from None

        if self.crop % 2:
            raise ValueError(f"train.crop must be even, got {self.crop}")

    @property
    def validation_period(self) -> int:
        """Steps between validations. A training too short for two of them has :data:`VALIDATIONS`."""
        if self.steps > self.validate_every:
            return self.validate_every

        return max(1, self.steps // VALIDATIONS)

    def weights_settings(self, validated: bool) -> dict[str, Any]:
        """Collect the keys that the weights depend on; ``validated`` says whether validation frames choose them."""
        irrelevant = SAME_WEIGHTS if validated else SAME_WEIGHTS | {"validate_every"}
        return {key: value for key, value in asdict(self).items() if key not in irrelevant}
