r"""Denoisers side by side on pieces of a frame, over noise: the figure of docs/denoise.md.

    python -m benchmarks.crops DATA --place NAME TOP LEFT [--place ...] \
        [--denoisers rawaug-small] [--iso 1600 6400 25600] [--camera "Sony ILCE-7M3"] --out FIGURE.png

A row is a piece of 256 x 256 at one ISO of the camera. PSNR is that of RAW, on the piece and its margin. Beside the
frames of DATA there is ``page``: print in several sizes and colours, shot by the demo camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.measure import parser
from rawaug.bayer import CFA
from rawaug.data import DemoCamera, open_pairs
from rawaug.data.demo import FRAME
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.figures import PANEL, Panels, make_panels, save_picture
from rawaug.evaluation.trials import make_trial
from rawaug.noise import NoiseModel, noise_model
from rawaug.seeding import keyed_generator

MARGIN = 64
"""Most mosaic pixels around a piece that are denoised with it."""
PRINT = (
    (30, "#202020", "Shot noise"),
    (16, "#a02020", "has a variance in proportion"),
    (16, "#2040a0", "to the light: sqrt(n) of n."),
    (12, "#303030", "Read noise is the same in light and"),
    (12, "#303030", "shade: it is what shadows show."),
    (9, "#206030", "Small print: ISO 100, 200, 400, 800, 1600"),
    (7, "#303030", "Smaller print: 3200; 6400; 12,800; 25,600; 51,200"),
    (6, "#a02020", "Smallest print: 102,400; 204,800; 409,600; 819,200"),
)
"""Lines of the page: pixels of an em, colour, words."""


def page() -> Pair:
    """A page of :data:`PRINT` on grey paper, shot by the demo camera at ISO 100."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    height, width = FRAME
    figure = Figure(figsize=(width / 72, height / 72), dpi=72, facecolor="#d8d4cc")
    top = 20.0
    for size, colour, words in PRINT:
        top += 1.9 * size
        figure.text(24 / width, 1 - top / height, words, color=colour, size=size)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = torch.from_numpy(np.array(canvas.buffer_rgba())[..., :3]).permute(2, 0, 1).contiguous()
    return DemoCamera().capture(picture, keyed_generator(0, "page"), name="page", iso=100)


def row(pair: Pair, place: tuple[int, int], noise: NoiseModel, names: list[str], cfa: CFA) -> Panels:
    """The panels of one piece, packed by ``cfa``; its margin is denoised with it and cut off by the figure."""
    top, left = place
    height, width = pair.clean.mosaic.shape[-2:]
    margin = min(MARGIN, top, left, height - PANEL - top, width - PANEL - left) // 2 * 2
    if margin < 0:
        raise SystemExit(f"{pair.name}: {PANEL} x {PANEL} at {top}, {left} is not within {height} x {width}")
    rows = slice(top - margin, top + PANEL + margin)
    columns = slice(left - margin, left + PANEL + margin)
    raw, srgb = pair.clean.mosaic[:, rows, columns], pair.srgb[:, rows, columns]
    piece = replace(pair, clean=replace(pair.clean, mosaic=raw), srgb=srgb, noisy=None)
    return make_panels([RawDenoiser.of(name) for name in ("NonLocalMeans", *names)], make_trial(piece, noise, cfa))


def main(argv: Sequence[str] | None = None) -> None:
    cli = parser(__doc__)
    cli.add_argument("data", help="frames: a folder of RAW files, or kind:path")
    cli.add_argument("--place", nargs=3, action="append", required=True, metavar=("NAME", "TOP", "LEFT"))
    cli.add_argument("--denoisers", nargs="+", default=["rawaug-small"], help="shipped ones by name, or files")
    cli.add_argument("--iso", nargs="+", type=float, default=[1600, 6400, 25600])
    cli.add_argument("--camera", default="Sony ILCE-7M3")
    cli.add_argument("--out", type=Path, required=True)
    options = cli.parse_args(argv)
    torch.set_num_threads(1)
    frames = list(open_pairs(options.data, split="test"))
    cfa, pairs = CFA(frames[0].cfa), {pair.name: pair for pair in [page(), *frames]}
    rows = []
    for name, top, left in options.place:
        for iso in options.iso:
            place = int(top) // 2 * 2, int(left) // 2 * 2
            rows.append(row(pairs[name], place, noise_model(options.camera, iso=iso), options.denoisers, cfa))
    save_picture(rows, options.out)


if __name__ == "__main__":
    main()
