"""Denoisers at four strengths of drawn noise on several sets of frames, set by set: RAW and developed PSNR.

    python -m benchmarks.strengths TABLE.json rawaug-base NonLocalMeans PMRID.safetensors \\
        --sets real:test real:validation demo:test RAW_DIR@4

Denoisers are named as for ``rawaug benchmark``; noise and middles are those of its first table. ``@8`` behind a name is
a self-ensemble of eight views, ``+guard`` its guarded result, as by ``rawaug denoise``; ``@4`` behind a set bins it
4 x 4 around the sites. Scores go to the file as they come,
and what stands there is not scored again, so slow denoisers can be added to a table later; the operations of each
denoiser stand there, too. ``python -m benchmarks.figures`` puts the table into docs/figures.json.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from benchmarks.measure import parser
from rawaug.commands import parse_value
from rawaug.data import open_pairs
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.guard import Guarded
from rawaug.evaluation.benchmark import REAL, TOLD, benchmark_trials, choose_strengths, count_gmac
from rawaug.evaluation.scores import NOISY, score
from rawaug.evaluation.tables import print_rows
from rawaug.evaluation.trials import Trial, measure_own_noise
from rawaug.noise import NoiseSpec
from rawaug.progress import progress

Scores = dict[str, Any]

GMAC = "GMAC"
"""The key of the operations a mosaic megapixel, by denoiser, beside those of the trials; a guard samples a frame."""

GUARD = "+guard"
"""End of the name of a denoiser whose results are guarded."""


def main(command: Sequence[str] | None = None) -> None:
    """Score what is missing in the table, and print it."""
    options = parser(__doc__)
    options.add_argument("table", type=Path, help="JSON file of all scores")
    options.add_argument("denoisers", nargs="*")
    options.add_argument("--sets", nargs="+", default=["real:test", "real:validation"])
    options.add_argument(
        "--noise", type=parse_value, help="noise in place of the four strengths, as for rawaug benchmark"
    )
    options.add_argument("--strengths", nargs="+", help="those of the strengths that are scored; by default all")
    options.add_argument("--crop", type=int, default=256, help="side of the middles, in pixels of the mosaic")
    options.add_argument("--middle", type=int, help="draw the noise on a middle of this side, of frames that are large")
    options.add_argument("--sensors", action="store_true", help="score sensors as they are, too")
    options.add_argument("--threads", type=int, default=torch.get_num_threads())
    args = options.parse_args(command)
    stems = [Path(spec).stem for spec in args.denoisers]
    for stem in stems:
        if stems.count(stem) > 1:
            options.error(f"two denoisers are called {stem}: a column is named after its file; rename one")
    torch.set_num_threads(args.threads)

    table: Scores = json.loads(args.table.read_text()) if args.table.is_file() else {}
    conditions = [TOLD, REAL] if args.sensors else [TOLD]

    for name in args.sets:
        everything = frozen_trials(name, args.crop, args.noise, args.middle, conditions)
        if args.strengths:
            everything = [trial for trial in everything if trial.strength in args.strengths]
        for spec in ["noisy", *args.denoisers]:
            add_scores(table, name, spec, everything, args.table)
    add_costs(table, args.denoisers, args.table)
    print_table(table)


def frozen_trials(
    spec: str,
    crop: int,
    noise: NoiseSpec | None = None,
    middle: int | None = None,
    conditions: Sequence[str] = (TOLD,),
) -> list[Trial]:
    """The middles of all frames of a set, such as ``FOLDER@4``, under these conditions at every strength.

    Noise is drawn on whole frames, or on a ``middle`` of this side.
    """
    data, _, factor = spec.partition("@")
    pairs = open_pairs(data, split="test")
    frames = measure_own_noise(pairs, len(pairs)).binned(int(factor or 1))
    if middle is not None:
        frames = frames.middles(middle)
    return benchmark_trials(frames, crop, strengths=choose_strengths(noise), conditions=conditions)


def add_scores(table: Scores, name: str, spec: str, everything: Sequence[Trial], path: Path) -> None:
    """Score a denoiser on those trials of a set that the table lacks, and write the table after each."""
    denoiser: Any = None
    for trial in progress(everything, label=f"{name}, {Path(spec).stem}", unit="image"):
        key = " | ".join((name, trial.condition, trial.strength, trial.frame))
        cells = table.setdefault(key, {})
        if Path(spec).stem in cells:
            continue
        if denoiser is None:
            denoiser = open_denoiser(spec)

        row = next(score([denoiser], [trial]))
        cells[Path(spec).stem] = [row.psnr, row.psnr_srgb, row.own_noise]
        path.write_text(json.dumps(table, indent=0))


def add_costs(table: Scores, specs: Sequence[str], path: Path) -> None:
    """Count the operations of the denoisers that the table lacks."""
    costs = table.setdefault(GMAC, {})
    for spec in specs:
        if Path(spec).stem not in costs and not spec.endswith(GUARD):
            costs[Path(spec).stem] = count_gmac(open_denoiser(spec))
            path.write_text(json.dumps(table, indent=0))


def open_denoiser(spec: str) -> Any:
    """The noisy input, or a denoiser by its name, with the views behind its ``@``, guarded if it says so."""
    if spec == "noisy":
        return NOISY
    name, _, views = spec.removesuffix(GUARD).partition("@")
    denoiser = RawDenoiser.of(name, views=int(views or 1))
    if spec.endswith(GUARD):
        return Guarded(denoiser)
    return denoiser


def print_table(table: Scores) -> None:
    """A row for each set, condition and strength; a cell is the mean over frames, RAW / developed."""
    groups: dict[tuple[str, ...], list[Scores]] = {}
    scores_by_key = {key: cells for key, cells in table.items() if key != GMAC}
    for key, cells in scores_by_key.items():
        name, condition, strength, _ = key.split(" | ")
        groups.setdefault((name, condition, strength), []).append(cells)

    columns = list(dict.fromkeys(column for cells in scores_by_key.values() for column in cells))
    rows = []
    for group, frames in groups.items():
        row = [*group, str(len(frames))]
        for column in columns:
            scores = [cells[column] for cells in frames if column in cells]
            if len(scores) < len(frames):
                row.append("")
                continue
            row.append("{:.2f} / {:.2f}".format(*(fmean(values) for values in list(zip(*scores, strict=True))[:2])))
        own = [cells[columns[-1]][2] for cells in frames if columns[-1] in cells]
        row.append(", ".join(f"{100 * fmean(own):.0f} %" for _ in own[:1] if None not in own))
        rows.append(row)
    print_rows("PSNR of RAW / sRGB in dB", ["set", "condition", "strength", "frames", *columns, "own noise"], rows)


if __name__ == "__main__":
    main()
