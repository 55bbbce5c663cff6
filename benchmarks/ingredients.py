"""What single ingredients of a RAW denoiser are worth: short trainings of equal time that differ in one of them.

    python -m benchmarks.ingredients TABLE.json --pictures PHOTOS --minutes 2 --seeds 3

Every arm is a small network that is trained from random weights on pictures as RAW, with the noise of the recipe
``base``, for the same time of one thread: what makes a step slower costs steps. The first arm is the reference. Each of
the others differs from it in one thing; the last two take the RAW as it is, neither transformed nor mended and without
limits, one with a noise map, one told nothing. Scores are PSNR in RAW on the middles of ``real:validation`` at the four
strengths of ``rawaug benchmark``.

An arm's steps are timed once, and all of its seeds have that many. The arms of a seed see the same pictures and the
same noise as far as their settings allow. Figures go to the file as they come, all arms of one seed before those of the
next, and what stands there is not trained again.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import fmean, stdev
from typing import Any, Unpack

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.measure import parser
from benchmarks.strengths import frozen_trials
from denoisers.drunet import DRUNet, ResidualUNet, Size
from denoisers.layers import PACKED
from denoisers.network import DENOISERS, Shared
from rawaug.data import open_pictures
from rawaug.data.frames import Cached
from rawaug.evaluation.benchmark import STRENGTHS
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial
from rawaug.experiment.recipe import find_recipe, read_recipe
from rawaug.noise import NoiseModel, noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train
from rawaug.training.sources import PictureCrops
from rawaug.training.stream import TrainingStream

VALIDATION = "real:validation"
MIDDLE = 384
"""Side in pixels of the mosaic of what is scored of each frame."""

ZOOM = 6.0
"""Half of the crops are enlarged up to so many times, as in the recipe."""

SIDE = 256
"""Packed pixels on the side of the picture by which a network's work is counted."""

PROBE = 20
"""Number of steps that are timed."""

POINTS = 5
"""Number of validations of a training: the points of its curve."""

CACHE_MB = 1024
"""Size of the cache of decoded pictures."""

Table = dict[str, dict[str, Any]]
"""By arm its ``steps``, its ``gmac`` a mosaic megapixel, and by seed its ``runs``: their ``seconds`` and ``curve``."""


# -- networks that only this table has ---------------------------------------------------------------------------------


@DENOISERS.register("RepeatedDRUNet")
class RepeatedDRUNet(DRUNet):
    """A DRUNet that runs several times with the same weights and is given back what it has corrected so far.

    Args:
        repeats: times that it runs.
        width, scales, blocks, limits, mend: see :class:`denoisers.DRUNet`.
    """

    def __init__(
        self,
        repeats: int = 2,
        width: int = 16,
        scales: int = 4,
        blocks: int = 1,
        limits: bool = False,
        mend: bool = False,
        **shared: Unpack[Shared],
    ) -> None:
        super().__init__(width, scales, blocks, limits, mend, **shared)
        self.repeats = repeats
        self.config["repeats"] = repeats

    @property
    def inputs(self) -> int:
        """Channels that enter the first layer: the correction so far is one more picture."""
        return super().inputs + self.channels

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, channels, h, w)``, the sum of those of all runs."""
        signal = features[:, : self.channels]
        maps = features[:, self.channels :]

        correction = torch.zeros_like(signal)
        for _ in range(self.repeats):
            inputs = torch.cat([signal + correction, maps, correction], dim=1)
            correction = correction + self.tail(self.body(inputs))
        return correction


@DENOISERS.register("FullSizeDRUNet")
class FullSizeDRUNet(ResidualUNet):
    """A DRUNet of packed RAW with one more scale above its finest: that of the mosaic, all sites in one plane.

    The mean that is subtracted is that of each colour, over the same cells of 8 x 8 packed pixels.

    Args:
        width: features of the mosaic's scale, half of those of a DRUNet, which makes both scales cost the same.
        scales: one more than those of a DRUNet.
        blocks, limits, mend: see :class:`denoisers.DRUNet`.
    """

    def __init__(
        self,
        width: int = 8,
        scales: int = 5,
        blocks: int = 1,
        limits: bool = False,
        mend: bool = False,
        **shared: Unpack[Shared],
    ) -> None:
        super().__init__({}, Size(width, scales, blocks), limits, mend, **shared)
        self.multiple //= 2  # in packed pixels
        self.stride //= 2

        self.add_layers(self.inputs // PACKED, PACKED, 1)
        self.initialise(self.seed, self.tail, *self.block_ends(), gain=1.0)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the correction ``(B, 4, h, w)`` from features ``(B, inputs, h, w)``."""
        signal = features[:, :PACKED]
        maps = features[:, PACKED:]

        mean = F.avg_pool2d(signal, self.cell // 2)
        light = F.interpolate(mean, signal.shape[-2:], mode="bilinear")
        mosaics = F.pixel_shuffle(torch.cat([signal - light, maps], dim=1), 2)

        coarse = 0.5 * self.wide_signal(mean)  # cells have half as many packed pixels on a side
        correction = self.tail(self.trunk(self.head(mosaics), self.coarse(coarse)))
        return F.pixel_unshuffle(correction, 2)


# -- arms --------------------------------------------------------------------------------------------------------------

SMALL: dict[str, Any] = {"width": 16, "blocks": 1}
TOLD_LEVELS: dict[str, Any] = {"limits": True, "mend": True, "variance_map": False, "domain": "anscombe"}
"""Settings of the recipe's network: the levels of the noise choose the transform in which it works."""


@dataclass(frozen=True)
class Arm:
    """One way of training.

    Attributes:
        network: its name.
        settings: of the network.
        train: settings of the loop that differ from the reference's.
        noise: settings of the noise that differ from the recipe's.
    """

    network: str = "DRUNet"
    settings: Mapping[str, Any] = field(default_factory=lambda: SMALL | TOLD_LEVELS)
    train: Mapping[str, Any] = field(default_factory=dict)
    noise: Mapping[str, Any] = field(default_factory=dict)


ARMS = {
    "reference": Arm(),
    "2 turns, same weights": Arm("RepeatedDRUNet", {"repeats": 2} | SMALL | TOLD_LEVELS),
    "4 turns, same weights": Arm("RepeatedDRUNet", {"repeats": 4} | SMALL | TOLD_LEVELS),
    "full-size mosaic": Arm("FullSizeDRUNet", TOLD_LEVELS),
    "4 blocks at the finest scale": Arm(settings=SMALL | TOLD_LEVELS | {"blocks": [4, 1, 1, 1]}),
    "phone noise alone": Arm(noise={"levels": ["cycleisp_sidd"]}),
    "log_mse": Arm(train={"loss": "log_mse"}),
    "batch 8": Arm(train={"batch": 8}),
    "told by a noise map": Arm(settings=SMALL),
    "the same, blind": Arm(settings=SMALL | {"variance_map": False}),
}
"""The arms by name; the first is the reference."""


def loop_settings(arm: Arm, steps: int, precision: str) -> TrainConfig:
    """The settings of a training of so many steps."""
    settings: dict[str, Any] = {
        "steps": steps,
        "batch": 2,
        "crop": 128,
        "learning_rate": 1e-3,
        "warmup": min(50, steps // 4),
        "weigh": "mixed",
        "clip_norm": 1.0,
        "validate_every": steps // POINTS,
        "checkpoint_every": steps,
        "precision": precision,
    }
    return TrainConfig(**{**settings, **arm.train})


def noise_of(arm: Arm) -> NoiseModel:
    """The noise of the recipe ``base``, with the settings of an arm."""
    noise = read_recipe(find_recipe("base"))["noise"]
    settings = {**noise["settings"], **arm.noise}
    return noise_model({"name": noise["name"], "settings": settings})


def train_arm(
    arm: Arm, pictures: Any, validation: Sequence[Trial], config: TrainConfig, seed: int
) -> tuple[float, list[dict[str, float]]]:
    """Train an arm.

    Returns:
        The seconds of processor time that it took, and the rows of its log.
    """
    augment = RawAugment.from_pretrained("universal", noise=noise_of(arm))
    crops = PictureCrops(RawPairs(pictures, augment, config.crop, zoom=ZOOM))
    stream = TrainingStream(None, crops, config.batch, 1.0, seed)
    network = DenoiserConfig(arm.network, dict(arm.settings))

    with tempfile.TemporaryDirectory() as folder:
        began = time.process_time()
        train(stream, validation, network, config, Path(folder), seed, device="cpu", choose=False)
        seconds = time.process_time() - began
        with (Path(folder) / "log.csv").open() as log:
            rows = list(csv.DictReader(log))

    curve = []
    for row in rows:
        curve.append({key: float(value) for key, value in row.items()})
    return seconds, curve


def steps_in(seconds: float, arm: Arm, pictures: Any, validation: Sequence[Trial], precision: str) -> int:
    """The number of steps of an arm that take so many seconds of processor time, validations not counted."""
    few = loop_settings(arm, POINTS, precision)
    more = loop_settings(arm, POINTS + PROBE, precision)

    train_arm(arm, pictures, validation[:1], few, seed=0)  # what is done once, such as compiling
    without, _ = train_arm(arm, pictures, validation[:1], few, seed=0)
    within, _ = train_arm(arm, pictures, validation[:1], more, seed=0)
    points = seconds * PROBE / (within - without) / POINTS
    return POINTS * max(1, round(points))


def validation_trials() -> list[Trial]:
    """The middles of the validation frames at each strength, which stands for the condition: a column of the log."""
    trials = []
    for trial in frozen_trials(VALIDATION, MIDDLE):
        trials.append(replace(trial, condition=trial.strength, develop=None))
    return trials


@torch.inference_mode()
def gmac(arm: Arm) -> float:
    """Multiplications of an arm's network, in 10^9 a megapixel of the mosaic."""
    network = DENOISERS[arm.network](**arm.settings)
    noisy = torch.rand(1, PACKED, SIDE, SIDE)
    with FlopCounterMode(display=False) as counter:
        network(noisy, 1e-3 * noisy + 1e-5)
    return counter.get_total_flops() / 2e3 / noisy.numel()


# -- the table ---------------------------------------------------------------------------------------------------------


def print_table(table: Table) -> None:
    """A row for each arm: mean and deviation of its seeds at the end, and the curve of the mean of all strengths."""
    rows = []
    for name, figures in table.items():
        curves = [run["curve"] for run in figures["runs"].values()]
        if not curves:
            continue

        seconds = fmean(run["seconds"] for run in figures["runs"].values())
        cells = [name, str(figures["steps"]), f"{seconds:.0f}", f"{figures['gmac']:.1f}", str(len(curves))]
        for strength in STRENGTHS:
            cells.append(mean_and_deviation([curve[-1][f"psnr_{strength}"] for curve in curves]))
        points = [fmean(point["psnr"] for point in at_once) for at_once in zip(*curves, strict=True)]
        cells.append(", ".join(f"{value:.2f}" for value in points))
        rows.append(cells)

    head = ["arm", "steps", "s", "GMAC/Mpix", "seeds", *STRENGTHS, "mean, along the training"]
    print_rows(f"PSNR of RAW in dB, {VALIDATION}", head, rows)


def mean_and_deviation(values: Sequence[float]) -> str:
    """A mean, and the deviation between seeds where there are several."""
    if len(values) == 1:
        return f"{values[0]:.2f}"
    return f"{fmean(values):.2f} ± {stdev(values):.2f}"


def options() -> argparse.ArgumentParser:
    """The arguments."""
    arguments = parser(__doc__)
    arguments.add_argument("table", type=Path, help="JSON file of all figures")
    arguments.add_argument("--pictures", nargs="+", default=["demo:"], help="sRGB pictures to make RAW of")
    arguments.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    arguments.add_argument("--minutes", type=float, default=2.0, help="of processor time, for each arm and seed")
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--precision", default="bf16-mixed", help="32-true on a CPU without bf16")
    return arguments


def main(command: Sequence[str] | None = None) -> None:
    """Train what is missing in the table, and print it."""
    args = options().parse_args(command)
    torch.set_num_threads(1)
    table: Table = json.loads(args.table.read_text()) if args.table.is_file() else {}

    pictures = Cached(open_pictures(args.pictures), CACHE_MB)
    for k in range(len(pictures)):
        pictures[k]  # decoded before anything is timed
    validation = validation_trials()

    for seed in range(args.seeds):
        for name in args.arms:
            arm = ARMS[name]
            if name not in table:
                steps = steps_in(60.0 * args.minutes, arm, pictures, validation, args.precision)
                table[name] = {"steps": steps, "gmac": gmac(arm), "runs": {}}
            if str(seed) in table[name]["runs"]:
                continue

            config = loop_settings(arm, table[name]["steps"], args.precision)
            seconds, curve = train_arm(arm, pictures, validation, config, seed)
            table[name]["runs"][str(seed)] = {"seconds": round(seconds, 1), "curve": curve}
            args.table.write_text(json.dumps(table, indent=0))
    print_table(table)


if __name__ == "__main__":
    main()
