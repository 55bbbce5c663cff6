"""Denoisers by the pattern of the mosaic, and what can be had without a network, after LibRaw's demosaicing.

    python -m benchmarks.patterns rawaug-small rawaug-base ANY.safetensors --data FRAMES --bin 2 --patterns RGGB XTRANS

The truth is a pixel of full colour from each cell of a frame, mosaicked anew in every pattern with the same noise.
Linear camera RGB and developed sRGB in dB, means over the frames. Denoisers of Bayer RAW are left out elsewhere.
Without a network: LibRaw's FBDD while it demosaics, of Bayer (it leaves X-Trans as it is; LibRaw's wavelet ends rawpy
0.28 with a segmentation fault), and non-local means of the demosaiced picture, told the level, by its strength.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from benchmarks.measure import arguments, finish, start
from denoisers import NonLocalMeans, anscombe
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import compare_images, to_domain
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial
from rawaug.experiment.full_colour import libraw_demosaic, mosaic_trial
from rawaug.noise import noise_model
from rawaug.progress import progress

STRENGTHS = (0.5, 1.0, 1.5)


class _Colours(NonLocalMeans):
    """Non-local means of full colour, whose noise has deviation 1."""

    def of(self, rgb: Tensor) -> Tensor:
        """``(1, 3, H, W)``."""
        return torch.from_numpy(self.denoise(rgb[0].permute(1, 2, 0).numpy())).permute(2, 0, 1)[None]


def without_network(trial: Trial, pair: Pair) -> Iterator[tuple[str, Callable[[], Tensor]]]:
    """Names and results, linear camera RGB ``(1, 3, H, W)``."""
    mosaic, cfa = bayer.unpack_if_packed(trial.noisy, trial.cfa), trial.condition
    (demosaic,) = trial.ways.values()
    noisy = demosaic(trial.noisy)
    yield "noisy", lambda: noisy
    if cfa in CFA.__members__:
        from rawpy import FBDDNoiseReductionMode

        full = FBDDNoiseReductionMode.Full
        yield "LibRaw, FBDD", lambda: libraw_demosaic(mosaic, pair, "AHD", cfa, fbdd_noise_reduction=full)
    assert trial.levels is not None
    shot_var, read_var = trial.levels
    white = anscombe.forward(noisy, shot_var, read_var)
    for strength in STRENGTHS:

        def smoothed(strength: float = strength) -> Tensor:
            return anscombe.inverse(_Colours(strength).of(white), shot_var, read_var)

        yield f"NonLocalMeans of the picture, {strength:g}", smoothed


def scores_of(pair: Pair, cfa: str, noise: Any, networks: list[RawDenoiser]) -> dict[str, tuple[float, float]]:
    """PSNR of linear RGB and of sRGB, by name."""
    trial = mosaic_trial(pair, cfa, noise)
    found = {name: make() for name, make in without_network(trial, pair)}
    for one in networks:
        if one.takes_pattern(cfa):
            found[one.name] = next(image for _, image in to_domain(one.name, one(trial.input), trial))
    scored = {name: compare_images(image, trial) for name, image in found.items()}
    return {name: (rgb, srgb or 0.0) for name, (rgb, _, srgb, _) in scored.items()}


@torch.no_grad()
def main(argv: list[str] | None = None) -> None:
    """Score everything on every frame in every pattern."""
    parser = arguments(__doc__, 1, "one frame, its middle")
    parser.add_argument("denoisers", nargs="*")
    parser.add_argument("--data", required=True)
    parser.add_argument("--bin", type=int, default=2, help="sites of a colour that are averaged in both directions")
    parser.add_argument("--patterns", nargs="+", default=["RGGB", "XTRANS"])
    parser.add_argument("--noise", default="cycleisp_sidd")
    args = parser.parse_args(argv)
    figures = start(args)
    frames = open_pairs(args.data).binned(args.bin, together=True)
    pairs = frames.middles(256) if args.quick else frames
    networks, noise = [RawDenoiser.of(name) for name in args.denoisers], noise_model(args.noise)
    for cfa in args.patterns:
        rows: dict[str, list[tuple[float, float]]] = {}
        for index in progress(range(1 if args.quick else len(pairs)), label=cfa, unit="frame"):
            for name, scores in scores_of(pairs[index], cfa, noise, networks).items():
                rows.setdefault(name, []).append(scores)
        figures[cfa] = {
            name: [round(fmean(column), 2) for column in zip(*found, strict=True)] for name, found in rows.items()
        }
        table = [[name, *(f"{value:.2f}" for value in means)] for name, means in figures[cfa].items()]
        print_rows(f"{cfa}, {args.data} binned by {args.bin}", ["", "linear RGB", "sRGB"], table)
    finish(figures, args)


if __name__ == "__main__":
    main()
