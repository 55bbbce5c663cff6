"""The reconstruction table in print: a row a method and setting, a column a figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.experiment.methods import ROWS

COLUMNS = {
    "psnr_r": "PSNR_r",
    "worst25": "worst 25%",
    "best25": "best 25%",
    "balanced": "balanced",
    "cycle": "cycle",
    "cycle_without_mosaic": "no mosaic",
    "psnr_d": "PSNR_d",
}


def _cells(row: dict[str, Any], columns: Sequence[str]) -> list[str]:
    def figures(name: str) -> str:
        value = row.get(name)
        return "" if value is None else mean_and_spread(value if isinstance(value, list) else [value], 2)

    cells = [figures(name) for name in columns]
    speed = "" if row["mpix_s"] is None else f"{row['mpix_s']:.3g}"
    return [*cells, f"{row['parameters'] / 1e6:.3f}", f"{row['seconds']:.1f}", speed]


def print_methods(title: str, rows: dict[str, dict[str, Any]], balanced: bool, ceiling: float) -> None:
    """Print the rows of a comparison; ``ceiling`` is the PSNR that the mosaic alone leaves of a cycle."""
    columns = [name for name in COLUMNS if name != "balanced" or balanced]
    heads = [COLUMNS[name] for name in columns] + ["M par.", "s to fit", "Mpix/s"]
    print_rows(title, ["method", *heads], [[name, *_cells(row, columns)] for name, row in rows.items()])
    threads = torch.get_num_threads()
    print(f"mosaic and bilinear interpolation alone: {ceiling:.2f} dB (ceiling of the cycle); threads: {threads}")


def row_name(family: str, row: str) -> str:
    """Of a row of a fold: "as-shot, overexposed" and the like."""
    setting, _, kind = row.partition(", ")
    return ", ".join([family, *([] if setting == "blind" else [ROWS[setting]]), *([kind] if kind else [])])
