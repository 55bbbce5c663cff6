"""What rawaug costs a training: a whole DataLoader, and a training step, with it and without, as ratios.

    python benchmarks/loader.py [PICTURES] [--json FILE] [--workers N] [--device cpu|cuda] [--quick]
    python benchmarks/loader.py [PICTURES] --memory [--epochs 10]

The loader reads a folder of pictures, crops and collates; RawPairs makes the pairs in its workers, wrap on the device.
The step is that of denoisers.UNet on a batch of pairs, alone and with the batch made by RawAugment first. All are timed
in turn, and the fastest run of each counts. ``--reading`` times PictureFolder alone: with decoders in a helper process
of each worker (rawaug.io.apart), one by one and by batches, and without; on Linux also the mean processor seconds of
all processes together. ``--memory`` prints the resident memory of the process and its persistent workers after each
epoch. Pictures are those of PICTURES, or the built-in ones written to a folder.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import rawaug
from denoisers import UNet
from rawaug.bayer import RandomCrop
from rawaug.data import PictureFolder, demo_pictures
from rawaug.io import write_picture
from rawaug.seeding import keyed_generator


class Crops(Dataset[Tensor]):
    """What a loader does without rawaug: read, crop."""

    def __init__(self, pictures: PictureFolder, crop: int) -> None:
        self.pictures, self.crop = pictures, RandomCrop(crop)

    def __len__(self) -> int:
        return len(self.pictures)

    def __getitem__(self, index: int) -> Tensor:
        return self.cropped(self.pictures[index], index)

    def cropped(self, picture: Tensor, index: int) -> Tensor:
        part: Tensor = self.crop(picture, keyed_generator("crops", index)).clone()
        return part


class BatchesOfCrops(Crops):
    """The same, the next pictures of a batch decoded while one is cropped."""

    def __getitems__(self, indices: list[int]) -> list[Tensor]:
        pictures = self.pictures.read_ahead(indices)
        return [self.cropped(picture, index) for picture, index in zip(pictures, indices, strict=True)]


def fastest(runs: Mapping[str, Callable[[], object]], repeats: int, device: torch.device) -> dict[str, float]:
    """The least seconds of each, timed in turn."""
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            best[name] = min(best[name], time.perf_counter() - start)
    return best


def processor_seconds() -> float:
    """Of this process and all that came from it (Linux)."""
    parents, seconds = dict[int, int](), dict[int, float]()
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            fields = file.read_text(errors="replace").rpartition(")")[2].split()
            pid = int(file.parent.name)
            parents[pid], seconds[pid] = int(fields[1]), sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")

    def ours(pid: int) -> bool:
        return pid == os.getpid() or (pid in parents and ours(parents[pid]))

    return sum(taken for pid, taken in seconds.items() if ours(pid))


def time_loaders(folder: Path, args: argparse.Namespace) -> dict[str, float]:
    """Seconds of an epoch, workers kept."""
    pictures, augment = PictureFolder(folder), rawaug.RawAugment.from_pretrained("universal")
    settings: dict[str, Any] = {"batch_size": args.batch, "num_workers": args.workers}
    settings["persistent_workers"] = args.workers > 0
    crops = DataLoader(Crops(pictures, args.crop), **settings)
    pairs = DataLoader(rawaug.RawPairs(pictures, augment, crop=args.crop), **settings)
    on_device = rawaug.RawAugment.from_pretrained("universal")
    wrapped = rawaug.wrap(DataLoader(Crops(pictures, args.crop), **settings), on_device, device=args.device)
    runs = {
        "without": lambda: [batch.to(args.device) for batch in crops],
        "RawPairs": lambda: [pair.noisy.to(args.device) for pair in pairs],
        "wrap": lambda: [pair.noisy for pair in wrapped],
    }
    return fastest(runs, args.repeats, args.device)


def time_reading(folder: Path, args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Seconds of an epoch that decodes in the loader's workers, and of those whose workers have helpers for it."""
    runs, spent = dict[str, Callable[[], object]](), dict[str, float]()
    kinds: tuple[tuple[str, str, type[Crops]], ...]
    kinds = (("without", "0", Crops), ("apart", "60", Crops), ("apart, by batches", "60", BatchesOfCrops))
    for name, limit, kind in kinds:
        os.environ["RAWAUG_READ_SECONDS"] = limit
        loader = DataLoader(
            kind(PictureFolder(folder), args.crop), args.batch, num_workers=args.workers,
            persistent_workers=args.workers > 0,
        )  # fmt: skip

        def epoch(loader: DataLoader[Tensor] = loader, limit: str = limit, name: str = name) -> None:
            os.environ["RAWAUG_READ_SECONDS"] = limit  # which persistent workers keep from their start
            before = processor_seconds()
            for _ in loader:
                pass
            spent[name] = spent.get(name, 0.0) + processor_seconds() - before

        epoch()
        spent.clear()
        runs[name] = epoch
    timed = {"reading": fastest(runs, args.repeats, torch.device("cpu"))}
    if sys.platform == "linux":
        timed["reading, processors"] = {name: seconds / args.repeats for name, seconds in spent.items()}
    return timed


def time_steps(args: argparse.Namespace) -> dict[str, float]:
    """Seconds of a training step on a batch."""
    augment = rawaug.RawAugment.from_pretrained("universal").to(args.device)
    shape = (args.batch, 3, args.crop, args.crop)
    srgb = torch.randint(256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8).to(args.device)
    network = UNet(width=args.width).to(args.device)
    optimizer = torch.optim.Adam(network.parameters())

    def step(pair: rawaug.RawPair) -> None:
        optimizer.zero_grad()
        torch.nn.functional.l1_loss(network(pair.noisy, pair.variance), pair.clean).backward()
        optimizer.step()

    ready = augment(srgb)
    return fastest(
        {"without": lambda: step(ready), "RawAugment": lambda: step(augment(srgb))}, args.repeats, args.device
    )


def resident_mib() -> float:
    """Resident memory of this process and its children, as the kernel counts it (Linux)."""
    pids = ["self", *(str(child.pid) for child in multiprocessing.active_children())]
    status = [Path(f"/proc/{pid}/status").read_text(encoding="utf-8") for pid in pids]
    return sum(int(text.split("VmRSS:")[1].split()[0]) for text in status) / 1024


def measure_memory(folder: Path, args: argparse.Namespace) -> list[float]:
    """MiB after each epoch with persistent workers, before they are given back."""
    pairs = rawaug.RawPairs(PictureFolder(folder), rawaug.RawAugment.from_pretrained("universal"), crop=args.crop)
    workers = max(1, args.workers)
    loader = DataLoader(pairs, args.batch, shuffle=True, num_workers=workers, persistent_workers=True)
    memory = []
    for epoch in range(args.epochs):
        pairs.set_epoch(epoch)
        for _ in loader:
            pass
        memory.append(resident_mib())
        print(f"  epoch {epoch + 1}: {memory[-1]:.0f} MiB")
    return memory


def ratios(seconds: dict[str, float]) -> dict[str, float]:
    return {name: value / seconds["without"] for name, value in seconds.items() if name != "without"}


def measure(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """All that is asked for, printed and returned."""
    if args.memory:
        memory = measure_memory(folder, args)
        growth = memory[-1] / memory[min(1, len(memory) - 1)] - 1
        print(f"  from epoch 2 to {len(memory)}: {growth:+.1%}")
        return {"memory_mib": memory, "growth": growth}
    timed = time_reading(folder, args)
    if not args.reading:
        timed |= {"loader": time_loaders(folder, args), f"step of UNet({args.width})": time_steps(args)}
    for what, seconds in timed.items():
        shown = "  ".join(f"{name} {value:.2f}" for name, value in ratios(seconds).items())
        print(f"  {what:20s} without {1e3 * seconds['without']:.0f} ms;  ratios: {shown}")
    return {"ratios": {what: ratios(seconds) for what, seconds in timed.items()}, "seconds": timed}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path, nargs="?", help="folder of pictures; by default the built-in ones")
    parser.add_argument("--memory", action="store_true", help="measure resident memory over epochs instead of times")
    parser.add_argument("--reading", action="store_true", help="time the reading of pictures alone")
    parser.add_argument("--epochs", type=int, default=10, help="of --memory")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--crop", type=int, default=128)
    parser.add_argument("--width", type=int, default=32, help="of the U-Net")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--quick", action="store_true", help="one repeat, batches of 4")
    args = parser.parse_args()
    args.repeats, args.batch = (1, 4) if args.quick else (args.repeats, args.batch)
    name = torch.cuda.get_device_name(args.device) if args.device.type == "cuda" else platform.processor()
    machine = f"{name or platform.machine()}, {torch.get_num_threads()} threads, torch {torch.__version__}"
    print(f"{args.workers} workers, batches of {args.batch} x {args.crop} x {args.crop} ({machine})")
    with tempfile.TemporaryDirectory() as written:
        if args.pictures is None:
            for i, picture in enumerate(demo_pictures()):
                write_picture(Path(written) / f"{i:02d}.png", picture)
        results = measure(args.pictures or Path(written), args)
    if args.json:
        settings = {"workers": args.workers, "batch": args.batch, "crop": args.crop, "width": args.width}
        report = {"machine": machine, "settings": settings, **results}
        args.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
