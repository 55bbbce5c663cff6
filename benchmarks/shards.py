"""Whether tar shards have the same bytes however they are made, and what they cost against making pairs online.

    python benchmarks/shards.py [--pictures 20000] [--size 64 64] [--workers 1 2 4] [--kills 2] [--json FILE]
    python benchmarks/shards.py --pictures 400 --size 375 500 --workers --kills 0     what MIR Flickr's size costs
    python benchmarks/shards.py --no-costs                                           the bytes alone

Pictures are crops of the built-in ones, as JPEG. ``rawaug synth --format webdataset`` runs once with each number of
workers, and once more with two workers, killed at equal parts of the way and started again. The hash is of all names
and bytes of a folder.

Costs are processor seconds of one process, after its first picture, so that other work on the machine counts less:
*decode* reads the pictures alone, *online* also makes a pair of one crop of each, *shards* is synth. Files are decoded
in the process itself (``RAWAUG_READ_SECONDS=0``).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import rawaug
from rawaug.commands.synth import synth
from rawaug.data import PictureFolder, demo_pictures
from rawaug.io import read_picture, write_picture
from rawaug.seeding import keyed_generator

ONLINE_CROP = 256


def generate(folder: Path, count: int, height: int, width: int) -> None:
    """``count`` crops at random places of up to 32 built-in pictures, enlarged where one is too small."""
    sources = [picture[None].float() for picture in demo_pictures(min(count, 32))]
    for k in range(count):
        generator, source = keyed_generator("shards", k), sources[k % len(sources)]
        scale = max(1.0, (height + 2) / source.shape[2], (width + 2) / source.shape[3])
        if scale > 1:
            source = torch.nn.functional.interpolate(source, scale_factor=scale, mode="bilinear")
        free = (source.shape[2] - height, source.shape[3] - width)
        top, left = (int(torch.randint(n + 1, (), generator=generator)) for n in free)
        crop = source[0, :, top : top + height, left : left + width].round().clamp(0, 255).to(torch.uint8)
        file = folder / f"{k // 1000:03d}" / f"{k:06d}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        write_picture(file, crop)


def run(pictures: Path, out: Path, workers: int, kills: int, shards: int) -> None:
    """Synth in processes of its own, killed ``kills`` times before it may finish."""
    command = [sys.executable, "-m", "rawaug.cli", "synth", str(pictures), str(out), "--format", "webdataset"]
    count = sum(1 for _ in pictures.rglob("*.jpg"))
    command += ["--workers", str(workers), "--per-shard", str(-(-count // shards))]
    for kill in range(1, kills + 1):
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while done(out) < shards * kill // (kills + 1) and process.poll() is None:
                time.sleep(0.01)
            process.kill()
        print(f"  killed with {done(out)} of {shards} shards done")
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def done(out: Path) -> int:
    """Shards that are there."""
    return len(list((out / ".shards").glob("*.json")))


def digest(folder: Path) -> tuple[str, int]:
    """SHA-256 of all names and bytes, and their number."""
    whole, size = hashlib.sha256(), 0
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = file.read_bytes()
        whole.update(f"{file.relative_to(folder)} {len(content)} ".encode() + content)
        size += len(content)
    return whole.hexdigest(), size


def costs(folder: Path, out: Path) -> dict[str, float]:
    """Processor seconds of decoding every picture, of one online pair of each, and of their shards."""
    pictures = PictureFolder(folder)
    crop = min(ONLINE_CROP, *(side // 2 * 2 for side in pictures[0].shape[1:]))
    pairs = rawaug.RawPairs(pictures, "universal", crop=crop)
    pairs[0]  # compiles
    ways: dict[str, Callable[[], object]] = {
        "decode": lambda: [read_picture(folder / name).shape for name in pictures.names],
        "online": lambda: [pairs[k].noisy.shape for k in range(len(pictures))],
        "shards": lambda: synth(folder, out, "webdataset", workers=0),
    }
    seconds = {}
    for name, run_all in ways.items():
        start = time.process_time()
        run_all()
        seconds[name] = time.process_time() - start
    return seconds


def measure(folder: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Hashes of all runs, bytes and processor seconds."""
    pictures, shards = folder / "pictures", min(40, args.pictures)
    generate(pictures, args.pictures, *args.size)
    megapixels = args.pictures * args.size[0] * args.size[1] / 1e6
    seconds = costs(pictures, folder / "alone") if args.costs else {}
    hashes, size = dict[str, str](), digest(folder / "alone")[1]
    ways = [(f"{workers} workers", workers, 0) for workers in args.workers]
    ways += [(f"2 workers, killed {args.kills} times", 2, args.kills)] if args.kills else []
    for name, workers, kills in ways:
        run(pictures, folder / "out", workers, kills, shards)
        hashes[name], size = digest(folder / "out")
        shutil.rmtree(folder / "out")
        print(f"  {name:28s} {hashes[name]}", flush=True)
    speed = {name: megapixels / taken for name, taken in seconds.items()}
    return {
        "pictures": args.pictures,
        "size": args.size,
        "hashes": hashes,
        "same": len(set(hashes.values())) <= 1,
        "processor_seconds": seconds,
        "mpix_a_processor_second": speed,
        "bytes": size,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pictures", type=int, default=20000)
    parser.add_argument("--size", type=int, nargs=2, default=[64, 64], help="height and width")
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 4])
    parser.add_argument("--kills", type=int, default=2)
    parser.add_argument("--no-costs", action="store_false", dest="costs", help="compare the bytes alone")
    parser.add_argument("--quick", action="store_true", help="40 pictures")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args()
    args.pictures = 40 if args.quick else args.pictures
    torch.set_num_threads(1)
    os.environ["RAWAUG_READ_SECONDS"] = "0"  # and that of the processes started here
    print(f"{args.pictures} pictures of {args.size[0]} x {args.size[1]}")
    with tempfile.TemporaryDirectory() as folder:
        result = measure(Path(folder), args)
    for name, speed in result["mpix_a_processor_second"].items():
        print(f"  {name:28s} {speed:8.2f} Mpix a processor second")
    print(f"  {result['bytes'] / args.pictures:.0f} bytes a picture")
    if result["hashes"]:
        print(f"  the same bytes: {'yes' if result['same'] else 'NO'}")
    if args.json:
        args.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 0 if result["same"] else 1


if __name__ == "__main__":
    sys.exit(main())
