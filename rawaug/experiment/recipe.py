"""Recipes: one dataclass per part, every key explained; read from YAML by jsonargparse, an unknown key is an error."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from rawaug.isp.fit import FitConfig
from rawaug.training.train_config import DenoiserConfig, TrainConfig


@dataclass
class DataConfig:
    """Where pictures come from.

    Args:
        pairs: the few real RAW-sRGB pairs: a folder of RAW files, or ``kind:path``; null if there are none.
        count: how many of them are used; all if null.
        pictures: the sRGB pictures to augment with: a folder, or ``demo:``.
        memory_mb: pictures are kept in memory once decoded, up to so many megabytes.
        validation: pairs on which training is watched, of which self-supervised arms see the noisy frames alone; null
            watches it on RAW made from the pictures, which chooses no weights: those of the end are kept.
        validation_crop: side of the middle of each validation frame that is looked at; null for the whole frame.
        test: pairs on which the result is measured; no stage sees them before.
        test_count: how many of them are used; all if null.
    """

    pairs: str | None = "demo:train"
    count: int | None = None
    pictures: str = "demo:"
    memory_mb: int = 0
    validation: str | None = "demo:validation"
    validation_crop: int | None = None
    test: str = "demo:test"
    test_count: int | None = None


@dataclass
class ArmConfig:
    """One way of training; arms differ in nothing else.

    Args:
        augmented: share of every batch that comes from sRGB pictures through the ISP, 0 to 1.
        sampling: convex, perturb or chosen, see :class:`rawaug.RawAugment`; or published, cameras, lights and tone
            curves from the tables of the package, see :mod:`rawaug.isp.camera_sampling`.
        zoom: of published: pictures are enlarged up to this factor, half of the time; 1 for none.
        strength: of ``perturb``.
        exposure: lowest and highest exposure of the RAW in stops.
        estimator: what is learned from: supervised has clean targets; the others know noisy frames alone, see
            :mod:`rawaug.training.estimators`.
        alpha: of noisier and r2r: strength of the extra noise.
        correct: of noisier: extrapolate the result, which takes its bias away.
        gamma: of neighbor2neighbor: weight of its second term.
        denoiser: this arm's network, in place of the recipe's; ``{start: rawaug-small}`` fine-tunes a shipped one.
        learning_rate: in place of ``train.learning_rate``; null takes that one.
    """

    augmented: float = 0.0
    sampling: Literal["convex", "perturb", "chosen", "published"] = "convex"
    zoom: float = 1.0
    strength: float = 0.1
    exposure: tuple[float, float] = (0.0, 0.0)
    estimator: Literal["supervised", "noisier", "noise2noise", "r2r", "neighbor2neighbor"] = "supervised"
    alpha: float = 1.0
    correct: bool = False
    gamma: float = 1.0
    denoiser: DenoiserConfig | None = None
    learning_rate: float | None = None

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
        camera: an ISP that is taken as it is, the name of a shipped one or a file; null fits one to ``data.pairs``.
        noise: what is added to clean RAW, in training and where a test frame has no noisy capture: the name of a preset
            or of a camera, a list of names of which each picture draws one, [shot_var, read_var], or "camera", the
            levels measured on the frames that the ISP is fitted to.
        denoiser: the network.
        train: the loop.
        arms: by name, what is compared; all supervised, or all self-supervised (then no stage sees a clean frame).
        classical: classical denoisers to compare with, such as Wavelet; see :mod:`denoisers.classical`. BM3D is left
            out, with a line that says so, where its wheel is not installed.
        untouched: trained denoisers to compare with as they are: names of shipped ones, or files.
        seed: of the first run.
        steps: optimiser steps, in place of ``train.steps``.
        seeds: how many runs, with seeds ``seed``, ``seed + 1``, ...; more than one gives mean and spread.
        device: auto, cpu, cuda, ...: Fabric's accelerator.
        devices: how many of them.
        out: folder of all runs.
    """

    name: str = "experiment"
    data: DataConfig = field(default_factory=DataConfig)
    isp: FitConfig = field(default_factory=FitConfig)
    camera: str | None = None
    noise: tuple[float, float] | str | list[str] = "cycleisp_sidd"
    denoiser: DenoiserConfig = field(default_factory=DenoiserConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    arms: dict[str, ArmConfig] = field(default_factory=dict)
    classical: list[str] = field(default_factory=list)
    untouched: list[str] = field(default_factory=list)
    steps: int | None = None
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
        if self.steps is not None:
            self.train = replace(self.train, steps=self.steps)
        if self.data.pairs is None and self.camera is None:
            raise ValueError("data.pairs: an ISP is fitted to pairs; give some, or camera: universal")
        if self.data.pairs is None and any(arm.augmented < 1.0 for arm in self.arms.values()):
            raise ValueError("data.pairs: without real pairs every arm has augmented: 1")
        supervised = [arm.estimator == "supervised" for arm in self.arms.values()]
        if any(supervised) and not all(supervised):
            raise ValueError("arms: supervised and self-supervised do not mix, since these must see no clean frame")

    def network_of(self, arm: str) -> DenoiserConfig:
        """The arm's network, else the recipe's."""
        return self.arms[arm].denoiser or self.denoiser

    def loop_of(self, arm: str) -> TrainConfig:
        """How the arm is trained."""
        rate = self.arms[arm].learning_rate
        return self.train if rate is None else replace(self.train, learning_rate=rate)

    @property
    def self_supervised(self) -> bool:
        """Whether noisy frames are all that may be seen."""
        return all(arm.estimator != "supervised" for arm in self.arms.values())


def smoke(recipe: Recipe) -> Recipe:
    """The recipe in a few seconds: its stages and arms on the demo camera, a tiny network, a few steps, the CPU.

    No trained denoiser is read: what would continue from one starts from nothing.
    """
    tiny: dict[str, dict[str, Any]] = {
        "UNet": {"width": 4, "scales": 2},
        "DHDN": {"width": 4},
        "DnCNN": {"width": 8, "depth": 3},
        "PMRID": {"width": 2},
        "NAFNet": {"width": 4, "encoder": [1], "middle": 1, "decoder": [1]},
    }
    name = recipe.denoiser.name
    few = TrainConfig(steps=4, batch=4, crop=32, warmup=1, validate_every=2, checkpoint_every=2, workers=0)
    return replace(
        recipe,
        name=f"{recipe.name.replace('/', '-')}-smoke",
        data=replace(
            DataConfig(count=1, test_count=1),
            pairs=recipe.data.pairs and "demo:train",
            validation=recipe.data.validation and "demo:validation",
        ),
        isp=replace(recipe.isp, steps=2, pixels=512, batch=128),
        denoiser=DenoiserConfig(name, tiny.get(name, {})),
        train=replace(few, loss=recipe.train.loss),
        arms={label: replace(arm, denoiser=None) for label, arm in recipe.arms.items()},
        untouched=[],
        steps=None,
        seeds=1,
        device="cpu",
        devices=1,
    )


def find_recipe(name: str) -> Path:
    """A recipe's path: the file itself, or one that travels with the package, with or without ``.yaml``.

    Raises:
        FileNotFoundError: naming those there are.

    Example:
        >>> find_recipe("sidd/fewshot").name
        'fewshot.yaml'
    """
    path = Path(name)
    if path.is_file():
        return path
    shipped = Path(str(resources.files("rawaug"))) / "recipes"
    folder = shipped if shipped.is_dir() else Path(__file__).parents[2] / "recipes"
    known = {file.relative_to(folder).with_suffix("").as_posix(): file for file in sorted(folder.rglob("*.yaml"))}
    wanted = path.with_suffix("").as_posix() if path.suffix == ".yaml" else path.as_posix()
    if wanted in known:
        return known[wanted]
    raise FileNotFoundError(f"{name}: no such recipe file, and none of the shipped recipes ({', '.join(known)})")
