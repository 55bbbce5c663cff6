"""`rawaug judge` against the truth: denoisers by estimated and by true PSNR, set by set, at four strengths.

    python -m benchmarks.judging TABLE.json rawaug-base NonLocalMeans PMRID.safetensors \\
        --sets real:test real:validation demo:test RAW_DIR@4

    python -m benchmarks.judging TABLE.json rawaug-base PBRID.safetensors --bracket D5000 BRACKET.json

Sets, middles and noise are those of :mod:`benchmarks.strengths`; the levels are told. The truth counts the same values
as the estimate, without what noise brings to white. A row of the table is a set and a strength: means over the frames
that were not refused, the largest difference of the two, and whether both put the denoisers in the same order, with
the largest gap in dB between two that are exchanged; in brackets those whose intervals behind the best are apart, so
that the estimate says so. Scores go to the file as they come.

With ``--bracket``, real noise: the blocks of a handheld bracket are judged one by one, and compared with the errors
against the longer exposure, which ``benchmarks.bracket --json BRACKET.json`` wrote for the same denoisers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from itertools import permutations
from pathlib import Path
from statistics import fmean, median
from typing import Any

import torch
from torch import Tensor

from benchmarks.bracket import BLOCK, bracket
from benchmarks.measure import parser
from benchmarks.strengths import frozen_trials
from rawaug import bayer
from rawaug.bayer import noise_variance
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.risk import estimate_risk, probe_denoiser
from rawaug.evaluation.judge import judge_noisy
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial
from rawaug.evaluation.verdict import paired_interval
from rawaug.progress import progress

Row = dict[str, dict[str, list[float]]]
"""Of each frame, by denoiser: the estimated PSNR, the ends of its interval, the true PSNR, and the ends of the interval
of what it is behind the best by."""


MARGIN = 48
"""What a denoiser sees around a block of a bracket, in pixels of the mosaic; half as much as when it is measured."""


class Remembered:
    """A denoiser that keeps its first result."""

    def __init__(self, denoiser: RawDenoiser) -> None:
        self.denoiser, self.name = denoiser, denoiser.name
        self.result: Tensor | None = None

    def __call__(self, noisy: Noisy) -> Tensor:
        denoised = self.denoiser(noisy)
        if self.result is None:
            self.result = denoised
        return denoised


def judge_trial(trial: Trial, denoisers: Sequence[RawDenoiser], probes: int = 1) -> dict[str, list[float]] | str:
    """Judge the denoisers on a trial, and measure them where they were judged; the reason if it is refused."""
    assert trial.levels is not None
    remembered = [Remembered(denoiser) for denoiser in denoisers]
    noisy = Noisy.of(trial.noisy, trial.levels, trial.cfa)
    judgement = judge_noisy(noisy, remembered, name=trial.frame, probes=probes)  # type: ignore[arg-type]
    if judgement.refusals:
        return "; ".join(judgement.refusals)

    results = {one.name: one.result for one in remembered if one.result is not None}
    best = results[next(iter(judgement.denoisers))]
    is_whole = best < 1.0 - 4.0 * noise_variance(best, *trial.levels).clamp_min(1e-12).sqrt()

    row = {}
    for name, judged in judgement.denoisers.items():
        error = (results[name] - trial.clean).square()[is_whole].mean()
        row[name] = [judged.psnr, *judged.interval, -10.0 * float(error.log10()), *judged.behind[1:]]
    return row


def summarise(frames: Sequence[dict[str, list[float]]]) -> dict[str, Any]:
    """Compare the means over frames: the largest difference, and the largest true gap of two in the wrong order."""
    names = list(frames[0])
    estimated = {name: fmean(frame[name][0] for frame in frames) for name in names}
    true = {name: fmean(frame[name][3] for frame in frames) for name in names}

    behind = {}
    for name in names:
        middle = fmean((frame[name][4] + frame[name][5]) / 2 for frame in frames)
        reach = math.hypot(*((frame[name][5] - frame[name][4]) / 2 for frame in frames)) / len(frames)
        behind[name] = middle - reach, middle + reach

    exchanged, contradicted = 0.0, 0.0
    for better, worse in permutations(names, 2):
        gap = true[better] - true[worse]
        if gap > 0.0 and estimated[better] < estimated[worse]:
            exchanged = max(exchanged, gap)
            if behind[better][0] > behind[worse][1]:
                contradicted = max(contradicted, gap)

    worst = max(names, key=lambda name: abs(estimated[name] - true[name]))
    held = [low <= truth <= high for frame in frames for _, low, high, truth, *_ in frame.values()]
    return {
        "estimated": estimated,
        "true": true,
        "worst": worst,
        "exchanged": exchanged,
        "contradicted": contradicted,
        "held": sum(held),
        "intervals": len(held),
    }


def print_table(table: dict[str, Row]) -> None:
    """Print a row for each set and strength, and how many of them meet 0.1 dB and the order."""
    rows, met, in_order, unrefuted, held, intervals = [], 0, 0, 0, 0, 0
    for key, frames in table.items():
        judged = [frame for frame in frames.values() if isinstance(frame, dict)]
        if not judged:
            rows.append([key, f"0 of {len(frames)}", "", "", ""])
            continue
        summary = summarise(judged)
        worst = summary["worst"]
        difference = summary["estimated"][worst] - summary["true"][worst]
        met += abs(difference) <= 0.1
        in_order += summary["exchanged"] == 0.0
        unrefuted += summary["contradicted"] == 0.0
        held, intervals = held + summary["held"], intervals + summary["intervals"]
        order = f"{summary['exchanged']:.2f} dB exchanged ({summary['contradicted']:.2f})"
        if summary["exchanged"] == 0.0:
            order = "same"
        cells = [f"{name} {summary['estimated'][name]:.2f} / {summary['true'][name]:.2f}" for name in summary["true"]]
        rows.append([key, f"{len(judged)} of {len(frames)}", f"{difference:+.2f} ({worst})", order, ", ".join(cells)])

    columns = ["set, strength", "judged", "largest difference", "order", "estimated / true"]
    print_rows("PSNR of RAW in dB, estimated and true", columns, rows)
    print(f"within 0.1 dB: {met} of {len(rows)} rows; intervals hold: {held} of {intervals}")
    print(f"same order: {in_order} rows; the same where the paired intervals decide: {unrefuted}")


def judge_blocks(
    folder: Path,
    measured: Mapping[str, Any],
    denoisers: Sequence[RawDenoiser],
    table: dict[str, Any],
    path: Path,
    every: int = 1,
) -> None:
    """Estimate the mean squared error of the denoisers on the blocks of a bracket, where the table lacks it."""
    shots = {shot.named: shot for shot in bracket(folder)}
    for title, blocks in measured.items():
        if "places" not in blocks:
            continue

        noisy = shots[title.partition(" against")[0]]
        frame = noisy.frame
        for top, left in progress(blocks["places"][::every], label=title, unit="block"):
            window = frame.mosaic[None, :, top - MARGIN : top + BLOCK + MARGIN, left - MARGIN : left + BLOCK + MARGIN]
            packed = bayer.pack(window, frame.cfa)
            errors = table.setdefault(title, {}).setdefault(f"{top} {left}", {})
            for denoiser in denoisers:
                if denoiser.name in errors:
                    continue
                probe = probe_denoiser(denoiser, Noisy.of(packed, noisy.levels, frame.cfa))
                inner = slice(MARGIN // 2, -MARGIN // 2)
                risk = estimate_risk(probe, packed, noisy.levels)[..., inner, inner]
                errors[denoiser.name] = float(risk.mean())
            path.write_text(json.dumps(table, indent=0))


def print_blocks(table: Mapping[str, Any], measured: Mapping[str, Any]) -> None:
    """Print in how many blocks each denoiser is best, and behind the one that wins most, estimated and measured."""
    for title, by_place in table.items():
        places = [f"{top} {left}" for top, left in measured[title]["places"]]
        blocks = [number for number, place in enumerate(places) if place in by_place]
        names = list(by_place[places[blocks[0]]])
        estimated = {name: [by_place[places[number]][name] for number in blocks] for name in names}
        true = {name: [measured[title]["errors"][name][number][0] for number in blocks] for name in names}
        winner = max(names, key=lambda name: measured[title]["first in"][name])

        rows = []
        for name in names:
            cells = [name]
            for errors in (estimated, true):
                first = sum(errors[name][k] == min(errors[one][k] for one in names) for k in range(len(blocks)))
                cells.append(f"{first} of {len(blocks)}")
            if name != winner:
                behind = [a - b for a, b in zip(estimated[name], estimated[winner], strict=True)]
                behind_true = [a - b for a, b in zip(true[name], true[winner], strict=True)]
                same = sum(a * b > 0 for a, b in zip(behind, behind_true, strict=True))
                low, high = paired_interval(behind)
                unit = 1e-8
                cells.append(f"{sum(a > 0 for a in behind)}; {sum(a > 0 for a in behind_true)}; {same}")
                cells.append(f"{fmean(behind) / unit:.2f} ({low / unit:.2f} to {high / unit:.2f})")
                cells.append(f"{median(behind) / unit:.2f}; {median(behind_true) / unit:.2f}")
            rows.append(cells)
        head = [
            "denoiser",
            "best in, estimated",
            "measured",
            f"{winner} ahead in, estimated; measured; agree",
            "mean square behind it, 1e-8",
            "median, estimated; measured",
        ]
        print_rows(title, head, rows)


def main(command: Sequence[str] | None = None) -> None:
    """Judge what is missing in the table, and print it."""
    options = parser(__doc__)
    options.add_argument("table", type=Path, help="JSON file of all scores")
    options.add_argument("denoisers", nargs="*")
    options.add_argument("--sets", nargs="+", default=["real:test", "real:validation"])
    options.add_argument("--crop", type=int, default=256, help="side of the middles, in pixels of the mosaic")
    options.add_argument("--count", type=int, help="so many frames of each set; all by default")
    options.add_argument(
        "--probes", type=int, default=1, help="small changes with which each denoiser is run once more"
    )
    options.add_argument("--bracket", nargs=2, type=Path, metavar=("FOLDER", "JSON"), help="judge blocks of real noise")
    options.add_argument("--every", type=int, default=1, help="judge one of so many blocks")
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = options.parse_args(command)
    torch.set_num_threads(args.threads)

    table: dict[str, Any] = json.loads(args.table.read_text()) if args.table.is_file() else {}
    denoisers = [RawDenoiser.of(name) for name in args.denoisers]
    if args.bracket:
        folder, result = args.bracket
        measured = json.loads(result.read_text(encoding="utf-8"))
        judge_blocks(folder, measured, denoisers, table, args.table, args.every)
        print_blocks(table, measured)
        return

    for name in args.sets if denoisers else ():
        everything = frozen_trials(name, args.crop)
        chosen = list(dict.fromkeys(trial.frame for trial in everything))[: args.count]
        for trial in everything:
            frames = table.setdefault(f"{name}, {trial.strength}", {})
            if trial.frame not in chosen or trial.frame in frames:
                continue
            frames[trial.frame] = judge_trial(trial, denoisers, args.probes)
            args.table.write_text(json.dumps(table, indent=0))
    print_table(table)


if __name__ == "__main__":
    main()
