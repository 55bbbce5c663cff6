"""What the hulls of colour, light and tone atoms hold, and whether it holds for cameras and curves not looked at.

    python benchmarks/hulls.py [--photographs FOLDER] [--atoms 10] [--halves 5]

Cameras: the error is that of linear colour on photographs, between a camera's own sRGB-to-camera matrix and the nearest
mixture of the atoms; a camera is held within 45 dB. Atoms are chosen greedily from a random half of the matrices and
judged on the other half, and from all. Gains: the RAW of a white surface under random cameras and lights. Tones: each
curve left out in turn, PSNR of linear light over all codes under the nearest mixture of the others.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor

from rawaug.io.picture_files import decode_srgb, read_picture
from rawaug.isp.cameras import colour_matrix, published_cameras
from rawaug.isp.hull import colour_coordinates, nearest_in_hull, psnr, second_moment
from rawaug.isp.tone_curves import tone_names, tone_tables
from rawaug.isp.universal import COLOURS, chosen_atoms, held, inverse_gains_in_any_light, tone_points


def halves(points: Tensor, atoms: int, count: int) -> list[float]:
    """Share of one half of the points within 45 dB of the hull of atoms from the other, for random halves."""
    shares = []
    for seed in range(count):
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
        seen, unseen = points[order[::2]], points[order[1::2]]
        shares.append(held(unseen, seen[chosen_atoms(seen, atoms).atoms]))
    return shares


def left_out_tones() -> dict[str, float]:
    """PSNR of each published curve under the nearest mixture of all others."""
    names, points = tone_names(), tone_points(tone_tables())
    errors = {}
    for k, name in enumerate(names):
        others = torch.cat([points[:k], points[k + 1 :]])
        errors[name] = psnr(nearest_in_hull(points[k : k + 1], others)[1]).item()
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photographs", type=Path, help="folder of JPEG files; those of the package by default")
    parser.add_argument("--atoms", type=int, default=10)
    parser.add_argument("--gains", type=int, default=16)
    parser.add_argument("--halves", type=int, default=5)
    options = parser.parse_args()
    for name, value in left_out_tones().items():
        print(f"tone {name}: {value:.1f} dB under the others")
    moment = torch.tensor(COLOURS) if options.photographs is None else _moment(options.photographs)
    cameras = published_cameras().distinct()
    points = colour_coordinates(colour_matrix(cameras), moment)
    print(f"{len(points)} distinct matrices, {options.atoms} atoms", flush=True)
    for seed, share in enumerate(halves(points, options.atoms, options.halves)):
        print(f"half {seed}: {share:.1%} of the other half", flush=True)
    gains = inverse_gains_in_any_light(cameras) / 3**0.5
    for seed, share in enumerate(halves(gains, options.gains, options.halves)):
        print(f"gains, half {seed}: {share:.1%} of the other half", flush=True)
    print(f"all matrices: {held(points, points[chosen_atoms(points, options.atoms).atoms]):.1%}")


def _moment(folder: Path) -> Tensor:
    files = sorted(folder.glob("*.jpg"))
    if not files:
        raise SystemExit(f"{folder}: no *.jpg in it")
    pictures = (read_picture(file)[:, ::4, ::4].double() / 255.0 for file in files)
    return torch.stack([second_moment(decode_srgb(picture).flatten(1)) for picture in pictures]).mean(dim=0)


if __name__ == "__main__":
    main()
