"""The settings of a training: its network and its loop."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal


@dataclass
class DenoiserConfig:
    """The network.

    Args:
        name: UNet, DHDN, DnCNN, PMRID or NAFNet.
        settings: its constructor's keys.
        start: weights that training continues from: the name of a shipped denoiser or a file; name and settings are
            then the file's, unless they are given, and must agree with it. Null starts from nothing.
    """

    name: str = "UNet"
    settings: dict[str, Any] = field(default_factory=dict)
    start: str | None = None


@dataclass
class TrainConfig:
    """The training loop.

    Args:
        steps: optimiser steps, the same in every arm.
        batch: samples in a step, over all processes.
        crop: side of the mosaic crops in pixels.
        learning_rate: of Adam at its highest.
        warmup: steps of linear warm-up.
        schedule: of the rate after it: cosine, to 1%, or step, a halving every ``halve_every`` steps.
        halve_every: steps.
        loss: l1, l2 or charbonnier.
        weigh: how the loss weighs light and shade: linear, stabilised or mixed; see :mod:`rawaug.training.criteria`.
        ema: decay of the running average of the weights, which is what is validated and saved; 0 switches it off.
        clip_norm: largest norm of the gradient; 0 switches it off.
        validate_every: steps between two looks at the validation pairs, the best weights on which are kept.
        checkpoint_every: steps between two checkpoints (a killed run goes on from the last).
        workers: processes that prepare samples; 0 prepares them in the training process.
        precision: Fabric's, such as 32-true or bf16-mixed.
        channels_last: memory format of the network.
        compile: torch.compile the network.
    """

    steps: int = 1500
    batch: int = 8
    crop: int = 64
    learning_rate: float = 7e-4
    warmup: int = 50
    schedule: Literal["cosine", "step"] = "cosine"
    halve_every: int = 20000
    loss: Literal["l1", "l2", "charbonnier"] = "l1"
    weigh: Literal["linear", "stabilised", "mixed"] = "linear"
    ema: float = 0.99
    clip_norm: float = 0.1
    validate_every: int = 100
    checkpoint_every: int = 200
    workers: int = 0
    precision: str = "32-true"
    channels_last: bool = True
    compile: bool = False

    def __post_init__(self) -> None:
        for key in ("steps", "batch", "halve_every", "validate_every", "checkpoint_every"):
            if getattr(self, key) < 1:
                raise ValueError(f"train.{key} is at least 1, got {getattr(self, key)}")
        if self.crop < 8 or self.crop % 2:
            raise ValueError(f"train.crop is even and at least 8, got {self.crop}")
        if not 0.0 <= self.ema < 1.0 or min(self.warmup, self.workers, self.clip_norm) < 0:
            raise ValueError("train: ema is in [0, 1), and warmup, workers and clip_norm are at least 0")
