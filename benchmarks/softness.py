"""How soft cameras are beside photographs: the table behind ``rawaug.camera.softness``, and the blur of real frames.

    python -m benchmarks.softness --data ../shared/data

prints the steepness of photographs by the blur in pixels, then the blur that makes them as soft as each RAW file.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from rawaug.camera.softness import STEEPNESS, edge_steepness, measure_blur
from rawaug.io import decode_srgb, read_picture, read_raw
from rawaug.io.raw import RAW_EXTENSIONS
from rawaug.kernels.reference import blur, blur_taps

FRAMES = ("raw/canon", "raw/gopro", "raw_jpeg/gopro", "real_raw/d5000")
"""Folders of RAW files at full size."""
PHOTOGRAPHS = ("photos/train", "photos/test", "srgb")


def measure_photographs(files: list[Path], deviation: float) -> list[float]:
    """Measure the 0.9 quantile of the steepness in each photograph that has enough edges, after a blur in pixels."""
    quantiles = []
    for file in files:
        light = decode_srgb(read_picture(file).float() / 255.0)[None]
        soft = blur(light, blur_taps(torch.tensor([deviation])))
        steepness = edge_steepness(soft[0, 1].numpy(), "RGGB")
        if len(steepness) >= 50:
            quantiles.append(float(np.quantile(steepness, 0.9)))
    return quantiles


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with the photographs and the RAW files")
    parser.add_argument("--every", type=int, default=1, help="use every n-th photograph")
    options = parser.parse_args()

    print("steepness of photographs (median of their 0.9 quantiles) by blur in pixels")
    for folder in PHOTOGRAPHS:
        files = sorted(file for file in (options.data / folder).iterdir() if file.suffix in (".jpg", ".png"))
        row = []
        for deviation in STEEPNESS:
            quantiles = measure_photographs(files[:: options.every], deviation)
            row.append(f"{deviation:g}: {np.median(quantiles):.3f}")
        print(f"{folder:14s} " + "  ".join(row), flush=True)

    print("blur in pixels that makes photographs as soft as a RAW file, by the table of rawaug.camera.softness")
    for folder in FRAMES:
        for file in sorted((options.data / folder).iterdir()):
            if file.suffix.lower() not in RAW_EXTENSIONS:
                continue
            frame = read_raw(file)
            measured = measure_blur([(frame.mosaic[0].numpy(), frame.cfa)])
            print(f"{file.name:24s} {'no edges' if measured is None else f'{measured:.2f}'}", flush=True)


if __name__ == "__main__":
    main()
