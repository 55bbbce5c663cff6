"""What the places of the sites of a binned frame are worth to denoisers: RAW in dB.

    python -m benchmarks.binning rawaug-base NonLocalMeans PMRID.safetensors --data CANON

Denoisers are named as for ``rawaug benchmark``. References are binned by squares, which brings the four sites of a cell
to nearly one place, and around the new sites (:func:`rawaug.bayer.bin_mosaic`); the noise is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import fmean

import torch

from benchmarks.measure import arguments, finish, start
from rawaug.bayer import CFA, crop_to_cfa, pack
from rawaug.data import open_pairs
from rawaug.data.pairs import centre
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.evaluation.scores import NoisyInput, ScoredDenoiser
from rawaug.evaluation.tables import print_rows
from rawaug.metrics import psnr
from rawaug.noise import noise_model
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

WAYS = {"squares": True, "around the sites": False}


@torch.no_grad()
def main(command: Sequence[str] | None = None) -> None:
    """Score the denoisers on both."""
    parser = arguments(__doc__, 1, "one frame, small crops")
    parser.add_argument("denoisers", nargs="+")
    parser.add_argument("--data", required=True)
    parser.add_argument("--bin", type=int, default=4)
    parser.add_argument("--noise", default="cycleisp_sidd")
    parser.add_argument(
        "--crop", type=int, default=384, help="side of the middle that is scored, in pixels of the mosaic"
    )
    args = parser.parse_args(command)
    figures = start(args)
    noise, pairs = noise_model(args.noise), open_pairs(args.data)
    if args.quick:
        pairs = pairs.some(range(1))
    everyone: list[ScoredDenoiser] = [NoisyInput("noisy"), *map(RawDenoiser.of, args.denoisers)]
    side = (96 if args.quick else args.crop) // 2
    for way, together in WAYS.items():
        found: dict[str, list[float]] = {one.name: [] for one in everyone}
        for pair in progress(pairs.binned(args.bin, together), label=f"binned by {way}", unit="frame"):
            raw = pack(crop_to_cfa(pair.clean.mosaic, pair.cfa, CFA.RGGB)[None], CFA.RGGB)
            clean = centre(raw, side, side, step=1)
            params = noise.sample(1, keyed_generator(0, "binning", pair.name))
            levels = params["shot_var"].item(), params["read_var"].item()
            noisy = Noisy.of(noise.apply(clean, params), levels, CFA.RGGB)
            for one in everyone:
                found[one.name].append(psnr(one(noisy).clamp(0.0, 1.0), clean).item())
        figures[way] = {name: round(fmean(values), 2) for name, values in found.items()}
    rows = [[way, *(f"{figures[way][one.name]:.2f}" for one in everyone)] for way in WAYS]
    print_rows(f"RAW, {args.data} binned by {args.bin}", ["", *(one.name for one in everyone)], rows)
    finish(figures, args)


if __name__ == "__main__":
    main()
