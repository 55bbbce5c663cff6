"""What a large folder of pictures with damaged files costs: its start, and an epoch with workers.

    python -m benchmarks.folder [--files 20000] [--damaged 0.01] [--workers 2] [--quick] [--json FILE]

The folder is made first, in a temporary place: small JPEGs in a hundred subfolders, of which a share is truncated,
empty, text, or a link to nowhere. Printed are the seconds until the dataset is there and until the first batch, the
pictures a second of an epoch relative to reading the good files alone without workers, and whether the report names
every damaged file and no other.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from benchmarks.measure import arguments, finish, seconds, start, write_pictures
from rawaug.data import PictureFolder
from rawaug.io import read_picture

DAMAGES = ("truncated", "empty", "text", "dangling")


def make_folder(folder: Path, files: int, damaged: float) -> set[str]:
    """Fill ``folder``; the names of the damaged files."""
    rng = np.random.default_rng(0)
    jpegs = [path.read_bytes() for path in sorted(write_pictures(folder / "whole", 50, (120, 160)).iterdir())]
    shutil.rmtree(folder / "whole")
    bad = set(rng.permutation(files)[: round(files * damaged)].tolist())
    names = set()
    for k in range(files):
        path = folder / f"{k % 100:02d}" / f"{k:06d}.jpg"
        path.parent.mkdir(exist_ok=True)
        whole = jpegs[k % len(jpegs)]
        if k not in bad:
            path.write_bytes(whole)
            continue
        names.add(path.name)
        damage = DAMAGES[len(names) % len(DAMAGES)]
        if damage == "dangling":
            path.symlink_to(folder / "nowhere")
        else:
            path.write_bytes({"truncated": whole[: len(whole) // 2], "empty": b"", "text": b"<html>"}[damage])
    return names


def epoch(pictures: PictureFolder, workers: int, began: float) -> dict[str, Any]:
    """Read every picture once, shuffled."""
    order = torch.Generator().manual_seed(0)
    loader = DataLoader(pictures, batch_size=50, shuffle=True, generator=order, num_workers=workers)
    count, first = 0, 0.0
    for batch in loader:
        first = first or time.perf_counter() - began
        count += len(batch)
    return {"first_batch_s": first, "epoch_s": time.perf_counter() - began, "pictures": count}


def main() -> int:
    cli = arguments(__doc__, repeats=1, quick="2,000 files")
    cli.add_argument("--files", type=int, default=20_000)
    cli.add_argument("--damaged", type=float, default=0.01, help="share of them")
    cli.add_argument("--workers", type=int, default=2)
    cli.set_defaults(threads=1)
    args = cli.parse_args()
    args.files = min(args.files, 2000) if args.quick else args.files
    result = start(args)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        damaged = make_folder(folder, args.files, args.damaged)
        good = [path for path in sorted(folder.rglob("*.jpg"))[:1000] if path.name not in damaged]
        alone = len(good) / seconds(lambda: [read_picture(path) for path in good], args.device)
        began = time.perf_counter()
        pictures = PictureFolder(folder)
        result["start_s"] = time.perf_counter() - began
        result |= epoch(pictures, args.workers, began)
        named = {path.name for path in pictures.skipped}
    rate = result["pictures"] / result["epoch_s"]
    result |= {"pictures_per_s": rate, "ratio_to_reading_alone": rate / alone, "report_is_exact": named == damaged}
    print(json.dumps(result, indent=1))
    finish(result, args)
    return 0 if named == damaged else 1


if __name__ == "__main__":
    sys.exit(main())
