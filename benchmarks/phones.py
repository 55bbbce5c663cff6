"""The ISP ``phones``: ``python -m benchmarks.phones PHOTOGRAPHS --out phones.safetensors``.

Frames of the five simulated phones (:mod:`rawaug.data.phones`), one of each training instance, are drawn anew for
several seeds; the published fit learns dictionaries, encoders and both masks on them end to end. It is watched on
frames of other photographs, drawn with a seed of their own.

``--score-file FILE`` measures an ISP instead: PSNR_r on frames of test or validation, blind and with as-shot gains.
``--errors-of FILE`` measures how far off its choice and as-shot gains are on the frames of
validation, as large as they are tested.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from statistics import fmean

import torch

from rawaug.bayer import pack
from rawaug.data.pairs import Pair
from rawaug.data.phones import PhoneFrames
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.atoms import measure_gain_errors, plausible_matrices
from rawaug.isp.fit.samples import CLIPPED_RAW, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import worst_and_best_quarter

SIZE = (256, 256)
WATCH_SEED = 11
"""Seed of the validation frames that the training is watched on."""
FEWEST_UNCLIPPED = 0.15
"""Minimum share of the sites of each colour that are clipped neither in RAW nor in the picture."""
FEWEST_COLOURS = 5e-4
"""Minimum of the smallest principal variance of a frame's colours, relative to their power.

A frame of fewer colours leaves its matrix open, and the matrix would become an atom that is no camera's.
"""


def draw_frames(path: str, split: str, seeds: Sequence[int], step: int = 1) -> Iterator[Pair]:
    """Draw the frames of a split for several seeds, every ``step``-th of them, without those that say too little."""
    for seed in seeds:
        frames = PhoneFrames(path, split, seed, SIZE)
        for index in range(0, len(frames), step):
            pair = frames[index]
            if says_its_colour(pair):
                yield replace(pair, name=f"{pair.name} of seed {seed}")


def says_its_colour(pair: Pair) -> bool:
    """Whether a frame has enough sites of each colour that are not clipped, and enough colours in its picture."""
    unclipped = (pair.srgb.amax(0) < 250) & (pair.srgb.amin(0) > 0) & (pair.clean.mosaic[0] < CLIPPED_RAW)
    shares = pack(unclipped[None].float(), pair.cfa).mean(dim=(1, 2))
    if shares.min() < FEWEST_UNCLIPPED:
        return False

    colours = (pair.srgb[:, unclipped].double() / 255.0) ** 2.2
    moments = colours @ colours.T
    variances = torch.linalg.eigvalsh(moments)
    return bool(variances[0] > FEWEST_COLOURS * variances.sum())


def score(path: str, file: str, split: str, seeds: Sequence[int]) -> None:
    """Print PSNR_r in dB of an ISP on frames of 256 x 256: mean, worst and best quarter."""
    isp = DictionaryISP.from_pretrained(file)
    for seed in seeds:
        frames = PhoneFrames(path, split, seed, SIZE)
        pairs = [frames[index].in_pattern(isp.cfa) for index in range(len(frames))]
        for label, as_shot in (("blind", False), ("as-shot gains", True)):
            values = [psnr_r(isp, pair, as_shot) for pair in pairs]
            worst, best = worst_and_best_quarter(values)
            print(f"{split}, seed {seed}, {label}: {fmean(values):.2f} ({worst:.2f}, {best:.2f})")


def main(
    photographs: str,
    /,
    *,
    out: str = "phones.safetensors",
    seeds: int = 4,
    start_steps: int = 60,
    steps: int = 450,
    pixels: int = 2048,
    raw_loss: str = "log",
    score_file: str | None = None,
    split: str = "validation",
    errors_of: str | None = None,
) -> None:
    """Fit the ISP and print how its training went, or score one, or measure its errors.

    Args:
        photographs: folder with subfolders ``train`` and ``test``.
        out: the .safetensors file to write.
        seeds: how often the 160 instances are drawn.
        start_steps: of each direction, before the training end to end.
        steps: of the training end to end.
        pixels: kept of each frame.
        raw_loss: l2 or log.
        score_file: an ISP to score in place of a fit, on seeds 0 and 7.
        split: of the frames that it is scored on.
        errors_of: an ISP whose gain errors are measured anew on the frames of validation; it is written to ``out``.
    """
    torch.set_num_threads(1)
    watched = draw_frames(photographs, "validation", [WATCH_SEED])
    if errors_of is not None:
        isp = DictionaryISP.from_pretrained(errors_of)
        seen = sample_pixels(PhoneFrames(photographs, "validation"), pixels, seed=0)
        measure_gain_errors(isp, seen)
        isp.save(out)
        print(isp.info["gain_errors"])
        return

    if score_file is not None:
        score(photographs, score_file, split, (0, 7))
        return

    config = FitConfig(
        method="published",
        steps=start_steps,
        joint_steps=steps,
        pixels=pixels,
        batch=512,
        raw_loss=raw_loss,  # type: ignore[arg-type]
    )
    frames = draw_frames(photographs, "train", range(1, seeds + 1), step=2)
    isp = fit_isp(frames, config, state=f"{out}.state", watched=watched)

    count = len(isp.info["frames"])
    isp.info["rendering"] = "phones: (simulated)"
    isp.info["frames"] = [f"phones: of seeds 1 to {seeds}, {count} training instances"]
    isp.save(out)
    print(isp.info["joint"])
    print(f"{int(plausible_matrices(isp.colour.atoms()).sum())} of {isp.config.colour_atoms} colour atoms plausible")


if __name__ == "__main__":
    from cyclopts import run

    run(main)
