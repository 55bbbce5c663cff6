"""What an experiment ends with: a table, and a picture of noisy, denoised and clean side by side.

RAW is developed for the eye by one fixed pipeline, the same for every panel of a row: bilinear demosaic, the frame's
white balance and colour matrix, one exposure taken from the clean frame, the sRGB curve of IEC 61966-2-1.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import encode_srgb

PANEL = 256
"""Largest side of a panel in mosaic pixels: larger frames are shown as a crop of the centre."""


def developed(packed: Tensor, cfa: CFA, pair: Pair, exposure: float = 1.0) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` to sRGB ``(3, H, W)`` in [0, 1] with the colours of ``pair``."""
    rgb = bayer.demosaic(bayer.unpack(packed, cfa), cfa)[0]
    balanced = rgb * exposure * torch.tensor(pair.white_balance)[:, None, None]
    linear = torch.einsum("ij,jhw->ihw", pair.color_matrix, balanced.clamp(max=1.0))
    return encode_srgb(linear.clamp(0.0, 1.0))


def exposure_of(packed: Tensor, pair: Pair) -> float:
    """The factor that brings the brightest percent of a clean frame to white."""
    green = packed[:, 1:3].flatten()
    stride = max(1, green.numel() // 1_000_000)
    return float(0.9 / torch.quantile(green[::stride], 0.99).clamp_min(1e-3)) / max(1.0, min(pair.white_balance))


@dataclass
class Row:
    """One frame of the picture: packed panels by title, the clean one last, with their captions."""

    pair: Pair
    panels: dict[str, Tensor]
    captions: dict[str, str]


def draw(rows: Sequence[Row], cfa: CFA, path: Path) -> Path:
    """Write the figure: one line of panels a row."""
    from matplotlib.figure import Figure

    columns = max(len(row.panels) for row in rows)
    figure = Figure(figsize=(3.2 * columns, 3.2 * len(rows)), layout="constrained")
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, row in zip(axes, rows, strict=True):
        exposure = exposure_of(list(row.panels.values())[-1], row.pair)
        for axis, (title, packed) in zip(line, row.panels.items(), strict=True):
            panel = developed(_centre(packed), cfa, row.pair, exposure)
            axis.imshow(panel.permute(1, 2, 0).numpy(), interpolation="nearest")
            axis.set_title(f"{title}\n{row.captions.get(title, '')}", fontsize=9)
            axis.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    return path


def _centre(packed: Tensor) -> Tensor:
    height, width = packed.shape[-2:]
    rows, columns = min(height, PANEL // 2), min(width, PANEL // 2)
    top, left = (height - rows) // 2, (width - columns) // 2
    return packed[..., top : top + rows, left : left + columns]


def mean_and_spread(values: Sequence[float], digits: int) -> str:
    """``mean`` or ``mean +- standard deviation``."""
    mean = f"{statistics.fmean(values):.{digits}f}"
    return mean if len(values) < 2 else f"{mean} ± {statistics.stdev(values):.{digits}f}"


def print_table(results: Mapping[str, Sequence[Mapping[str, Any]]], title: str) -> None:
    """Arms x (PSNR, SSIM), plain and self-ensemble; one entry a seed in every arm's list."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    for column in ("arm", "PSNR (dB)", "SSIM", "PSNR, self-ensemble", "SSIM, self-ensemble"):
        table.add_column(column, justify="left" if column == "arm" else "right")
    first = next(iter(results.values()))
    noisy = [mean_and_spread([r["plain"][key] for r in first], digits) for key, digits in _NOISY]
    table.add_row("noisy input", *noisy, "", "")
    for arm, runs in results.items():
        cells = [
            mean_and_spread([run[kind][key] for run in runs], digits)
            for kind in ("plain", "self_ensemble")
            for key, digits in (("psnr", 2), ("ssim", 4))
        ]
        table.add_row(arm, *cells)
    Console(width=100).print(table)


_NOISY = (("psnr_noisy", 2), ("ssim_noisy", 4))


def print_scores(result: Mapping[str, Any]) -> None:
    """The table of ``rawaug evaluate``."""
    from rich.console import Console
    from rich.table import Table

    title = "PSNR_r, RAW reconstruction" if result["kind"] == "isp" else "PSNR_d, RAW denoising"
    table = Table(title=f"{title}: {result['data']}")
    table.add_column("image")
    table.add_column("PSNR (dB)", justify="right")
    table.add_column("SSIM", justify="right")
    for image in result["images"]:
        table.add_row(image["name"], f"{image['psnr']:.2f}", f"{image['ssim']:.4f}" if "ssim" in image else "")
    table.add_section()
    for label, key in (
        ("mean", "psnr"),
        ("worst 25%", "psnr_worst25"),
        ("best 25%", "psnr_best25"),
        ("noisy", "psnr_noisy"),
    ):
        if key in result:
            similarity = {"psnr": "ssim", "psnr_noisy": "ssim_noisy"}.get(key, "")
            table.add_row(label, f"{result[key]:.2f}", f"{result[similarity]:.4f}" if similarity in result else "")
    Console(width=100).print(table)
