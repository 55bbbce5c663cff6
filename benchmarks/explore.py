"""What a move of a control costs on the page of ``rawaug explore``, tab by tab, without the browser.

    python benchmarks/explore.py [--size 512 768] [--repeats 5] [--quick] [--json FILE]

A move is a new seed, or another camera; the time is that of the new pictures and of the HTML that is sent. Printed are
processor seconds and seconds by the clock, the median of the repeats, on the threads of PyTorch that are left as they
are.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from rawaug.data.demo.pairs import demo_files
from rawaug.explore.page import as_html
from rawaug.explore.view_state import Look
from rawaug.explore.views import VIEWS, denoised
from rawaug.io import read_picture, write_picture
from rawaug.plugin.sampling_config import Drawing

CAMERAS = ("Nikon D750", "Canon EOS 6D", "Sony ILCE-7M3", "Nikon D90", "Canon EOS 5D Mark II", "Nikon D800")


def picture(folder: Path, height: int, width: int) -> Path:
    """A photograph of this size."""
    source = next(read_picture(file) for file in demo_files() if file.stem == "hubble_deep_field")
    enlarged = torch.nn.functional.interpolate(source[None].float(), (height, width), mode="area")[0]
    write_picture(folder / "picture.png", enlarged.round().to(torch.uint8))
    return folder / "picture.png"


def moves(file: Path, tab: str, repeats: int) -> dict[str, list[tuple[float, float]]]:
    """Processor and clock seconds of the moves, by kind; the first move of a kind compiles, and is left out."""
    view = {**VIEWS, "Denoise": denoised}[tab]
    look = Look(str(file), Drawing())
    cameras = [CAMERAS[k % len(CAMERAS)] for k in range(repeats + 1)]
    kinds = {
        "seed": [replace(look, seed=k) for k in range(repeats + 1)],
        "camera": [replace(look, drawing=Drawing(camera=camera), seed=k) for k, camera in enumerate(cameras)],
    }
    taken: dict[str, list[tuple[float, float]]] = {}
    for kind, looks in kinds.items():
        for one in looks:
            processor, clock = time.process_time(), time.perf_counter()
            as_html(view(one))
            taken.setdefault(kind, []).append((time.process_time() - processor, time.perf_counter() - clock))
    return {kind: seconds[1:] for kind, seconds in taken.items()}


def medians(pairs: list[tuple[float, float]]) -> list[float]:
    return [statistics.median(values) for values in zip(*pairs, strict=True)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, nargs=2, default=[512, 768], help="height and width")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one move a tab, of a small picture")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    args = parser.parse_args()
    size, repeats = ([96, 144], 1) if args.quick else (args.size, args.repeats)
    rows = {}
    with tempfile.TemporaryDirectory() as folder:
        file = picture(Path(folder), *size)
        print(f"{size[1]} x {size[0]}, {torch.get_num_threads()} threads: processor / clock, milliseconds")
        for tab in (*VIEWS, "Denoise"):
            rows[tab] = {kind: medians(taken) for kind, taken in moves(file, tab, repeats).items()}
            text = "   ".join(f"{kind} {1e3 * cpu:5.0f} / {1e3 * wall:5.0f}" for kind, (cpu, wall) in rows[tab].items())
            print(f"  {tab:12s} {text}", flush=True)
    if args.json:
        args.json.write_text(json.dumps({"size": size, "seconds": rows}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
