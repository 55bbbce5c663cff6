"""`rawaug judge` against the truth: denoisers by estimated and by true PSNR, set by set, at four strengths.

    python -m benchmarks.judging TABLE.json rawaug-base NonLocalMeans PMRID.safetensors \\
        --sets real:test real:validation demo:test RAW_DIR@4

Sets, middles and noise are those of :mod:`benchmarks.strengths`; the levels are told. The truth counts the same values
as the estimate, without what noise brings to white. A row of the table is a set and a strength: means over the frames
that were not refused, the largest difference of the two, and whether both put the denoisers in the same order, with
the largest gap in dB between two that are exchanged. Scores go to the file as they come.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from benchmarks.measure import parser
from benchmarks.strengths import frozen_trials
from rawaug.bayer import noise_variance
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.evaluation.benchmark import TOLD
from rawaug.evaluation.judge import judge_noisy
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial

Row = dict[str, dict[str, list[float]]]
"""Of each frame, by denoiser: the estimated PSNR, the ends of its interval, and the true PSNR."""


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


def judge_trial(trial: Trial, denoisers: Sequence[RawDenoiser]) -> dict[str, list[float]] | str:
    """Judge the denoisers on a trial, and measure them where they were judged; the reason if it is refused."""
    assert trial.levels is not None
    remembered = [Remembered(denoiser) for denoiser in denoisers]
    noisy = Noisy.of(trial.noisy, trial.levels, trial.cfa)
    judgement = judge_noisy(noisy, remembered, name=trial.frame)  # type: ignore[arg-type]
    if judgement.refusals:
        return "; ".join(judgement.refusals)

    results = {one.name: one.result for one in remembered if one.result is not None}
    best = results[next(iter(judgement.denoisers))]
    is_whole = best < 1.0 - 4.0 * noise_variance(best, *trial.levels).clamp_min(1e-12).sqrt()

    row = {}
    for name, judged in judgement.denoisers.items():
        error = (results[name] - trial.clean).square()[is_whole].mean()
        row[name] = [judged.psnr, *judged.interval, -10.0 * float(error.log10())]
    return row


def summarise(frames: Sequence[dict[str, list[float]]]) -> dict[str, Any]:
    """Compare the means over frames: the largest difference, and the largest true gap of two in the wrong order."""
    names = list(frames[0])
    estimated = {name: fmean(frame[name][0] for frame in frames) for name in names}
    true = {name: fmean(frame[name][3] for frame in frames) for name in names}

    exchanged = 0.0
    for one, other in combinations(names, 2):
        if (estimated[one] - estimated[other]) * (true[one] - true[other]) < 0.0:
            exchanged = max(exchanged, abs(true[one] - true[other]))

    worst = max(names, key=lambda name: abs(estimated[name] - true[name]))
    held = [low <= truth <= high for frame in frames for _, low, high, truth in frame.values()]
    return {
        "estimated": estimated,
        "true": true,
        "worst": worst,
        "exchanged": exchanged,
        "held": sum(held),
        "intervals": len(held),
    }


def print_table(table: dict[str, Row]) -> None:
    """Print a row for each set and strength, and how many of them meet 0.1 dB and the order."""
    rows, met, in_order, held, intervals = [], 0, 0, 0, 0
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
        held, intervals = held + summary["held"], intervals + summary["intervals"]
        order = "same" if summary["exchanged"] == 0.0 else f"{summary['exchanged']:.2f} dB exchanged"
        cells = [f"{name} {summary['estimated'][name]:.2f} / {summary['true'][name]:.2f}" for name in summary["true"]]
        rows.append([key, f"{len(judged)} of {len(frames)}", f"{difference:+.2f} ({worst})", order, ", ".join(cells)])

    columns = ["set, strength", "judged", "largest difference", "order", "estimated / true"]
    print_rows("PSNR of RAW in dB, estimated and true", columns, rows)
    print(f"within 0.1 dB: {met} of {len(rows)} rows; same order: {in_order}; intervals hold: {held} of {intervals}")


def main(command: Sequence[str] | None = None) -> None:
    """Judge what is missing in the table, and print it."""
    options = parser(__doc__)
    options.add_argument("table", type=Path, help="JSON file of all scores")
    options.add_argument("denoisers", nargs="*")
    options.add_argument("--sets", nargs="+", default=["real:test", "real:validation"])
    options.add_argument("--crop", type=int, default=256, help="side of the middles, in pixels of the mosaic")
    options.add_argument("--count", type=int, help="so many frames of each set; all by default")
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = options.parse_args(command)
    torch.set_num_threads(args.threads)

    table: dict[str, Any] = json.loads(args.table.read_text()) if args.table.is_file() else {}
    denoisers = [RawDenoiser.of(name) for name in args.denoisers]
    for name in args.sets if denoisers else ():
        everything = [trial for trial in frozen_trials(name, args.crop) if trial.condition == TOLD]
        chosen = list(dict.fromkeys(trial.frame for trial in everything))[: args.count]
        for trial in everything:
            frames = table.setdefault(f"{name}, {trial.strength}", {})
            if trial.frame not in chosen or trial.frame in frames:
                continue
            frames[trial.frame] = judge_trial(trial, denoisers)
            args.table.write_text(json.dumps(table, indent=0))
    print_table(table)


if __name__ == "__main__":
    main()
