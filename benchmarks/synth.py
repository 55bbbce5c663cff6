"""What ``rawaug synth`` costs: pairs on disk from a folder of pictures, against decoding the same pictures alone.

    python benchmarks/synth.py [PICTURES] [--formats npz dng] [--workers N] [--repeats 3] [--quick] [--json FILE]

Both read every picture once with the same number of processes; the fastest run of each counts, the start of the
processes left out of both. Printed are million pixels a second and the ratio of the times. Pictures are those of
PICTURES, or the built-in ones written to a folder, several times over.
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
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch

from rawaug.commands import synth
from rawaug.commands.pair_files import picture_tasks
from rawaug.commands.pair_maker import Settings
from rawaug.commands.pair_shards import shard_tasks
from rawaug.data import demo_pictures
from rawaug.files import find_weights, sha256
from rawaug.io import read_picture, write_picture
from rawaug.plugin.sampling_config import Drawing

COPIES = 8
"""Of the built-in pictures, so that a run takes seconds."""


def decode(picture: Path) -> int:
    """Its pixels."""
    return read_picture(picture)[0].numel()


def start(settings: Any) -> None:
    """What a worker of synth does before its first picture; for decoding too, so that both are as warm."""
    torch.set_num_threads(1)
    synth._prepare(settings)


def seconds(work: Callable[[Any], object], tasks: list[Any], warm: list[Any], settings: Any, workers: int) -> float:
    """Of all tasks, in a pool whose processes have done others already."""
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(workers, context, initializer=start, initargs=(settings,)) as pool:
        list(pool.map(work, warm))
        begin = time.perf_counter()
        list(pool.map(work, tasks))
        return time.perf_counter() - begin


def planned(form: str, pictures: list[Path], folder: Path, out: Path) -> list[Any]:
    """The tasks of a run; a shard has eight pictures, so that there are enough for all processes."""
    if form == "webdataset":
        return list(shard_tasks(pictures, folder, out, per_image=1, per_shard=8))
    return list(picture_tasks(pictures, folder, out, per_image=1))


def measure(folder: Path, formats: list[str], workers: int, repeats: int) -> dict[str, Any]:
    """Mpix/s of decoding and of each format, and each format's time over that of decoding."""
    pictures = synth._pictures(folder, Path(os.devnull))
    megapixels = sum(decode(picture) for picture in pictures) / 1e6
    weights, best = sha256(find_weights("universal")), dict.fromkeys(("decode", *formats), float("inf"))
    for name in [*best] * repeats:
        with tempfile.TemporaryDirectory() as out:
            form: Any = "npz" if name == "decode" else name
            settings = Settings(form, Drawing(), weights, 0)
            tasks, warm = (planned(form, pictures, folder, Path(out) / part) for part in ("timed", "warm"))
            work: tuple[Any, Any, Any] = (synth._make, tasks, warm[: 4 * workers])
            if name == "decode":
                work = (decode, pictures, pictures[: 4 * workers])
            best[name] = min(best[name], seconds(*work, settings, workers))
    speed = {name: megapixels / taken for name, taken in best.items()}
    ratios = {name: best[name] / best["decode"] for name in formats}
    return {"pictures": len(pictures), "mpix_s": speed, "time_over_decoding": ratios}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", type=Path, nargs="?", help="folder of pictures; by default the built-in ones")
    parser.add_argument("--formats", nargs="+", choices=("dng", "npz", "tiff", "webdataset"), default=["npz", "dng"])
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="one repeat, the built-in pictures once")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as written:
        if args.pictures is None:
            for i, picture in enumerate(demo_pictures() * (1 if args.quick else COPIES)):
                write_picture(Path(written) / f"{i:03d}.png", picture)
        result = measure(args.pictures or Path(written), args.formats, args.workers, 1 if args.quick else args.repeats)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {args.workers} workers, torch {torch.__version__}"
    print(f"{result['pictures']} pictures ({machine})")
    for name, speed in result["mpix_s"].items():
        ratio = result["time_over_decoding"].get(name)
        print(f"  {name:8s} {speed:6.2f} Mpix/s" + (f"   {ratio:.2f} times decoding" if ratio else ""))
    if args.json:
        args.json.write_text(json.dumps({"machine": machine, **result}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
