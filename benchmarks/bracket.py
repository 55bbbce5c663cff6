r"""Denoisers on real noise: each shot of a handheld bracket against the next longer exposure of the same scene.

    python -m benchmarks.bracket RAW_DIR PMRID.safetensors BF_DNCNN.safetensors

Nothing is added to the shots. The reference r, exposed longer, has less noise for its signal. Block by block it is
moved onto the noisy shot y, at the fraction of a pixel that phase correlation of their greens finds, and fitted to y
colour by colour,

.. math:: t_c = g_c S(r)_c + o_c, \qquad e(d) = \overline{(d - t)^2} - \overline{(g S(m))^2} ,

where S demosaics (Malvar), moves by cubic splines and takes the sites again, and m is a draw of noise with the
reference's own levels: since S is linear, the last term is the reference's noise as it is left in t. The error e of a
denoised d is the mean over blocks, in RAW and once more in developed sRGB, as PSNR. Denoisers are told the levels that
``rawaug denoise`` reads from the shot. Which blocks count is decided by y, r and their levels alone, before any
denoiser has run: see :func:`used`. What alignment alone costs is the reference moved onto each block and back.

A mean of squared errors is ruled by the few blocks with the largest ones. Beside it stand the number of blocks in which
a denoiser is the best, and the median over blocks of its gain over the denoiser that wins most of them, in dB, with a
95 % interval by bootstrap over blocks. A block whose error is not positive, because the reference's noise explains all
of it, has no gain.
"""

from __future__ import annotations

import math
import shlex
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import ndimage, stats
from skimage.registration import phase_cross_correlation
from torch import Tensor

from benchmarks.measure import arguments, finish, start
from rawaug import bayer
from rawaug.data.development import develop_packed, exposure_gain
from rawaug.data.folders import RAW_EXTENSIONS, files_in  # type: ignore[attr-defined]
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import Noisy, RawDenoiser, shipped_of_mosaics
from rawaug.denoising.levels import UnknownNoise, find_levels
from rawaug.evaluation.scores import NoisyInput, ScoredDenoiser
from rawaug.evaluation.tables import print_rows
from rawaug.io import RawFrame, read_raw
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

BLOCK, MARGIN = 192, 96
"""Side of a block, and what a denoiser sees around it, in pixels of the mosaic."""
AROUND, FARTHEST = 32, 10
"""Pixels of the reference around a block's place, and how far a block may have moved within them."""
CLIPPED, GAIN, UNLIKE = 0.95, 0.05, 2.0
"""What leaves a block out: a site of the reference above the first, a gain that differs by the second from the median
of all blocks, a difference from the reference of the third times the variance that noise explains."""
FINE = 100
"""Parts of a cell that shifts are found in."""


class Shot(NamedTuple):
    """A frame and its noise levels as ``rawaug denoise`` reads them, with where they come from."""

    frame: RawFrame
    levels: tuple[float, float]
    source: str

    @property
    def seconds(self) -> float:
        return float(self.frame.exposure.seconds or math.nan)

    @property
    def named(self) -> str:
        return f"1/{1 / self.seconds:.0f} s" if self.seconds < 0.5 else f"{self.seconds:.1f} s"


class Block(NamedTuple):
    """A block of the noisy shot at ``(top, left)`` of its mosaic, with the truth that belongs to it.

    ``target`` and ``own`` are packed ``(1, 4, h, w)``: the reference moved and fitted, and its noise in that. ``gains``
    are those of the colours; ``unlike`` is the difference of shot and target over what noise explains of it;
    ``alignment`` the error of moving the reference there and back, on the scale of the target.
    """

    top: int
    left: int
    target: Tensor
    own: Tensor
    gains: tuple[float, ...]
    unlike: float
    alignment: float


def bracket(folder: Path) -> list[Shot]:
    """The shots of a folder, the shortest exposure first; levels that cannot be read are those of the other shots."""
    frames = [read_raw(file) for file in files_in(folder, "RAW", RAW_EXTENSIONS)]
    if len(frames) < 2 or any(frame.exposure.seconds is None for frame in frames):
        raise ValueError(f"{folder}: a bracket is two or more RAW files that state their exposure times")
    if len({(frame.camera, frame.iso, frame.cfa, frame.mosaic.shape) for frame in frames}) > 1:
        raise ValueError(f"{folder}: its files differ in camera, ISO or size; give one bracket")
    known: dict[str, tuple[float, float, str]] = {}
    for frame in frames:
        try:
            known[frame.name] = find_levels(frame)
        except UnknownNoise:
            continue
    shot_var, read_var = (fmean(levels[k] for levels in known.values()) for k in range(2))  # type: ignore[misc]
    others = (shot_var, read_var, "the other shots")
    shots = [Shot(frame, (told := known.get(frame.name, others))[:2], told[2]) for frame in frames]
    return sorted(shots, key=lambda shot: shot.seconds)


def green(mosaic: Tensor, cfa: bayer.CFA) -> np.ndarray:
    """The mean of the two greens of each cell, ``(h, w)``."""
    return bayer.pack(mosaic[None], cfa)[0, 1:3].mean(0).double().numpy()


def correlated(reference: np.ndarray, moving: np.ndarray, parts: int) -> np.ndarray:
    """By how many cells ``moving`` lies further down and right in the reference, ``(2,)``."""
    window = np.hanning(moving.shape[0])[:, None] * np.hanning(moving.shape[1])
    flat = [window * (image - image.mean()) for image in (reference, moving)]
    return np.asarray(phase_cross_correlation(*flat, upsample_factor=parts, normalization=None)[0])


def shift_of_frames(noisy: Shot, reference: Shot) -> np.ndarray:
    """The shift of the whole frame in whole cells, both clipped where the reference is."""
    ratio = reference.seconds / noisy.seconds
    greens = [green(shot.frame.mosaic * gain, shot.frame.cfa) for shot, gain in ((reference, 1.0), (noisy, ratio))]  # type: ignore[arg-type]
    long, short = (np.minimum(image, CLIPPED) for image in greens)
    return correlated(long, short, 1).astype(int)


def shift_of_block(window: np.ndarray, block: np.ndarray) -> np.ndarray:
    """Where a block of greens lies in a window of the reference, in cells from its middle; found, and found again."""
    shift, pad = np.zeros(2), AROUND // 2
    for _ in range(2):
        whole = np.clip(np.round(shift), -pad, pad).astype(int)
        top, left = pad + whole
        there = window[top : top + block.shape[0], left : left + block.shape[1]]
        shift = whole + correlated(there, block, FINE)
    return shift


def moved(mosaic: Tensor, cfa: bayer.CFA, shift: np.ndarray) -> Tensor:
    """S of the module: the mosaic ``(1, H, W)`` that a sensor moved by ``shift`` cells would have seen."""
    rgb = bayer.demosaic(mosaic[None], cfa, "malvar")[0].double().numpy()
    planes = np.stack([ndimage.shift(plane, -2.0 * shift, order=3, mode="mirror") for plane in rgb])
    return bayer.mosaic(torch.from_numpy(planes)[None], cfa)[0]


def inner(mosaic: Tensor, cfa: bayer.CFA) -> Tensor:
    """A window without what lies around its block, packed ``(1, 4, h, w)``."""
    return bayer.pack(mosaic[:, AROUND:-AROUND, AROUND:-AROUND][None], cfa)


def block_at(top: int, left: int, noisy: Shot, reference: Shot, noise: Tensor, start: np.ndarray) -> Block | str:
    """The block with its truth, or why it has none."""
    cfa, side = noisy.frame.cfa, BLOCK + 2 * AROUND
    y, x = (np.array((top, left)) + 2 * start - AROUND).tolist()
    if min(y, x) < 0 or y + side > noise.shape[-2] or x + side > noise.shape[-1]:
        return "outside the reference"
    window, drawn = (mosaic[:, y : y + side, x : x + side] for mosaic in (reference.frame.mosaic, noise))
    if window.max() > CLIPPED:
        return "clipped in the reference"
    shot = noisy.frame.mosaic[:, top : top + BLOCK, left : left + BLOCK]
    shift = shift_of_block(green(window, cfa), green(shot, cfa))  # type: ignore[arg-type]
    if np.abs(2 * shift).max() > FARTHEST:
        return "not found in the reference"
    (there, back), (own, own_back) = ([one := moved(m, cfa, shift), moved(one, cfa, -shift)] for m in (window, drawn))  # type: ignore[arg-type]
    errors = [inner(after - before, cfa).square().mean() for after, before in ((back, window), (own_back, drawn))]  # type: ignore[arg-type]
    t, m, y_packed = inner(there, cfa), inner(own, cfa), bayer.pack(shot[None].double(), cfa)  # type: ignore[arg-type]
    means = [image.mean((-2, -1), keepdim=True) for image in (t, y_packed)]
    apart = t - means[0]
    gain = (apart * (y_packed - means[1])).mean((-2, -1), keepdim=True) / apart.square().mean((-2, -1), keepdim=True)
    target, own = gain * apart + means[1], gain * m
    explained = bayer.noise_variance(target, *noisy.levels).mean() + own.square().mean()
    unlike = ((y_packed - target).square().mean() / explained).item()
    alignment = (gain.square().mean() * (errors[0] - errors[1])).item()
    return Block(top, left, target, own, tuple(gain.flatten().tolist()), unlike, alignment)


def used(noisy: Shot, reference: Shot) -> tuple[list[Block], Counter[str]]:
    """The blocks that count, and how many others were left out for which reason."""
    frame = reference.frame
    variance = bayer.noise_variance(frame.mosaic, *reference.levels)
    noise = variance.sqrt() * torch.randn(variance.shape, generator=keyed_generator(0, "bracket", frame.name))
    start = shift_of_frames(noisy, reference)
    height, width = (range(MARGIN, side - BLOCK - MARGIN + 1, BLOCK) for side in frame.mosaic.shape[-2:])
    places = [(top, left) for top in height for left in width]
    found = [
        block_at(top, left, noisy, reference, noise, start)
        for top, left in progress(places, label="align", unit="block")
    ]
    blocks, left_out = [one for one in found if isinstance(one, Block)], Counter(e for e in found if isinstance(e, str))
    usual = median(gain for block in blocks for gain in block.gains) if blocks else math.nan
    kept = []
    for block in blocks:
        if max(abs(gain / usual - 1) for gain in block.gains) > GAIN:
            left_out["of another brightness than the reference"] += 1
        elif block.unlike > UNLIKE:
            left_out["unlike the reference"] += 1
        else:
            kept.append(block)
    return kept, left_out


def denoised(one: ScoredDenoiser, noisy: Shot, blocks: Sequence[Block]) -> Iterator[Tensor]:
    """What a denoiser makes of each block, packed ``(1, 4, h, w)``."""
    frame, around = noisy.frame, MARGIN // 2
    for block in progress(blocks, label=one.name, unit="block"):
        rows, columns = (slice(at - MARGIN, at + BLOCK + MARGIN) for at in (block.top, block.left))
        packed = bayer.pack(frame.mosaic[None, :, rows, columns], frame.cfa)
        result = one(Noisy.of(packed, noisy.levels, frame.cfa)).clamp(max=1.0)
        yield result[..., around:-around, around:-around]


def errors_of(results: Iterator[Tensor], noisy: Shot, blocks: Sequence[Block]) -> list[tuple[float, float]]:
    """Squared errors of each block in RAW and in developed sRGB, less those of the reference's own noise."""
    frame = noisy.frame
    pair = Pair.of_frame(frame.name, frame, torch.zeros(3, *frame.mosaic.shape[-2:], dtype=torch.uint8))
    exposure = exposure_gain(bayer.pack(frame.mosaic[None], frame.cfa), pair)
    errors = []
    for result, block in zip(results, blocks, strict=True):
        raw = (result - block.target).square().mean() - block.own.square().mean()
        packed = (result.double(), block.target, block.target + block.own)
        picture, truth, noisier = (develop_packed(x.float(), frame.cfa, pair, exposure).double() for x in packed)  # type: ignore[arg-type]
        srgb = (picture - truth).square().mean() - (noisier - truth).square().mean()
        errors.append((raw.item(), srgb.item()))
    return errors


def decibels(errors: Sequence[float]) -> float:
    """PSNR of the mean squared error."""
    return round(-10.0 * math.log10(fmean(errors)), 2)


def scored(noisy: Shot, reference: Shot, everyone: Sequence[ScoredDenoiser], args: Any) -> dict[str, Any]:
    """Every denoiser on the blocks of a shot, and what is known of these blocks."""
    blocks, left_out = used(noisy, reference)
    if not blocks:
        raise ValueError(f"{noisy.frame.name}: no block agrees with {reference.frame.name}; are they of one scene?")
    blocks = blocks[:2] if args.quick else blocks
    errors = {one.name: errors_of(denoised(one, noisy, blocks), noisy, blocks) for one in everyone}
    firsts = Counter(min(errors, key=lambda name: errors[name][k][0]) for k in range(len(blocks)))
    return {
        "levels": [*noisy.levels, noisy.source],
        "used": len(blocks),
        "left out": dict(left_out),
        "signal": round(fmean(block.target.mean().item() for block in blocks), 4),
        "alignment": decibels([block.alignment for block in blocks]),
        "unlike": round(fmean(block.unlike for block in blocks), 3),
        "scores": {name: [decibels([e[k] for e in each]) for k in range(2)] for name, each in errors.items()},
        "first in": {name: firsts[name] for name in errors},
        "gains": gains(errors, firsts.most_common(1)[0][0]),
        "errors": {name: [list(pair) for pair in each] for name, each in errors.items()},
        "places": [(block.top, block.left) for block in blocks],
    }


def gains(errors: Mapping[str, Sequence[tuple[float, float]]], winner: str) -> dict[str, list[float]]:
    """The median gain over the winner of most blocks, in dB of RAW, and the ends of its interval, by denoiser."""
    medians = {}
    for name, each in errors.items():
        differences = []
        for (raw, _), (raw_winner, _) in zip(each, errors[winner], strict=True):
            if min(raw, raw_winner) > 0:
                differences.append(10.0 * math.log10(raw_winner / raw))
        if name == winner or len(differences) < 2 or not np.ptp(differences):
            continue

        interval = stats.bootstrap((differences,), np.median, method="percentile", rng=0).confidence_interval
        medians[name] = [round(float(value), 3) for value in (np.median(differences), interval.low, interval.high)]
    return medians


def show(title: str, found: Mapping[str, Any]) -> None:
    """Print the table of a shot, and what its blocks are."""
    firsts = found["first in"]
    winner = max(firsts, key=lambda name: firsts[name])
    rows = []
    for name, (raw, srgb) in found["scores"].items():
        gain = ""
        if name in found["gains"]:
            gain = "{:+.2f} ({:+.2f} to {:+.2f})".format(*found["gains"][name])
        rows.append([name, f"{raw:.2f} / {srgb:.2f}", str(firsts[name]), gain])
    print_rows(title, ["real noise", "RAW / sRGB, dB", "best in", f"median over {winner}, dB"], rows)
    print("levels as read: shot_var {:.3g}, read_var {:.3g} ({})".format(*found["levels"]))
    left_out = ", ".join(f"{count} {reason}" for reason, count in found["left out"].items())
    print(f"{found['used']} blocks, left out {left_out}; mean signal {found['signal']:.3f}")
    print(f"alignment alone, the reference moved onto each block and back: {found['alignment']:.2f} dB")
    print(f"the noisy blocks differ from it by {found['unlike']:.2f} times the variance that the levels explain")


def main(command: Sequence[str] | None = None) -> None:
    parser = arguments(__doc__, 1, "two blocks of each shot")
    parser.add_argument("folder", type=Path, help="the RAW files of a bracket")
    parser.add_argument("denoisers", nargs="*", help="named as for rawaug benchmark, beside those that are shipped")
    args = parser.parse_args(command)
    figures = start(args)
    specs = ("NonLocalMeans", *args.denoisers, *shipped_of_mosaics())
    everyone: list[ScoredDenoiser] = [NoisyInput("noisy"), *(RawDenoiser.of(spec).require_mosaic() for spec in specs)]
    figures["command"] = shlex.join(["python", "-m", "benchmarks.bracket", *sys.argv[1:]])
    for noisy, reference in pairwise(bracket(args.folder)):
        title = f"{noisy.named} against {reference.named}"
        figures[title] = scored(noisy, reference, everyone, args)
        show(title, figures[title])
    finish(figures, args)


if __name__ == "__main__":
    main()
