"""What the benchmarks share: arguments, the machine, the fastest of several runs, peak memory, built-in pictures."""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug.data import demo_pictures
from rawaug.data.pairs import centre
from rawaug.denoising.convolutions import processor_name
from rawaug.io import write_picture


def parser(description: str | None) -> argparse.ArgumentParser:
    """Whose help is a module's docstring as it is."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def arguments(description: str | None, repeats: int, quick: str) -> argparse.ArgumentParser:
    """A parser with the options that every benchmark has; ``quick`` says what ``--quick`` does to this one."""
    options = parser(description)
    options.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    options.add_argument("--repeats", type=int, default=repeats, help="runs, of which the fastest counts")
    options.add_argument("--json", type=Path, help="write all figures to this file")
    options.add_argument("--quick", action="store_true", help=quick)
    return options


def machine(device: torch.device, threads: int) -> dict[str, object]:
    """What the figures are measured on."""
    known: dict[str, object] = {
        "cpu": processor_name(),
        "cores": os.cpu_count(),
        "threads": threads,
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    if device.type == "cuda":
        query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
        driver = subprocess.run(query, check=True, capture_output=True, text=True).stdout.split()
        known |= {"gpu": torch.cuda.get_device_name(device), "cuda": torch.version.cuda, "driver": driver[0]}
    return known


def start(args: argparse.Namespace) -> dict[str, Any]:
    """Set the threads, print the machine, and return the figures' first entry."""
    torch.set_num_threads(args.threads)
    figures = {"machine": machine(args.device, args.threads)}
    print("  ".join(f"{key} {value}" for key, value in figures["machine"].items()))
    return figures


def finish(figures: Mapping[str, Any], args: argparse.Namespace) -> None:
    """Write ``--json``, if it was asked for."""
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def show(rows: Mapping[str, Mapping[str, float]], width: int = 22) -> None:
    """One line a row: its name, then every figure after its own name."""
    for name, row in rows.items():
        print(f"  {name:{width}}", "  ".join(f"{what} {value:.4g}" for what, value in row.items()), flush=True)


def seconds(run: Callable[[], object], device: torch.device) -> float:
    """Of one run, until the device has finished."""
    wait = torch.cuda.synchronize if device.type == "cuda" else (lambda: None)
    wait()
    begin = time.perf_counter()
    run()
    wait()
    return time.perf_counter() - begin


def fastest(runs: Mapping[str, Callable[[], object]], repeats: int, device: torch.device) -> dict[str, float]:
    """The least seconds of each, timed in turn."""
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(repeats):
        for name, run in runs.items():
            best[name] = min(best[name], seconds(run, device))
    return best


def memory_used(device: torch.device) -> int:
    """Bytes at the peak: of tensors on a GPU, of the whole process on a CPU."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def sized(picture: Tensor, height: int, width: int) -> Tensor:
    """The middle of ``(3, H, W)`` in floats, enlarged first where it is smaller than asked for."""
    scale = max(1.0, height / picture.shape[1] + 1e-3, width / picture.shape[2] + 1e-3)
    source = picture[None].float()
    source = torch.nn.functional.interpolate(source, scale_factor=scale, mode="bilinear") if scale > 1 else source
    return centre(source[0], height, width, step=1)


def write_pictures(folder: Path, count: int | None = None, size: Sequence[int] | None = None) -> Path:
    """Fill a folder with ``count`` JPEGs of the built-in pictures, repeated if need be, in their own or one size."""
    pictures = demo_pictures()
    folder.mkdir(exist_ok=True)
    for k in range(len(pictures) if count is None else count):
        picture = pictures[k % len(pictures)]
        shown = picture if size is None else sized(picture, *size).round().clamp(0, 255).to(torch.uint8)
        write_picture(folder / f"{k:06d}.jpg", shown)
    return folder
