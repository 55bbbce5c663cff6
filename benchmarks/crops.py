r"""Denoisers side by side on pieces of a frame, over noise: the figure of docs/denoise.md.

    python -m benchmarks.crops DATA --place NAME TOP LEFT [--place ...] \
        [--denoisers rawaug-small] [--iso 1600 6400 25600] [--camera "Sony ILCE-7M3"] --out FIGURE.png

A row is a piece of 256 x 256 at one ISO of the camera. PSNR is that of RAW, on the piece and its margin.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

import denoisers
from denoisers.pretrained import find
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.pair import Pair
from rawaug.evaluation.scores import Method, classical_method, network_method, row_of
from rawaug.evaluation.tables import PANEL, Row, draw
from rawaug.noise import NoiseModel, noise_model

MARGIN = 64
"""Most mosaic pixels around a piece that are denoised with it."""


def row(pair: Pair, place: tuple[int, int], noise: NoiseModel, names: list[str]) -> Row:
    """The panels of one piece, whose margin is denoised with it and cut off by the figure."""
    top, left = place
    height, width = pair.raw.shape[-2:]
    margin = min(MARGIN, top, left, height - PANEL - top, width - PANEL - left) // 2 * 2
    if margin < 0:
        raise SystemExit(f"{pair.name}: {PANEL} x {PANEL} at {top}, {left} is not within {height} x {width}")
    rows = slice(top - margin, top + PANEL + margin)
    columns = slice(left - margin, left + PANEL + margin)
    raw, srgb = pair.raw[:, rows, columns], pair.srgb[:, rows, columns]
    piece = replace(pair, raw=raw, srgb=srgb, noisy=None, shot_var=None, read_var=None)
    cfa = CFA(pair.cfa)
    methods: dict[str, Method] = {"NonLocalMeans": classical_method("NonLocalMeans", noise, 0)}
    for name in names:
        model, info = denoisers.load(find(name))
        methods[Path(name).stem] = network_method(model, cfa, CFA(info.get("cfa", "RGGB")))
    return row_of(methods, piece, noise, cfa, 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="frames: a folder of RAW files, or kind:path")
    parser.add_argument("--place", nargs=3, action="append", required=True, metavar=("NAME", "TOP", "LEFT"))
    parser.add_argument("--denoisers", nargs="+", default=["rawaug-small"], help="shipped ones by name, or files")
    parser.add_argument("--iso", nargs="+", type=float, default=[1600, 6400, 25600])
    parser.add_argument("--camera", default="Sony ILCE-7M3")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    torch.set_num_threads(1)
    pairs = {pair.name: pair for pair in open_pairs(options.data, split="test")}
    rows = []
    for name, top, left in options.place:
        for iso in options.iso:
            place = int(top) // 2 * 2, int(left) // 2 * 2
            rows.append(row(pairs[name], place, noise_model(options.camera, iso=iso), options.denoisers))
    draw(rows, CFA(next(iter(pairs.values())).cfa), options.out)


if __name__ == "__main__":
    main()
