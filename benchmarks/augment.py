"""What the augmentation costs: million sRGB pixels a second, against other ways to the same RAW, and peak memory.

    python -m benchmarks.augment [--device cpu|cuda] [--quick] [--json FILE] [--threads N]
    python -m benchmarks.augment --beside CHECKOUT       # the targets on a CPU, and those of another commit, in turn

Every method makes clean RAW, noisy RAW and the variance map, packed, of photographs: a training batch of 16 crops, and
pictures of 12 Mpix. *upi* is Brooks' pipeline as published: picture by picture and operation by operation, from floats,
with its own noise. *copy* turns bytes into as many floats as are made of them, and does no more; *drawn before* is
rawaug without the draw of its parameters; *rgb*, *srgb* and *burst* are its other targets; *blurred* softens linear
light. All are timed in turn, and the fastest run of each counts.

``--beside`` takes CPU time, which other programs lengthen less: processes of the two checkouts in turn, three each; the
least of four calls in a process, and the median of the processes.

The roofline is the bandwidth of a large copy in the same run, bytes read plus bytes written a second. A pixel counts
as :data:`COUNTED` bytes, whatever a method moves; rawaug's two passes move :data:`MOVED`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from benchmarks.measure import arguments, fastest, finish, memory_used, seconds, show, sized, start
from rawaug import bayer
from rawaug.data.demo import demo_photographs
from rawaug.paper.baselines.upi import UPI, unprocess_pixels
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.draw import Draw
from rawaug.plugin.targets import Burst, Srgb, Target

ROOT = Path(__file__).parents[1]
TARGETS: dict[str, dict[str, Any]] = {
    "raw": {},
    "rgb": {"target": "rgb"},
    "srgb": {"target": "srgb"},
    "srgb, finished": {"target": Srgb(finish=True)},
    "burst of 4": {"burst": Burst(4)},
}
"""Settings of RawAugment that ``--beside`` times, besides UPI."""

COUNTED = 3 + 4 + 4
"""Bytes a pixel that any augmentation must move: uint8 in, noisy and clean RAW out in float32."""
MOVED = (3 + 4) + (4 + 4 + 4)
"""Bytes a pixel that rawaug moves: pictures to clean RAW, then clean RAW to noisy RAW and variance."""


def pictures(count: int, height: int, width: int) -> Tensor:
    """uint8 ``(count, 3, height, width)``: photographs, enlarged where they are too small, with some noise."""
    generator = torch.Generator().manual_seed(0)
    photographs = [p for split in ("train", "validation", "test") for p in demo_photographs(split).values()]
    made = torch.empty(count, 3, height, width, dtype=torch.uint8)
    for k in range(count):
        crop = sized(photographs[k % len(photographs)], height, width)
        made[k] = crop.add(torch.randn(crop.shape, generator=generator)).round().clamp(0, 255).to(torch.uint8)
    return made


def published_upi(picture: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """One float picture ``(1, 3, H, W)`` as in the published code: unprocess, clip, mosaic, variance, noise."""
    params = UPI().sample(1, generator)
    clean = bayer.pack_rgb(unprocess_pixels(picture, params).clamp(0.0, 1.0), "RGGB")
    scalar = picture.new_empty(())
    log_shot = scalar.uniform_(-9.21, -4.42, generator=generator)  # ln 1e-4 to ln 0.012
    log_read = 2.18 * log_shot + 1.2 + torch.empty_like(scalar).normal_(std=0.26, generator=generator)
    variance = clean * log_shot.exp() + log_read.exp()
    noisy = clean + torch.empty_like(clean).normal_(generator=generator) * variance.sqrt()
    return clean, noisy, variance


def methods(batch: Tensor) -> dict[str, Callable[[], object]]:
    """What is timed, by name."""
    generator, floats = torch.Generator(batch.device).manual_seed(0), batch / 255.0
    targets: tuple[Target, ...] = ("raw", "rgb", "srgb")
    ours = {target: RawAugment.from_pretrained("universal", target=target).to(batch.device) for target in targets}
    drawn = ours["raw"].sample(batch)
    soft, targets_of_finish = Draw(blur=0.6), Srgb(finish=True)
    blurred = {target: RawAugment.from_pretrained("universal", target=target, draw=soft) for target in targets}
    bursts = [RawAugment.from_pretrained("universal", burst=Burst(4), draw=draw) for draw in (Draw(), soft)]
    finished = RawAugment.from_pretrained("universal", target=targets_of_finish)
    for augment in (*blurred.values(), *bursts, finished):
        augment.to(batch.device)
    return {
        "rawaug": lambda: ours["raw"](batch),
        "rgb": lambda: ours["rgb"](batch),
        "srgb": lambda: ours["srgb"](batch),
        "srgb, finished": lambda: finished(batch),
        "burst of 4": lambda: bursts[0](batch),
        "rawaug, blurred": lambda: blurred["raw"](batch),
        "rgb, blurred": lambda: blurred["rgb"](batch),
        "srgb, blurred": lambda: blurred["srgb"](batch),
        "burst of 4, blurred": lambda: bursts[1](batch),
        "rawaug, drawn before": lambda: ours["raw"].apply(batch, drawn),
        "copy": lambda: batch.float(),
        "upi": lambda: [published_upi(picture[None], generator) for picture in floats],
    }


def bandwidth(device: torch.device, megabytes: int, repeats: int) -> float:
    """GB/s of a copy from memory to memory, bytes read plus bytes written."""
    source = torch.ones(megabytes * 2**18, device=device)
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / fastest({"copy": lambda: target.copy_(source)}, repeats, device)["copy"] / 1e9


@torch.no_grad()
def measure(batch: Tensor, repeats: int, gb_s: float) -> dict[str, dict[str, float]]:
    """Mpix/s of each method, rawaug's speed as a multiple of it, and rawaug's share of the bandwidth ``gb_s``."""
    runs = methods(batch)
    best = dict.fromkeys(runs, float("inf"))
    for name in [*runs] * repeats:
        time.sleep(0.02)  # PyTorch's threads spin on for a while after the method before
        best[name] = min(best[name], seconds(runs[name], batch.device))
    pixels = batch[:, 0].numel()
    speed = {name: pixels / taken / 1e6 for name, taken in best.items()}
    rows = {name: {"mpix_s": value, "ratio": speed["rawaug"] / value} for name, value in speed.items()}
    for name in [name for name in rows if name.startswith("rawaug")]:
        rows[name] |= {what: speed[name] * size / 1e3 / gb_s for what, size in (("counted", COUNTED), ("moved", MOVED))}
    return rows


def child(task: str, args: argparse.Namespace, root: Path = ROOT, **environment: str) -> Any:
    """Run this file's ``task`` with the packages of a checkout in a process of its own; the JSON that it prints."""
    command = [sys.executable, __file__, "--task", task]
    command += ["--threads", str(args.threads), "--device", str(args.device)]
    environment = {**os.environ, **environment, "PYTHONPATH": str(root)}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment, cwd=root)
    return json.loads(done.stdout)


@torch.no_grad()
def cpu_times() -> dict[str, float]:
    """CPU milliseconds of UPI and of each target, for 16 crops of 256 x 256."""
    batch, generator = pictures(16, 256, 256), torch.Generator().manual_seed(0)
    floats = batch / 255.0
    runs: dict[str, Callable[[], object]] = {"upi": lambda: [published_upi(each[None], generator) for each in floats]}
    for name, settings in TARGETS.items():
        augment = RawAugment.from_pretrained("universal", **settings)
        runs[name] = lambda augment=augment: augment(batch, torch.Generator().manual_seed(3))  # type: ignore[misc]

    best = dict.fromkeys(runs, float("inf"))
    for name in [*runs] * 5:  # the first call compiles
        begin = time.process_time()
        runs[name]()
        best[name] = min(best[name], 1e3 * (time.process_time() - begin))
    return best


def compare(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """CPU milliseconds of this checkout and of ``args.beside``, and how many times as fast this one is."""
    times: dict[Path, list[dict[str, float]]] = {ROOT: [], args.beside: []}
    for root in [*times] * 3:
        times[root].append(child("targets", args, root))

    rows = {}
    for name in times[ROOT][0]:
        now, before = [median(each[name] for each in runs) for runs in times.values()]
        ratios = [b[name] / a[name] for a, b in zip(*times.values(), strict=True)]
        row = {"ms": now, "before": before, "as fast": median(ratios), "least": min(ratios), "most": max(ratios)}
        row["of UPI"] = median(each["upi"] / each[name] for each in times[ROOT])
        rows[name] = row
    return rows


def peak_memory(device: torch.device, height: int = 3000, width: int = 4000) -> float:
    """Peak memory that a batch of four 12-Mpix pictures adds, over the size of input plus output."""
    augment = RawAugment.from_pretrained("universal").to(device)
    augment(torch.zeros(1, 3, 64, 64, dtype=torch.uint8, device=device))
    before = memory_used(device)
    batch = torch.zeros(4, 3, height, width, dtype=torch.uint8)
    batch = batch.random_(0, 256, generator=torch.Generator()).to(device)
    pair = augment(batch)
    size = sum(t.numel() * t.element_size() for t in (batch, pair.noisy, pair.clean, pair.variance))
    return (memory_used(device) - before) / size


def first_call(device: torch.device) -> float:
    """Seconds of a process's first augmentation."""
    augment = RawAugment.from_pretrained("universal").to(device)
    return seconds(lambda: augment(torch.zeros(1, 3, 64, 64, dtype=torch.uint8, device=device)), device)


def main() -> None:
    parser = arguments(__doc__, repeats=40, quick="few runs, and 3 Mpix instead of 12")
    parser.add_argument("--task", choices=["memory", "first", "targets"], help=argparse.SUPPRESS)
    parser.add_argument("--beside", type=Path, help="another checkout, to compare the targets with")
    args = parser.parse_args()
    if args.task:
        torch.set_num_threads(args.threads)
        tasks: dict[str, Callable[[], Any]] = {"targets": cpu_times}
        tasks |= {"memory": partial(peak_memory, args.device), "first": partial(first_call, args.device)}
        print(json.dumps(tasks[args.task]()))
        return
    figures = start(args)
    if args.beside:
        figures["targets"] = compare(args)
        show(figures["targets"])
        finish(figures, args)
        return
    # First, for a process inherits the peak of the one that starts it.
    figures["peak memory"] = {"of input and output": child("memory", args)}
    with tempfile.TemporaryDirectory() as folder:
        first = [child("first", args, NUMBA_CACHE_DIR=folder, TRITON_CACHE_DIR=folder) for _ in range(2)]
    figures["first call"] = {"seconds": first[0], "seconds, compiled before": first[1]}
    copied = bandwidth(args.device, 64 if args.quick else 1024, 5)
    figures["bandwidth"] = {"copy, GB/s": copied}
    for title in ("peak memory", "first call", "bandwidth"):
        print(title, figures[title])
    sides = (1500, 2000) if args.quick else (3000, 4000)
    for shape, repeats in (((16, 256, 256), 5 if args.quick else args.repeats), ((4, *sides), 2 if args.quick else 5)):
        title, batch = "x".join(map(str, shape)), pictures(*shape).to(args.device)
        figures[title] = rows = measure(batch, repeats, copied)
        print(f"{title}: Mpix/s; rawaug as a multiple; its bytes, counted and moved, of a copy's")
        show(rows)
    finish(figures, args)


if __name__ == "__main__":
    main()
