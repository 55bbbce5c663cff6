"""The recipe ``augmentation`` on two real cameras: few-shot on a Canon S40, tested on a G2, and real noise of a D5000.

    python -m benchmarks.real_cameras canon CANON_RAW PHOTOS --out RUNS --beside PMRID.safetensors BF_DNCNN.safetensors
    python -m benchmarks.real_cameras d5000 BRACKET PHOTOS --out RUNS --beside PMRID.safetensors BF_DNCNN.safetensors

Canon: the middles of 96 of the five S40 frames, with drawn noise; validation are other windows of 256 of these frames,
test all windows of 256 of the two G2 frames. D5000: five squares of 96 of the left half of the shot of 1/640 s with its
real noise, beside the reference of 1/160 s that :mod:`benchmarks.bracket` moves onto it; validation are other blocks of
the left half, test all blocks of the right half, in the errors of that benchmark.

Softness is measured on the whole training frames (:mod:`rawaug.camera.softness`), the ISP is fitted to training frames
alone, and arms are those of the recipe, two real crops a step in each.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from scipy import stats

from benchmarks import bracket
from benchmarks.measure import parser
from rawaug import bayer
from rawaug.camera.softness import measure_blur
from rawaug.data import open_pairs
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import NOISY
from rawaug.experiment.run import run
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.plugin.draw import Draw
from rawaug.training.config import DenoiserConfig, TrainConfig

CROP, WINDOW = 96, 256
"""Sides of a training square, and of the windows of the Canons that validate and test."""
STEPS, SEEDS = {"canon": 2000, "d5000": 1000}, 3
FIT = FitConfig(method="published", steps=60, joint_steps=400, pixels=16384, batch=512)


def window(pair: Pair, top: int, left: int, side: int) -> Pair:
    """Cut a square out of a pair, at even coordinates so that the pattern stays."""
    rows, columns = slice(top, top + side), slice(left, left + side)
    raw, srgb = (image[:, rows, columns].contiguous() for image in (pair.clean.mosaic, pair.srgb))
    return replace(pair, name=f"{pair.name}_{top}_{left}", clean=replace(pair.clean, mosaic=raw), srgb=srgb)


def make_recipe(name: str, photographs: Path, out: str, blur: float, **settings: Any) -> Recipe:
    """Make the recipe of a camera whose frames are as soft as photographs after this blur."""
    arms = {
        "real": ArmConfig(batch=2),
        "noise": ArmConfig(0.75, source="noise"),
        "own": ArmConfig(0.75, source="own", draw=Draw("perturb")),
        "soft": ArmConfig(0.75, draw=Draw("perturb", blur=blur)),
        "sharp": ArmConfig(0.75, draw=Draw("perturb", blur=0.0)),
    }
    return Recipe(
        name=name,
        data=DataConfig(
            count=None, crop=CROP, pictures=f"{photographs}/train", memory_mb=700, validation_crop=None, test_crop=None
        ),
        fit=FIT,
        denoiser=DenoiserConfig("UNet", {"width": 8, "scales": 3, "domain": "anscombe"}),
        train=TrainConfig(
            steps=STEPS[name], batch=8, crop=64, learning_rate=1e-3, weigh="stabilised", validate_every=200
        ),
        arms=arms,
        self_ensemble=False,
        seeds=SEEDS,
        out=out,
        **settings,
    )


def run_canon(folder: Path, photographs: Path, out: str, beside: Sequence[str]) -> None:
    """Few-shot on the S40, tested on the G2."""
    pairs = list(open_pairs(folder))
    train = [pair for pair in pairs if "S40" in pair.clean.camera]
    blur = measure_blur((pair.clean.mosaic[0].numpy(), pair.cfa) for pair in train)
    print(f"softness of the S40: {blur:.2f} pixels")

    validation = [window(pair, top, top, WINDOW) for pair in train for top in (200, 500)]
    test = []
    for pair in pairs:
        if "G2" in pair.clean.camera:
            height, width = pair.clean.mosaic.shape[-2:]
            places = [(y, x) for y in range(0, height - WINDOW, WINDOW) for x in range(0, width - WINDOW, WINDOW)]
            test += [window(pair, top, left, WINDOW) for top, left in places]

    recipe = make_recipe("canon", photographs, out, blur or 0.0, noise="cycleisp_sidd", classical=["NonLocalMeans"])
    recipe.baselines = list(beside)
    run(recipe, overwrite=True, pairs=train, validation=validation, test=test)


def block_pair(block: bracket.Block, shot: bracket.Shot) -> Pair:
    """Make the pair of a block: the reference that was moved onto it, and the shot with its own noise."""
    frame = shot.frame
    rows, columns = (slice(at, at + bracket.BLOCK) for at in (block.top, block.left))
    mosaic = bayer.unpack(block.target.float(), frame.cfa)[0]
    noisy = frame.mosaic[:, rows, columns].contiguous()
    picture = torch.zeros(3, *mosaic.shape[-2:], dtype=torch.uint8)
    pair = Pair.of_frame(f"{frame.name}_{block.top}_{block.left}", replace(frame, mosaic=mosaic), picture)
    return replace(pair, noisy=replace(pair.clean, mosaic=noisy, noise_profile=shot.levels))


def run_d5000(folder: Path, photographs: Path, out: str, beside: Sequence[str]) -> None:
    """Train on real noise of the left half of a shot, and test on that of its right half."""
    short, middle, _ = bracket.bracket(folder)
    blocks, _ = bracket.used(short, middle)
    half = short.frame.mosaic.shape[-1] // 2
    left = [block for block in blocks if block.left + bracket.BLOCK <= half]
    right = [block for block in blocks if block.left >= half]

    chosen = [(2 * k + 1) * len(left) // 10 for k in range(5)]
    train = [block_pair(left[k], short) for k in chosen]
    watched = [block_pair(block, short) for k, block in enumerate(left) if k not in chosen]
    print(f"{len(left)} blocks on the left, {len(watched)} of them validate; {len(right)} on the right")

    # The ISP sees the same places in the longer shot, two stops brighter, with its picture; a clipped sky says nothing.
    (frame,) = [pair for pair in open_pairs(folder) if pair.name == middle.frame.name]
    blur = measure_blur([(frame.clean.mosaic[0, :, :half].numpy(), frame.cfa)])
    print(f"softness of the D5000: {blur:.2f} pixels")
    squares = [window(frame, left[k].top, left[k].left, bracket.BLOCK) for k in chosen]
    squares = [square for square in squares if (square.srgb < 250).float().mean((1, 2)).min() > 0.5]
    file = Path(out) / "d5000.safetensors"
    file.parent.mkdir(parents=True, exist_ok=True)
    fit_isp(squares, FIT).save(file)

    recipe = make_recipe("d5000", photographs, out, blur or 0.0, isp=ISPSource(str(file)), noise=short.levels)
    for arm in ("own", "sharp"):  # the shot's own picture is as noisy as the shot
        del recipe.arms[arm]
    recipe.arms["soft"].draw = Draw("perturb", blur=blur or 0.0, exposure=-2.0)
    run(recipe, overwrite=True, pairs=train, validation=watched, test=[block_pair(block, short) for block in right])

    # The errors of the bracket, which know the noise of the reference.
    trained = sorted(Path(out).glob("d5000/seed*/*/denoiser.safetensors"))
    denoisers: list[Any] = [NOISY, *(RawDenoiser.of(spec) for spec in ("NonLocalMeans", *beside))]
    denoisers += [RawDenoiser.of(path, name=f"{path.parent.name} {path.parent.parent.name[4:]}") for path in trained]
    errors = {}
    for denoiser in denoisers:
        errors[denoiser.name] = bracket.errors_of(bracket.denoised(denoiser, short, right), short, right)
        raw, developed = (bracket.decibels([error[k] for error in errors[denoiser.name]]) for k in range(2))
        print(f"{denoiser.name:24} {raw:.2f} / {developed:.2f}", flush=True)
    (Path(out) / "d5000_errors.json").write_text(json.dumps(errors))
    for arm in recipe.arms:
        compare(errors, arm)


def compare(errors: dict[str, list[tuple[float, float]]], arm: str, base: str = "real") -> None:
    """Print the median gain over blocks of an arm over another, errors averaged over the seeds, with its interval."""
    for k, kind in enumerate(("RAW", "developed")):
        gains = []
        for block in range(len(next(iter(errors.values())))):
            means = []
            for name in (base, arm):
                means.append(fmean(errors[f"{name} {seed}"][block][k] for seed in range(SEEDS)))
            if min(means) > 0:
                gains.append(10.0 * np.log10(means[0] / means[1]))
        if arm == base or len(gains) < 2:
            continue
        interval = stats.bootstrap((gains,), np.median, method="percentile", rng=0).confidence_interval
        median = float(np.median(gains))
        ends = f"({interval.low:+.2f} to {interval.high:+.2f})"
        print(f"{arm} over {base}, {kind}: {median:+.2f} {ends}, {len(gains)} blocks")


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("camera", choices=["canon", "d5000"])
    cli.add_argument("frames", type=Path)
    cli.add_argument("photographs", type=Path)
    cli.add_argument("--out", default="runs")
    cli.add_argument("--beside", nargs="*", default=[], help="denoisers to score beside")
    options = cli.parse_args()
    torch.set_num_threads(1)
    if options.camera == "canon":
        run_canon(options.frames, options.photographs, options.out, options.beside)
    else:
        run_d5000(options.frames, options.photographs, options.out, options.beside)


if __name__ == "__main__":
    main()
