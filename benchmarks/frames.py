"""How many frames a fit needs: PSNR_r on the frames that random subsets of 1, 2, 3, 5, ... leave out.

    python -m benchmarks.frames RAW_DIR [--subsets 5] [--patches 8] [--json FILE]

Columns: mean over subsets of the mean over left-out frames, and the range over subsets; blind, with the frames' as-shot
white balance, with 64 RAW samples, with oracle weights.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

from rawaug.data import open_pairs
from rawaug.isp.fit import FitConfig
from rawaug.paper.baselines import Training
from rawaug.paper.methods import ROWS, fit_family, score_rows
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

COUNTS = (1, 2, 3, 5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", help="folder of RAW files, or kind:path")
    parser.add_argument("--subsets", type=int, default=5, help="random subsets of each size")
    parser.add_argument("--patches", type=int, default=8, help="patches scored per held-out frame")
    parser.add_argument("--json", type=Path, default=None, help="write every figure to this file")
    options = parser.parse_args()
    pairs = list(open_pairs(options.data, split="train"))
    table: dict[int, list[dict[str, float]]] = {}
    for count in [count for count in COUNTS if count < len(pairs)]:
        table[count] = []
        for subset in progress(range(options.subsets), label=f"{count} frames", unit="subset"):
            order = torch.randperm(len(pairs), generator=keyed_generator("subset", count, subset)).tolist()
            fitted = fit_family("dictionary", [pairs[k] for k in order[:count]], FitConfig(), Training())
            scores = [score_rows(fitted, pairs[k], options.patches)["rows"] for k in order[count:]]
            table[count].append({row: sum(s[row] for s in scores) / len(scores) for row in scores[0]})
    rows = list(next(iter(table.values()))[0])
    print("frames", *(f"{row if row == 'blind' else ROWS[row]:>28}" for row in rows))
    for count, runs in table.items():
        cells = []
        for row in rows:
            values = [run[row] for run in runs]
            cells.append(f"{sum(values) / len(values):8.2f} ({min(values):6.2f} to {max(values):6.2f})")
        print(f"{count:6d}", *(f"{cell:>28}" for cell in cells))
    if options.json:
        options.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
