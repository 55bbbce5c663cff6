"""Every row of "On a GPU" in docs/results.md, with ratios within one run, and the bars that a GPU has to reach.

    python -m benchmarks.gpu [--json FILE] [--minutes 8]
    python -m benchmarks.gpu --device cpu --quick            # tries every part in small, without a GPU

It ends within ``--minutes``: a part that has not begun by then is left out, and said to be. The parts are

- *calls*: crops and whole frames, by target, beside UPI as published and a copy (:mod:`benchmarks.augment`);
- *steps*: a training step of U-Net(32) and of NAFNet(32) with and without `RawAugment` before it;
- *loaders*: an epoch with `RawPairs` in the workers, and with `wrap` on the device (:mod:`benchmarks.loader`);
- *training*: steps of `recipes/base.yaml` on ready tensors, on uint8 crops that workers decode and the device makes
  pairs of, and on pairs that workers make; in bfloat16, with a compiled network too; and the training itself, as
  ``rawaug run base --train.compile true`` goes through it, from a folder of JPEGs;
- *denoising*: `rawaug-small` and `rawaug-base` on 12 megapixels, and `rawaug denoise` from DNG to DNG;
- *tests*: ``pytest -m gpu``.

Bars are for an H100 or an H200; the first line names the device.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor, nn
from torch.nn.functional import l1_loss
from torch.utils.data import DataLoader

import denoisers
import rawaug
from benchmarks import augment, denoise, loader
from benchmarks.measure import arguments, fastest, finish, seconds, show, start, write_pictures
from rawaug.data import PictureFolder
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.estimators import Supervised
from rawaug.training.loop import train
from rawaug.training.sources import PictureCrops, freeze_samples
from rawaug.training.stream import TrainingStream

Figures = dict[str, dict[str, float]]

ROOT = Path(__file__).parents[1]

BARS: list[tuple[str, str, str, float, str]] = [
    ("crops", "rawaug", "ms", 0.8, "at most"),
    ("crops", "rawaug", "mpix_s", 1200.0, "at least"),
    ("crops", "srgb, finished", "mpix_s", 200.0, "at least"),
    ("whole frames", "rawaug", "mpix_s", 20000.0, "at least"),
    ("steps", "UNet", "ratio", 1.05, "at most"),
    ("training", "rawaug run base", "of ready tensors", 0.95, "at least"),
]
"""Part, row, figure and limit."""


def calls(args: argparse.Namespace) -> dict[str, Figures]:
    """Mpix/s and milliseconds of each method, for 16 crops of 256 x 256 and for whole frames of 12 megapixels."""
    shapes = {"crops": (16, 256, 256), "whole frames": (4, 3000, 4000)}
    if args.quick:
        shapes = {"crops": (2, 32, 48), "whole frames": (1, 64, 96)}
    copied = augment.bandwidth(args.device, 1 if args.quick else 1024, 3)

    figures: dict[str, Figures] = {"copy": {"of memory": {"GB/s": copied}}}
    for title, shape in shapes.items():
        batch = augment.pictures(*shape).to(args.device)
        rows = augment.measure(batch, args.repeats if title == "crops" else 3, copied)
        for row in rows.values():
            row["ms"] = batch[:, 0].numel() / row["mpix_s"] / 1e3
        figures[title] = rows
    return figures


def steps(args: argparse.Namespace) -> dict[str, Figures]:
    """Milliseconds of a training step on ready pairs, and how many times as long it takes with RawAugment before it."""
    width, shape = (4, (2, 3, 32, 32)) if args.quick else (32, (16, 3, 256, 256))
    srgb = torch.randint(256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8).to(args.device)
    make = rawaug.RawAugment.from_pretrained("universal").to(args.device)
    ready = make(srgb)

    rows: Figures = {}
    for network in (denoisers.UNet(width=width), denoisers.build("NAFNet", width=width)):
        step = step_of(network.to(args.device))
        runs = {"without": lambda step=step: step(ready), "with": lambda step=step: step(make(srgb))}
        timed = fastest(runs, args.repeats, args.device)
        ratio = timed["with"] / timed["without"]
        rows[type(network).__name__] = {"ms": 1e3 * timed["without"], "ratio": ratio}
    return {"steps": rows}


def loaders(args: argparse.Namespace) -> dict[str, Figures]:
    """Times of an epoch with RawPairs and with wrap, relative to one that only decodes and crops."""
    settings = argparse.Namespace(**vars(args), batch=16, crop=32 if args.quick else 128)
    with tempfile.TemporaryDirectory() as folder:
        write_pictures(Path(folder), 4 if args.quick else 256)
        timed = loader.time_loaders(Path(folder), settings)
    return {"loaders": {name: {"ratio": value / timed["without"]} for name, value in timed.items()}}


def training(args: argparse.Namespace) -> dict[str, Figures]:
    """Crops a second of the training of `recipes/base.yaml` in bfloat16, by where its pairs are made."""
    recipe = yaml.safe_load((ROOT / "recipes" / "base.yaml").read_text(encoding="utf-8"))
    crop, batch, steps = (32, 2, 1) if args.quick else (recipe["train"]["crop"], 32, 20)
    make = rawaug.RawAugment.from_pretrained("universal", noise=recipe["noise"])
    step = step_of(denoisers.build(**{"name": "DRUNet", **recipe["denoiser"]["settings"]}).to(args.device), mixed=True)

    def run_steps(source: Iterator[rawaug.RawPair]) -> None:
        for _ in range(steps):
            step(next(source))

    rows: Figures = {}
    with tempfile.TemporaryDirectory() as folder:
        write_pictures(Path(folder), 8 if args.quick else 512)
        pictures = PictureFolder(folder)
        settings: dict[str, Any] = {"batch_size": batch, "num_workers": args.workers, "drop_last": True}
        settings["persistent_workers"] = args.workers > 0
        pin = args.device.type == "cuda"
        in_workers = DataLoader(rawaug.RawPairs(pictures, make, crop=crop), pin_memory=pin, **settings)
        crops = DataLoader(loader.Crops(pictures, crop), pin_memory=pin, **settings)
        on_device = rawaug.RawAugment.from_pretrained("universal", noise=recipe["noise"]).to(args.device)

        ready = on_device(next(iter(crops)).to(args.device))
        sources: dict[str, Iterator[rawaug.RawPair]] = {
            "ready tensors": repeat(lambda: [ready]),
            "pairs on the device": repeat(lambda: (on_device(x.to(args.device, non_blocking=True)) for x in crops)),
            "pairs in workers": repeat(lambda: (moved(pair, args.device) for pair in in_workers)),
        }
        for name, source in sources.items():
            step(next(source))
            taken = seconds(partial(run_steps, source), args.device)
            rows[name] = {"crops/s": steps * batch / taken}
        rows["rawaug run base"] = {"crops/s": batch * train_steps(recipe, pictures, batch, crop, steps, args)}
    for row in rows.values():
        row["of ready tensors"] = row["crops/s"] / rows["ready tensors"]["crops/s"]
    return {"training": rows}


class Clock(Supervised):
    """Notes when steps begin, once the device has done what was asked of it before."""

    def __init__(self, device: torch.device, steps: Sequence[int]) -> None:
        self.device, self.steps = device, steps
        self.step, self.times = 0, list[float]()

    def loss(self, *arguments: Any) -> Tensor:
        if self.step in self.steps:
            seconds(lambda: None, self.device)  # waits
            self.times.append(time.perf_counter())
        self.step += 1
        return super().loss(*arguments)


def train_steps(
    recipe: dict[str, Any], pictures: Any, batch: int, crop: int, steps: int, args: argparse.Namespace
) -> float:
    """Steps a second of the training of a recipe, after as many that are not counted."""
    settings = {**recipe["train"], "batch": batch, "crop": crop, "steps": 2 * steps + 1, "workers": args.workers}
    settings |= {"validate_every": 4 * steps, "compile": args.device.type == "cuda"}
    make = rawaug.RawAugment.from_pretrained("universal", noise=recipe["noise"])
    pairs = rawaug.RawPairs(pictures, make, crop=crop, zoom=recipe["arms"]["published"]["zoom"])
    stream = TrainingStream(None, pairs, batch, 1.0, seed=0)
    watched = freeze_samples(PictureCrops(pairs), "watched")[:1]

    clock = Clock(args.device, (steps, 2 * steps))
    network, config = DenoiserConfig("DRUNet", recipe["denoiser"]["settings"]), TrainConfig(**settings)
    with tempfile.TemporaryDirectory() as folder:
        train(stream, watched, network, config, Path(folder), device=args.device.type, estimator=clock)
    begin, end = clock.times
    return steps / (end - begin)


def moved(pair: rawaug.RawPair, device: torch.device) -> rawaug.RawPair:
    """Move what a step needs of a pair to a device."""
    noisy, clean, variance = [part.to(device, non_blocking=True) for part in (pair.noisy, pair.clean, pair.variance)]
    return pair._replace(noisy=noisy, clean=clean, variance=variance)


def repeat(make: Callable[[], Any]) -> Iterator[Any]:
    """Go through a loader again and again."""
    while True:
        yield from make()


def step_of(network: nn.Module, mixed: bool = False) -> Callable[[rawaug.RawPair], Tensor]:
    """Make the function that trains a network for one step on a pair; compiled on a GPU."""
    fused = next(network.parameters()).is_cuda
    optimizer = torch.optim.Adam(network.parameters(), fused=fused)
    run = torch.compile(network, mode="reduce-overhead") if fused and mixed else network

    def step(pair: rawaug.RawPair) -> Tensor:
        optimizer.zero_grad()
        with torch.autocast(pair.noisy.device.type, torch.bfloat16, enabled=mixed):
            loss = l1_loss(run(pair.noisy, pair.variance), pair.clean)
        loss.backward()
        optimizer.step()
        return loss.detach()

    return step


def denoising(args: argparse.Namespace) -> dict[str, Figures]:
    """Seconds of two networks for 12 megapixels, and of the command."""
    noisy = denoise.frame(0.01 if args.quick else 12.0, args.device)
    rows: dict[str, Figures] = {}
    for name in ("rawaug-small", "rawaug-base"):
        network = denoisers.from_pretrained(name).to(args.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        rows[name] = denoise.measure(network, noisy, 1 if args.quick else 3)
        rows[name]["rawaug denoise"] = denoise.command(noisy, name, args.device, 1)
    return rows


def tests(args: argparse.Namespace) -> dict[str, Figures]:
    """The tests that need a GPU: how many passed and failed."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    print(done.stdout[-2000:])
    return {"tests": {"pytest -m gpu": {"exit status": float(done.returncode)}}}


def judge(figures: dict[str, Any]) -> dict[str, bool]:
    """Say of each of :data:`BARS` whether it is reached; one without a figure is left out."""
    reached = {}
    for part, row, figure, limit, kind in BARS:
        value = figures.get(part, {}).get(row, {}).get(figure)
        if value is not None:
            is_reached = value <= limit if kind == "at most" else value >= limit
            reached[f"{part}, {row}: {figure} {kind} {limit:g}"] = is_reached
            print(f"  {'pass' if is_reached else 'FAIL'}  {part}, {row}: {figure} {value:.4g}, {kind} {limit:g}")
    return reached


def main(argv: list[str] | None = None) -> dict[str, Any]:
    parser = arguments(__doc__, repeats=20, quick="every part once, in small; for a dry run on a CPU")
    parser.set_defaults(device=torch.device("cuda"))
    parser.add_argument("--workers", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=8.0, help="no part begins later than this, less its share")
    args = parser.parse_args(argv)
    if args.quick:
        args.repeats, args.workers = 1, 0

    figures, begin = start(args), time.monotonic()
    parts = [calls, steps, training, loaders, denoising]
    if args.device.type == "cuda":
        parts.append(tests)
    for part in parts:
        if time.monotonic() - begin > 60.0 * (args.minutes - 1.5):
            print(f"{part.__name__}: left out, the time is over")
            continue
        for title, rows in part(args).items():
            figures[title] = rows
            print(title)
            show(rows)

    figures["minutes"] = (time.monotonic() - begin) / 60.0
    print(f"{figures['minutes']:.1f} minutes; bars")
    figures["bars"] = judge(figures)
    finish(figures, args)
    return figures


if __name__ == "__main__":
    main()
