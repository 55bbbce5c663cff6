"""What share of published cameras a hull of ten colour atoms reaches, and whether this holds for unseen cameras.

    python benchmarks/coverage.py photographs/ [--atoms 10] [--halves 5]

The error is that of linear colour on the photographs, between a camera's own sRGB-to-camera matrix and the nearest
mixture of the atoms; a camera is reached within 45 dB.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from rawaug.io.picture_files import decode_srgb, read_picture
from rawaug.isp.cameras import colour_matrix, published_cameras
from rawaug.isp.hull import colour_coordinates, greedy_atoms, nearest_in_hull, psnr, second_moment

DECIBEL = 45.0


def reached(points: Tensor, atoms: Tensor) -> float:
    """Share of ``points`` within 45 dB of the hull of ``atoms``."""
    return (psnr(nearest_in_hull(points, atoms)[1]) >= DECIBEL).double().mean().item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photographs", type=Path, help="folder of JPEG files")
    parser.add_argument("--atoms", type=int, default=10)
    parser.add_argument("--halves", type=int, default=5)
    options = parser.parse_args()
    files = sorted(options.photographs.glob("*.jpg"))
    if not files:
        raise SystemExit(f"{options.photographs}: contains no *.jpg")
    moment = torch.stack([_moment(file) for file in files]).mean(dim=0)
    points = colour_coordinates(colour_matrix(published_cameras().distinct()), moment)
    print(f"{len(points)} distinct matrices, {len(files)} photographs, {options.atoms} atoms, {DECIBEL:g} dB")
    for half in range(options.halves):
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(half))
        seen, unseen = points[order[::2]], points[order[1::2]]
        share = reached(unseen, seen[greedy_atoms(seen, options.atoms, DECIBEL)])
        print(f"half {half}: {share:.1%} of the other half", flush=True)
    print(f"whole list: {reached(points, points[greedy_atoms(points, options.atoms, DECIBEL)]):.1%}")


def _moment(file: Path) -> Tensor:
    picture = read_picture(file)[:, ::4, ::4]
    return second_moment(decode_srgb(picture.double() / 255.0).flatten(1))


if __name__ == "__main__":
    main()
