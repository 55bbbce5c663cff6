"""Recipes: one dataclass per part, every key explained; read from YAML by jsonargparse, an unknown key is an error."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from rawaug.isp.fit import FitConfig


@dataclass
class DataConfig:
    """Where pictures come from.

    Args:
        pairs: the few real RAW-sRGB pairs: a folder of RAW files, or ``kind:path``.
        count: how many of them are used; all if null.
        pictures: the sRGB pictures to augment with: a folder, or ``demo:``.
        validation: pairs on which training is watched.
        test: pairs on which the result is measured; no stage sees them before.
    """

    pairs: str = "demo:train"
    count: int | None = None
    pictures: str = "demo:"
    validation: str = "demo:validation"
    test: str = "demo:test"


@dataclass
class DenoiserConfig:
    """The network.

    Args:
        name: UNet, DHDN or DnCNN.
        settings: its constructor's keys.
    """

    name: str = "UNet"
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass
class TrainConfig:
    """The training loop.

    Args:
        steps: optimiser steps, the same in every arm.
        batch: samples in a step, over all processes.
        crop: side of the mosaic crops in pixels.
        learning_rate: of Adam at its highest.
        warmup: steps of linear warm-up before the cosine.
        loss: l1, l2 or charbonnier.
        ema: decay of the running average of the weights, which is what is validated and saved; 0 switches it off.
        clip_norm: largest norm of the gradient; 0 switches it off.
        validate_every: steps between two looks at the validation pairs; the best weights are kept.
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
    loss: Literal["l1", "l2", "charbonnier"] = "l1"
    ema: float = 0.99
    clip_norm: float = 0.1
    validate_every: int = 100
    checkpoint_every: int = 200
    workers: int = 0
    precision: str = "32-true"
    channels_last: bool = True
    compile: bool = False


@dataclass
class ArmConfig:
    """One way of training; arms differ in nothing else.

    Args:
        augmented: share of every batch that comes from sRGB pictures through the ISP, 0 to 1.
        sampling: convex, perturb or chosen, see :class:`rawaug.RawAugment`.
        strength: of ``perturb``.
    """

    augmented: float = 0.0
    sampling: Literal["convex", "perturb", "chosen"] = "convex"
    strength: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 <= self.augmented <= 1.0:
            raise ValueError(f"augmented is a share between 0 and 1, got {self.augmented}")


@dataclass
class Recipe:
    """A whole experiment.

    Args:
        name: of the folder in ``out`` that it writes.
        data: where pictures come from.
        isp: how the dictionary ISP is fitted.
        noise: preset of what is added to clean RAW, in training and where a test frame has no noisy capture.
        denoiser: the network.
        train: the loop.
        arms: by name, what is compared.
        seed: of the first run.
        seeds: how many runs, with seeds ``seed``, ``seed + 1``, ...; more than one gives mean and spread.
        device: auto, cpu, cuda, ...: Fabric's accelerator.
        devices: how many of them.
        out: folder of all runs.
    """

    name: str = "experiment"
    data: DataConfig = field(default_factory=DataConfig)
    isp: FitConfig = field(default_factory=FitConfig)
    noise: str = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    arms: dict[str, ArmConfig] = field(default_factory=dict)
    seed: int = 0
    seeds: int = 1
    device: str = "auto"
    devices: int = 1
    out: str = "runs"

    def __post_init__(self) -> None:
        if not self.arms:
            raise ValueError("arms: a recipe compares at least one way of training")
        if self.seeds < 1:
            raise ValueError(f"seeds is at least 1, got {self.seeds}")


def find_recipe(name: str) -> Path:
    """A recipe's path: the file itself, or one that travels with the package, with or without ``.yaml``.

    Raises:
        FileNotFoundError: naming those there are.
    """
    path = Path(name)
    if path.is_file():
        return path
    shipped = Path(str(resources.files("rawaug"))) / "recipes"
    folder = shipped if shipped.is_dir() else Path(__file__).parents[2] / "recipes"
    candidate = folder / f"{path.stem}.yaml"
    if path.parent == Path() and candidate.is_file():
        return candidate
    known = ", ".join(sorted(p.stem for p in folder.glob("*.yaml")))
    raise FileNotFoundError(f"{name}: no such recipe file, and none of the shipped recipes ({known})")
