"""What the augmentation costs: million sRGB pixels a second, against other ways to the same RAW, and peak memory.

    python benchmarks/augment.py [--quick] [--json FILE] [--threads N]

Every method makes clean RAW, noisy RAW and the variance map, packed, of photographs: a training batch of 16 crops, and
pictures of 12 Mpix. *upi* is Brooks' pipeline as published: picture by picture and operation by operation, from floats,
with its own noise. *cycleisp* is its network from sRGB to RAW alone, and *unbaked* the ISP's own reverse pass, each on
one small crop whose time is scaled by pixels, in the network's favour. *copy* turns bytes into as many floats as are
made of them, and does no more. All are timed in turn, and the fastest run of each counts.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data.demo.demo_pairs import demo_photographs
from rawaug.isp.baselines.cycleisp import CycleISP
from rawaug.isp.baselines.upi import UPI, unprocess_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment

NETWORK_CROP = 64
UNBAKED_CROP = 256


def pictures(count: int, height: int, width: int) -> Tensor:
    """uint8 ``(count, 3, height, width)``: photographs, enlarged where they are too small, with some noise."""
    generator = torch.Generator().manual_seed(0)
    photographs = [p for split in ("train", "validation", "test") for p in demo_photographs(split).values()]
    made = torch.empty(count, 3, height, width, dtype=torch.uint8)
    for k in range(count):
        source = photographs[k % len(photographs)][None].float()
        scale = max(1.0, height / source.shape[2] + 1e-3, width / source.shape[3] + 1e-3)
        source = torch.nn.functional.interpolate(source, scale_factor=scale, mode="bilinear") if scale > 1 else source
        top, left = ((n - m) // 2 for n, m in zip(source.shape[2:], (height, width), strict=True))
        crop = source[0, :, top : top + height, left : left + width]
        made[k] = crop.add(torch.randn(crop.shape, generator=generator)).round().clamp(0, 255).to(torch.uint8)
    return made


def published_upi(picture: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
    """One float picture ``(1, 3, H, W)`` as in the published code: unprocess, clip, mosaic, variance, noise."""
    params = UPI().sample(1, generator)
    clean = bayer.pack_rgb(unprocess_pixels(picture, params).clamp(0.0, 1.0), "RGGB")
    log_shot = torch.empty(()).uniform_(-9.21, -4.42, generator=generator)  # ln 1e-4 to ln 0.012
    log_read = 2.18 * log_shot + 1.2 + torch.empty(()).normal_(std=0.26, generator=generator)
    variance = clean * log_shot.exp() + log_read.exp()
    noisy = clean + torch.empty_like(clean).normal_(generator=generator) * variance.sqrt()
    return clean, noisy, variance


def augmentations() -> dict[str, RawAugment]:
    """The shipped ISP, its constants first, then with encoders that look at every picture."""
    looking = DictionaryISP.from_pretrained("universal")
    looking.use_encoders(True)
    return {
        "rawaug": RawAugment.from_pretrained("universal"),
        "rawaug, encoders": RawAugment.from_pretrained(looking, sampling="chosen"),
    }


def methods(batch: Tensor) -> dict[str, tuple[Callable[[], object], int]]:
    """What is timed, and the pixels that one run makes."""
    generator = torch.Generator().manual_seed(0)
    pixels, small = batch[:, 0].numel(), batch[:1, :, :UNBAKED_CROP, :UNBAKED_CROP]
    isp, network, noise = (
        DictionaryISP.from_pretrained("universal"),
        CycleISP().rgb2raw,
        augmentations()["rawaug"].noise,
    )
    floats = [picture[None] / 255.0 for picture in batch]
    crop = floats[0][..., :NETWORK_CROP, :NETWORK_CROP].contiguous()

    def unbaked() -> object:
        clean = bayer.pack(isp.reverse(small).raw.clamp(max=1.0), isp.cfa)
        return noise.apply_with_variance(clean, noise.sample(1, generator))

    runs: dict[str, tuple[Callable[[], object], int]] = {
        name: (lambda augment=augment: augment(batch), pixels)  # type: ignore[misc]
        for name, augment in augmentations().items()
    }
    return runs | {
        "copy": (lambda: batch.float(), pixels),
        "upi": (lambda: [published_upi(picture, generator) for picture in floats], pixels),
        "unbaked": (unbaked, small[:, 0].numel()),
        "cycleisp": (lambda: network(crop), NETWORK_CROP**2),
    }


@torch.no_grad()
def measure(batch: Tensor, repeats: int) -> dict[str, dict[str, float]]:
    """Mpix/s of each method, and how many times as fast as it ``rawaug`` is, without and with encoders."""
    runs = methods(batch)
    best = dict.fromkeys(runs, float("inf"))
    for round_ in range(repeats):
        for name, (run, _) in runs.items():
            if name in ("cycleisp", "unbaked") and round_ >= 3:
                continue
            time.sleep(0.02)  # PyTorch's threads spin on for a while after the method before
            start = time.perf_counter()
            run()
            best[name] = min(best[name], time.perf_counter() - start)
    speed = {name: pixels / best[name] / 1e6 for name, (_, pixels) in runs.items()}
    ours = {"ratio": "rawaug", "ratio, encoders": "rawaug, encoders"}
    return {
        name: {"mpix_s": value} | {key: speed[own] / value for key, own in ours.items()}
        for name, value in speed.items()
    }


def child(task: str, threads: int, **environment: str) -> float:
    """Run this file's ``task`` in a process of its own; the number that it prints."""
    command = [sys.executable, __file__, "--task", task, "--threads", str(threads)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | environment)
    return float(done.stdout)


def peak_memory() -> float:
    """Peak memory that a batch of four 12-Mpix pictures adds, over the size of input plus output."""
    augment = RawAugment.from_pretrained("universal")
    augment(torch.zeros(1, 3, 64, 64, dtype=torch.uint8))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    batch = torch.zeros(4, 3, 3000, 4000, dtype=torch.uint8).random_(0, 256, generator=torch.Generator())
    pair = augment(batch)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    size = sum(t.numel() * t.element_size() for t in (batch, pair.noisy, pair.clean, pair.variance))
    return (after - before) * 1024 / size


def first_call() -> float:
    """Seconds of a process's first augmentation."""
    augment = RawAugment.from_pretrained("universal")
    start = time.perf_counter()
    augment(torch.zeros(1, 3, 64, 64, dtype=torch.uint8))
    return time.perf_counter() - start


def machine(threads: int) -> dict[str, object]:
    info = Path("/proc/cpuinfo")
    names = (
        [line.split(":")[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")]
        if info.exists()
        else []
    )
    cpu = names[0] if names else platform.processor() or platform.machine()
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "threads": threads,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few runs, and 3 Mpix instead of 12")
    parser.add_argument("--json", type=Path, help="write all figures to this file")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, help="runs of each method")
    parser.add_argument("--task", choices=["memory", "first"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.task:
        print(peak_memory() if args.task == "memory" else first_call())
        return
    results: dict[str, object] = {"machine": machine(args.threads)}
    print("  ".join(f"{key} {value}" for key, value in machine(args.threads).items()))
    # First, for a process inherits the peak of the one that starts it.
    results["peak memory"] = {"of input and output": child("memory", args.threads)}
    with tempfile.TemporaryDirectory() as folder:
        seconds = [child("first", args.threads, NUMBA_CACHE_DIR=folder) for _ in range(2)]
    results["first call"] = {"seconds": seconds[0], "seconds, compiled before": seconds[1]}
    for title in ("peak memory", "first call"):
        print(title, results[title])
    sides = (1500, 2000) if args.quick else (3000, 4000)
    for shape, repeats in (((16, 256, 256), 5 if args.quick else 40), ((4, *sides), 2 if args.quick else 5)):
        title = "x".join(map(str, shape))
        results[title] = rows = measure(pictures(*shape), args.repeats or repeats)
        print(f"{title}: Mpix/s, and rawaug's speed as a multiple, without and with encoders")
        for name, row in rows.items():
            print(f"  {name:18}{row['mpix_s']:10.3g}{row['ratio']:10.3g}{row['ratio, encoders']:10.3g}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
