"""What a move of a control costs on the page of ``rawaug explore``, tab by tab, without the browser.

    python -m benchmarks.explore [--size 512 768] [--repeats 5] [--quick] [--json FILE]

A move is a new seed, or another camera; the time is that of the new pictures and of the HTML that is sent: milliseconds
of the processor and of the clock, the median of the repeats.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.measure import arguments, finish, show, start
from rawaug.data.demo import demo_files
from rawaug.explore.page import as_html
from rawaug.explore.views import VIEWS, Look, denoise
from rawaug.io import read_picture, write_picture
from rawaug.plugin.config import AugmentConfig

CAMERAS = ("Nikon D750", "Canon EOS 6D", "Sony ILCE-7M3", "Nikon D90", "Canon EOS 5D Mark II", "Nikon D800")


def picture(folder: Path, height: int, width: int) -> Path:
    """A photograph of this size."""
    source = next(read_picture(file) for file in demo_files() if file.stem == "hubble_deep_field")
    enlarged = torch.nn.functional.interpolate(source[None].float(), (height, width), mode="area")[0]
    write_picture(folder / "picture.png", enlarged.round().to(torch.uint8))
    return folder / "picture.png"


def moves(file: Path, tab: str, repeats: int) -> dict[str, float]:
    """Milliseconds of the moves by kind and clock; the first move of a kind compiles, and is left out."""
    view = {**VIEWS, "Denoise": denoise}[tab]
    look = Look(str(file), AugmentConfig())
    cameras = [CAMERAS[k % len(CAMERAS)] for k in range(repeats + 1)]
    kinds = {
        "seed": [replace(look, seed=k) for k in range(repeats + 1)],
        "camera": [replace(look, config=AugmentConfig(camera=camera), seed=k) for k, camera in enumerate(cameras)],
    }
    medians: dict[str, float] = {}
    for kind, looks in kinds.items():
        taken: dict[str, list[float]] = {f"{kind}, processor": [], f"{kind}, clock": []}
        for one in looks:
            before = time.process_time(), time.perf_counter()
            as_html(view(one))
            after = time.process_time(), time.perf_counter()
            for clock, start_, end in zip(taken.values(), before, after, strict=True):
                clock.append(1e3 * (end - start_))
        medians |= {clock: statistics.median(values[1:]) for clock, values in taken.items()}
    return medians


def main() -> None:
    parser = arguments(__doc__, repeats=5, quick="one move a tab, of a small picture")
    parser.add_argument("--size", type=int, nargs=2, default=[512, 768], help="height and width")
    args = parser.parse_args()
    size, repeats = ([96, 144], 1) if args.quick else (args.size, args.repeats)
    figures = start(args)
    with tempfile.TemporaryDirectory() as folder:
        file = picture(Path(folder), *size)
        for tab in (*VIEWS, "Denoise"):
            figures[tab] = moves(file, tab, repeats)
            show({tab: figures[tab]}, width=12)
    finish(figures, args)


if __name__ == "__main__":
    main()
