"""What the hulls of colour, light and tone atoms hold, and whether it holds for cameras and curves not looked at.

    python -m benchmarks.hulls [--halves 5]
    python -m benchmarks.hulls --figure docs/coverage.png
    python -m benchmarks.hulls --patches

Cameras: the error is that of linear colour on photographs, between a camera's own sRGB-to-camera matrix and the nearest
mixture of the atoms; a camera is held within 45 dB. Atoms are chosen greedily from a random half of the matrices and
judged on the other half, and from all. Gains: the RAW of a white surface, of halves of the cameras likewise, each in
lights of its own. Tones: each
curve left out in turn, PSNR of linear light over all codes under the nearest mixture of the others. The figure shows
the shipped ISPs instead: nothing is chosen for it.

Patches: flat pictures of one colour, made RAW by a shipped ISP at no change of exposure and developed again by the same
draw, and by how many codes of 255 the median and the worst of 16 draws changed them. Colours that a matrix takes beyond
the sensor's range are clipped there.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measure import parser
from benchmarks.universal import (
    DECIBEL,
    camera_points,
    chosen_atoms,
    chosen_gains,
    distinct_cameras,
    held,
    inverse_gains_in_any_light,
    psnr,
    tone_points,
    tone_tables,
)
from rawaug import Draw, RawAugment
from rawaug.camera.matrices import load_cameras
from rawaug.isp.dictionary import CameraDictionary, nearest_in_hull
from rawaug.isp.model import DictionaryISP

ATOMS, GAINS = 10, 16
"""Of the shipped ISP ``universal``."""


def split(points: Tensor, seed: int) -> tuple[Tensor, Tensor]:
    """Two random halves of points or cameras ``(N, ...)``."""
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
    return points[order[::2]], points[order[1::2]]


def of_other_half(points: Tensor, atoms: int, seed: int) -> float:
    """Share of one half of the points within 45 dB of the hull of atoms from the other."""
    seen, unseen = split(points, seed)
    return held(unseen, seen[chosen_atoms(seen, atoms).atoms])


def lights_of_other_half(cameras: Tensor, atoms: int, seed: int) -> float:
    """The same for gains: atoms of one half of the cameras in random lights, and the other half in other lights."""
    halves = zip(split(cameras, seed), ("seen", "unseen"), strict=True)
    seen, unseen = (inverse_gains_in_any_light(half, f"{name} {seed}") for half, name in halves)
    return held(unseen / 3**0.5, seen[chosen_gains(seen, atoms).atoms] / 3**0.5)


def left_out_tones() -> dict[str, float]:
    """PSNR of each published curve under the nearest mixture of all others."""
    names, points = list(tone_tables()), tone_points(torch.stack(list(tone_tables().values())))
    errors = {}
    for k, name in enumerate(names):
        others = torch.cat([points[:k], points[k + 1 :]])
        errors[name] = psnr(nearest_in_hull(points[k : k + 1], others)[1]).item()
    return errors


PATCHES = {
    "red": (255, 0, 0),
    "green": (0, 255, 0),
    "blue": (0, 0, 255),
    "yellow": (255, 255, 0),
    "cyan": (0, 255, 255),
    "magenta": (255, 0, 255),
    "grey": (128, 128, 128),
    "skin": (224, 172, 145),
}
"""sRGB codes; skin is a light one."""


@torch.no_grad()
def change_of_patches(isp: str, draws: int = 16) -> dict[str, tuple[float, float]]:
    """By how many codes of 255 flat colours change on the way to RAW and back, without noise: median and worst."""
    augment = RawAugment.from_pretrained(isp, noise=(0.0, 0.0), draw=Draw(exposure=0.0))
    changes = {}
    for name, codes in PATCHES.items():
        picture = (torch.tensor(codes) / 255.0)[:, None, None].expand(draws, 3, 32, 32)
        pairs = augment(picture, generator=torch.Generator().manual_seed(0))
        developed = augment.develop(pairs.clean, pairs.params, "bilinear")
        middle = (developed - picture)[..., 8:-8, 8:-8]
        change = 255 * middle.mean((-2, -1)).abs().amax(1)
        changes[name] = change.median().item(), change.max().item()
    return changes


@torch.no_grad()
def draw(path: Path) -> None:
    """Cameras and gains under the hulls of the shipped ISPs, and every tone curve under the others."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.6, 8.4), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(1, 1.5))
    by_camera, by_light, by_tone = (figure.add_subplot(part) for part in (grid[0, 0], grid[0, 1], grid[1, :]))
    cameras = camera_points(load_cameras().xyz_to_camera)
    shares = torch.linspace(100.0, 0.0, len(cameras))
    for name in ("universal", "universal-small"):
        isp = DictionaryISP.from_pretrained(name)
        assert isinstance(isp.colour, CameraDictionary)
        atoms = camera_points(isp.colour.xyz_to_camera(torch.eye(isp.config.colour_atoms)))
        by_camera.plot(
            psnr(nearest_in_hull(cameras, atoms)[1]).sort().values, shares, label=f"{name}, {len(atoms)} atoms"
        )
    by_camera.set(xlim=(35, 70), xlabel="PSNR of linear colour (dB)", ylabel=f"% of {len(cameras)} cameras above it")
    atoms = 1.0 / DictionaryISP.from_pretrained("universal").gain.channel_gains().double()
    inverse = inverse_gains_in_any_light(distinct_cameras(), "figure", 400)
    kept = psnr(nearest_in_hull(inverse / 3**0.5, atoms / 3**0.5)[1]) >= DECIBEL
    for points, style, label in (
        (1.0 / inverse[kept], "o", f"{int(kept.sum())} draws held"),
        (1.0 / inverse[~kept], "rx", f"{int((~kept).sum())} not held"),
        (1.0 / atoms, "k^", f"{len(atoms)} atoms"),
    ):
        red, _, blue = (points / points[:, 1:2]).unbind(1)
        by_light.loglog(red, blue, style, markersize=4, alpha=0.6, label=label)
    by_light.set(ylim=(0.3, 7), xlabel="red gain over green", ylabel="blue gain over green")
    ticks = (0.5, 1, 2, 4)
    for set_ticks in (by_light.set_xticks, by_light.set_yticks):
        set_ticks(ticks, [f"{tick:g}" for tick in ticks])
        set_ticks([], minor=True)
    tones = left_out_tones()
    by_tone.barh(range(len(tones)), list(tones.values()), color="0.6")
    by_tone.set_yticks(range(len(tones)), list(tones), fontsize=8)
    by_tone.set(xlim=(20, 60), xlabel="PSNR under a mixture of the other curves (dB)")
    for axis in (by_camera, by_tone):
        axis.axvline(DECIBEL, color="0.3", linestyle=":")
    by_camera.legend(fontsize=8, loc="lower left")
    by_light.legend(fontsize=8, loc="lower left")
    figure.savefig(path, dpi=110)


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("--halves", type=int, default=5)
    cli.add_argument("--figure", type=Path, help="draw this figure, and do nothing else")
    cli.add_argument("--patches", action="store_true", help="develop flat colours again, and do nothing else")
    options = cli.parse_args()
    if options.patches:
        for isp in ("universal", "canon-powershot", "gopro-hero"):
            for name, (usual, worst) in change_of_patches(isp).items():
                print(f"{isp}, {name}: {usual:.1f} codes of 255 in the median, {worst:.1f} at most")
        return
    if options.figure is not None:
        draw(options.figure)
        return
    for name, value in left_out_tones().items():
        print(f"tone {name}: {value:.1f} dB under the others")
    cameras = distinct_cameras()
    points = camera_points(cameras)
    print(f"{len(points)} distinct matrices, {ATOMS} atoms", flush=True)
    for seed in range(options.halves):
        print(f"half {seed}: {of_other_half(points, ATOMS, seed):.1%} of the other half", flush=True)
        share = lights_of_other_half(cameras, GAINS, seed)
        print(f"gains, half {seed}: {share:.1%} of the other half's", flush=True)
    print(f"all matrices: {held(points, points[chosen_atoms(points, ATOMS).atoms]):.1%}")


if __name__ == "__main__":
    main()
