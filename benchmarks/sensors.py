"""Denoisers on sensors as they are, at low noise and beside clipped lights: RAW in dB, levels told with the noise.

    python -m benchmarks.sensors rawaug-small rawaug-base NonLocalMeans PMRID.safetensors --data CANON --bin 4

Denoisers are named as for ``rawaug benchmark``. Four tables: defects, offsets, banding and levels that are wrong, at
:data:`ORDINARY`; whole frames, first balanced, whose greens are made to differ; what is left of weak noise in flat
patches, and the frames' PSNR there; the squared error in cells whose two greens are clipped, and within :data:`BESIDE`
cells of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from benchmarks.measure import arguments, finish, start
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.pairs import centre
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.raw import equalise_greens
from rawaug.evaluation.scores import NoisyInput, ScoredDenoiser
from rawaug.evaluation.tables import print_rows
from rawaug.io import RawFrame
from rawaug.noise import SensorNoise
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

ORDINARY = (4e-3, 2e-5)
SENSORS: dict[str, dict[str, Any]] = {
    "as trained": {},
    "hot pixels 3e-4, dead 1e-4": {"hot": 3e-4, "dead": 1e-4},
    "told half the variance": {"told": 0.5},
    "told twice the variance": {"told": 2.0},
    "black offset 2e-3, by colour 1e-3": {"black_offset_sd": 2e-3, "colour_bias_sd": 1e-3},
    "row_var 2e-6": {"row_var": 2e-6},
    "row_var 1e-5": {"row_var": 1e-5},
    "heavy tails (Tukey lambda -0.2)": {"tukey_lambda": -0.2},
}
GREENS: dict[str, dict[str, Any]] = {
    "whole frames": {},
    "whole frames, balanced": {"balance": True},
    "greens differ by 1 %": {"green_imbalance": 0.01},
    "greens differ by 1 %, balanced": {"green_imbalance": 0.01, "balance": True},
}
WEAK = ((2e-5, 1e-8), (1.6e-4, 1e-7), (6e-4, 1e-6))
BRIGHT = ((2e-3, 1e-5), (1e-2, 1e-4))
CLIPPED, BESIDE = 0.99, 3
"""Least green of a clipped cell, and cells around it that count as beside it."""
Shots = Sequence[tuple[str, Tensor]]
"""Names and clean packed RAW ``(1, 4, h, w)``."""


def noisy_shots(
    shots: Shots, levels: tuple[float, float], told: float = 1.0, balance: bool = False, **sensor: Any
) -> Iterator[tuple[Tensor, Noisy]]:
    """Clean RAW, and noisy RAW with the levels that a denoiser is told, a frame; keyed by the frame's name."""
    noise = SensorNoise(levels, **sensor)
    for name, clean in shots:
        params = noise.sample(1, keyed_generator(0, "sensors", name))
        noisy = noise.apply(clean, params)
        if balance:
            frame = RawFrame(bayer.unpack(noisy, CFA.RGGB)[0], CFA.RGGB)
            noisy = bayer.pack(equalise_greens(frame)[0].mosaic[None], CFA.RGGB)
        yield clean, Noisy.of(noisy, (told * levels[0], told * levels[1]), CFA.RGGB)


def balanced(clean: Tensor) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` whose greens agree as far as they can be measured."""
    raw = bayer.unpack(clean, CFA.RGGB)[0]
    found = bayer.measure_greens(raw, CFA.RGGB)
    return clean if found is None else bayer.pack(bayer.balance_greens(raw, CFA.RGGB, found)[None], CFA.RGGB)


def decibels(error: Tensor) -> float:
    """Of the mean squared error."""
    return round(-10.0 * error.mean().log10().item(), 2)


def mean_psnr(one: ScoredDenoiser, shots: Shots, levels: tuple[float, float], **sensor: Any) -> float:
    """PSNR, the mean over frames."""
    made = noisy_shots(shots, levels, **sensor)
    scores = [decibels((one(y).clamp(max=1.0) - x).square()) for x, y in made]
    return round(sum(scores) / len(scores), 2)


def left_in_flat(one: ScoredDenoiser, levels: tuple[float, float]) -> float:
    """Share of the noise's variance that is left in four ramps of 96 x 96 cells."""
    light = torch.tensor([0.05, 0.1, 0.2, 0.4])[:, None, None, None] * torch.linspace(0.9, 1.1, 96)
    ramps = [(str(k), light[k : k + 1].expand(1, 4, 96, 96).contiguous()) for k in range(len(light))]
    pairs = [(one(y) - x, y.image - x) for x, y in noisy_shots(ramps, levels)]
    left, added = (torch.stack(errors).square().mean() for errors in zip(*pairs, strict=True))
    return round((left / added).item(), 3)


def beside_lights(one: ScoredDenoiser, shots: Shots, levels: tuple[float, float]) -> tuple[float, float]:
    """dB in clipped cells, and beside them, of all frames together."""
    inside, beside = [], []
    for clean, noisy in noisy_shots(shots, levels):
        error = (one(noisy).clamp(max=1.0) - clean).square()
        cells = (clean[:, 1:3] >= CLIPPED).all(1, keepdim=True)
        near = max_pool2d(cells.float(), 2 * BESIDE + 1, 1, BESIDE).bool() & ~cells
        inside.append(error[cells.expand_as(error)])
        beside.append(error[near.expand_as(error)])
    return decibels(torch.cat(inside)), decibels(torch.cat(beside))


@torch.no_grad()
def main() -> None:
    """Measure the denoisers in turn."""
    parser = arguments(__doc__, 1, "one frame, small crops")
    parser.add_argument("denoisers", nargs="+")
    parser.add_argument("--data", required=True)
    parser.add_argument("--bin", type=int, default=4, help="sites of a colour that are averaged in both directions")
    parser.add_argument("--crop", type=int, default=384, help="of the first two tables, in pixels of the mosaic")
    args = parser.parse_args()
    figures = start(args)
    pairs = list(open_pairs(args.data, bin=args.bin))[: 1 if args.quick else None]
    packed = [(p.name, bayer.pack(bayer.crop_to_cfa(p.clean.mosaic, p.cfa, CFA.RGGB)[None], CFA.RGGB)) for p in pairs]
    side = (96 if args.quick else args.crop) // 2
    middles = [(name, centre(raw, side, side, step=1)) for name, raw in packed]
    wholes = middles if args.quick else [(name, balanced(raw)) for name, raw in packed]
    lights = [(name, raw) for name, raw in packed if (raw[:, 1:3] >= CLIPPED).all(1).any()]
    everyone: list[ScoredDenoiser] = [NoisyInput("noisy"), *map(RawDenoiser.of, args.denoisers)]
    for one in progress(everyone, label="sensors", unit="denoiser"):
        row: dict[str, float] = {}
        for name, sensor in SENSORS.items():
            row[name] = mean_psnr(one, middles, ORDINARY, **sensor)
        for name, sensor in GREENS.items():
            row[name] = mean_psnr(one, wholes, ORDINARY, **sensor)
        for levels in WEAK:
            row[f"{levels[0]:g}: left in flat"] = left_in_flat(one, levels)
            row[f"{levels[0]:g}: PSNR"] = mean_psnr(one, middles, levels)
        for levels in BRIGHT if lights else ():
            places = f"{levels[0]:g}: clipped", f"{levels[0]:g}: beside"
            row |= dict(zip(places, beside_lights(one, lights, levels), strict=True))
        figures[one.name] = row
    figures["clipped cells"] = sum(int((raw[:, 1:3] >= CLIPPED).all(1).sum()) for _, raw in lights)
    names = [one.name for one in everyone]
    rows = [[key, *(f"{figures[name][key]:g}" for name in names)] for key in figures[names[0]]]
    print_rows(f"RAW, {args.data} binned by {args.bin}", ["", *names], rows)
    finish(figures, args)


if __name__ == "__main__":
    main()
