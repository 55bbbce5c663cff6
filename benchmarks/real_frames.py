"""Make the frames of ``real:`` from the camera files that they come from.

    python -m benchmarks.real_frames CAMERA_FILES [--out rawaug/data/real_frames]

CAMERA_FILES is a folder with ``raw/canon/*.crw`` and ``raw_jpeg/gopro/hero7_*.dng``, all CC0. Every frame is binned
4 x 4 by colour site, which leaves a twentieth of its own noise, and stored in 14 of 16 bits as a PNG of its planes R,
Gr, Gb, B from top to bottom; ``frames.json`` says what else is known. The own noise is measured on the whole frame.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.measure import parser
from rawaug.bayer import bin_mosaic, bin_mosaic_variance, pack
from rawaug.data.published import REAL_BLACK, REAL_FRAMES, REAL_WHITE
from rawaug.io import RawFrame, read_raw
from rawaug.noise import estimate_noise

BINNED = 4
SPLITS = {
    "train": ("raw/canon/s40_0101.crw", "raw/canon/s40_0104.crw", "raw/canon/s40_0112.crw"),
    "validation": ("raw/canon/g2_0304.crw", "raw/canon/g2_0313.crw"),
    "test": (
        *("raw/canon/s40_0117.crw", "raw/canon/s40_0119.crw"),
        *("raw_jpeg/gopro/hero7_8508.dng", "raw_jpeg/gopro/hero7_8513.dng"),
    ),
}
"""No scene of a camera is in two splits; validation, and half of the test, are of cameras that no other split has."""


def numbers_of(frame: RawFrame) -> np.ndarray:
    """The binned planes as digital numbers, uint16 ``(4 h, w)``."""
    height, width = (side // (2 * BINNED) * 2 * BINNED for side in frame.mosaic.shape[-2:])
    binned = bin_mosaic(frame.mosaic[:, :height, :width].double(), frame.cfa, BINNED)
    planes = pack(binned * (REAL_WHITE - REAL_BLACK) + REAL_BLACK, frame.cfa).round()
    if not 0 <= planes.min() <= planes.max() <= REAL_WHITE:
        raise ValueError(f"{frame.name}: {planes.min():g} to {planes.max():g} leave 0 to {REAL_WHITE}")
    return planes.reshape(-1, planes.shape[-1]).numpy().astype(np.uint16)


def described(file: Path, frame: RawFrame, split: str) -> dict[str, Any]:
    """What ``frames.json`` says of a frame."""
    estimate = estimate_noise(frame.mosaic, frame.cfa)
    return {
        "split": split,
        "camera": frame.camera,
        "iso": frame.iso,
        "cfa": str(frame.cfa),
        "white_balance": frame.white_balance,
        "color_matrix": frame.color_matrix.tolist(),
        "own_noise": [level * bin_mosaic_variance(BINNED) for level in (estimate.shot_var, estimate.read_var)],
        "source": file.name,
        "source_sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
    }


def main(arguments: list[str] | None = None) -> None:
    cli = parser(__doc__)
    cli.add_argument("camera_files", type=Path)
    cli.add_argument("--out", type=Path, default=REAL_FRAMES)
    args = cli.parse_args(arguments)
    args.out.mkdir(parents=True, exist_ok=True)
    frames = {}
    for split, names in SPLITS.items():
        for name in names:
            file = args.camera_files / name
            frame = read_raw(file)
            Image.fromarray(numbers_of(frame)).save(args.out / f"{file.stem}.png", optimize=True)
            frames[file.stem] = described(file, frame, split)
    (args.out / "frames.json").write_text(json.dumps(frames, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
