r"""The contribution of each stage: PSNR of every intermediate image of the reverse pass against the RAW.

``x, x1, ..., x5`` against the demosaiced RAW, in RGB, in luminance Y and in chrominance UV (ITU-R BT.601), as in the
ablation figure of Conde et al., AAAI 2022; with each frame's as-shot gains and blind. And the other way round: fits
that lack one stage, measured on frames left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data import open_pairs
from rawaug.data.folders import skip_broken
from rawaug.data.pairs import Pair
from rawaug.errors import extra
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.tables import print_rows
from rawaug.experiment.run_folder import claim, require_free
from rawaug.files import write_json
from rawaug.isp import conditioning
from rawaug.isp.config import POINTWISE_STAGES
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.samples import block_averages
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import as_float, place_in_frame
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS

YUV = ((0.299, 0.587, 0.114), (-0.14713, -0.28886, 0.436), (0.615, -0.51499, -0.10001))
"""RGB to YUV, ITU-R BT.601."""
TITLES = ("x", "x1 tone", "x2 gamma", "x3 colour", "x4 gains", "x5 shading")
SPACES = ("RGB", "Y", "UV")
LEFT_OUT = ("tone", "colour", "gains", "shading")
STRIDE = 4
"""Every so many pixels of a registered frame are compared."""


@dataclass
class Ablation:
    """The contribution of each stage.

    Args:
        experiment: "ablation".
        name: of the folder in ``out`` that it writes.
        data: the pairs; every frame is measured by a fit on the others.
        count: only the first so many of them.
        fit: of the ISP.
        seed: of the fits.
        out: folder of all runs.
    """

    experiment: str = "ablation"
    name: str = "ablation"
    data: str = "demo:train"
    count: int | None = None
    fit: FitConfig = field(default_factory=FitConfig)
    seed: int = 0
    out: str = "runs"

    def shortest(self) -> Ablation:
        """A few steps on two frames."""
        return replace(self, count=2, fit=self.fit.shortest())


@EXPERIMENTS.register("ablation")
def ablate(ablation: Ablation, overwrite: bool = False) -> dict[str, Any]:
    """Run an ablation: a table, ``ablation.json`` and ``ablation.png``; ``overwrite`` replaces another of its name."""
    require_free(ablation, overwrite)
    pairs = list(skip_broken(open_pairs(ablation.data, split="train"), "data"))[: ablation.count]
    if len(pairs) < 2:
        raise ValueError(f"data: {ablation.data} has {len(pairs)} frame; leave-one-out needs two or more")
    config, folder = replace(ablation.fit, seed=ablation.seed), claim(ablation, overwrite)
    stagewise: dict[str, list[list[list[float]]]] = {"blind": [], "as-shot gains": []}
    without: dict[str, list[float]] = {"none": [], **{stage: [] for stage in LEFT_OUT}}
    for left_out in progress(pairs, label="ablation", unit="frame"):
        curves, values = measure([pair for pair in pairs if pair is not left_out], left_out, config)
        for given, curve in curves.items():
            stagewise[given].append(curve)
        for stage, value in values.items():
            without[stage].append(value)
    means = {given: torch.tensor(curves).mean(0).tolist() for given, curves in stagewise.items()}
    result = {"settings": asdict(ablation), "stages": means, "without": {k: _mean(v) for k, v in without.items()}}
    write_json(result, folder / "ablation.json")
    picture = _draw(
        means, result["without"], folder / "ablation.png", f"{ablation.data}: {len(pairs)} frames, each left out"
    )
    _print(result)
    print(f"picture: {picture}")
    return result


def measure(
    others: Sequence[Pair], left_out: Pair, config: FitConfig
) -> tuple[dict[str, list[list[float]]], dict[str, float]]:
    """One frame, by fits on the others: PSNR after each stage, and PSNR_r without a stage."""
    isp = fit_isp(others, config, progress=False)
    curves = {given: stage_psnr(isp, left_out, given != "blind") for given in ("blind", "as-shot gains")}
    without = {"none": psnr_r(isp, left_out, white_balance=True)}
    for stage in LEFT_OUT:
        kept = tuple(s for s in config.isp.get("stages", POINTWISE_STAGES) if s != stage)
        lacking = fit_isp(others, replace(config, isp={**config.isp, "stages": kept}), progress=False)
        without[stage] = psnr_r(lacking, left_out, white_balance=stage != "gains")
    return curves, without


@torch.no_grad()
def stage_psnr(isp: DictionaryISP, pair: Pair, white_balance: bool) -> list[list[float]]:
    """PSNR of x, x1 ... x5 (a stage that is left out repeats the one before) in RGB, Y and UV: 6 rows of 3."""
    srgb, raw, place, known = _comparable(pair)
    params = conditioning.with_white_balance(
        isp, isp.choose(pair.srgb[None]), pair.white_balance if white_balance else None, None
    )
    seen: dict[str, Tensor] = {}
    isp.reverse_pixels(srgb, params, place, seen)
    rows, image = [], srgb
    for name in ("x", "x1", "x2", "x3", "x4", "x5"):
        image = seen.get(name, image)
        rows.append(_in_spaces(image, raw, known))
    return rows


def _comparable(pair: Pair) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sRGB, RAW of three colours, places and the mask of unclipped pixels, all ``(1, C, h, w)``."""
    if not pair.registered:
        blocks = block_averages(pair.srgb, pair.raw, pair.cfa)
        return blocks.srgb[None], blocks.raw[None], blocks.place, (~blocks.clipped)[None, None]
    picked = (..., slice(None, None, STRIDE), slice(None, None, STRIDE))
    raw = bayer.demosaic(pair.raw[None], pair.cfa)[picked]
    place = place_in_frame(*pair.raw.shape[-2:])[picked]
    srgb = as_float(pair.srgb[None])[picked]
    return srgb, raw, place, (srgb.amax(1, keepdim=True) < 0.98) & (raw.amax(1, keepdim=True) < 0.98)


def _in_spaces(image: Tensor, raw: Tensor, known: Tensor) -> list[float]:
    difference = (image - raw).permute(1, 0, 2, 3)[:, known[:, 0]]
    yuv = torch.tensor(YUV) @ difference
    return [_decibels(difference), _decibels(yuv[:1]), _decibels(yuv[1:])]


def _decibels(difference: Tensor) -> float:
    return float(-10.0 * (difference**2).mean().log10())


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _draw(means: dict[str, list[list[float]]], without: dict[str, float], path: Path, title: str) -> Path:
    with extra("train"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(2, 2, 1.3))
    for axis, (given, rows) in zip(axes, means.items(), strict=False):
        for k, space in enumerate(SPACES):
            axis.plot(range(len(TITLES)), [row[k] for row in rows], marker="o", label=space)
        axis.set_xticks(range(len(TITLES)), [t.replace(" ", "\n") for t in TITLES])
        axis.set_title(given)
        axis.set_ylabel("PSNR against RAW (dB)")
        axis.grid(alpha=0.3)
        axis.legend()
    axes[-1].barh([f"without {k}" if k != "none" else "all stages" for k in without], list(without.values()))
    axes[-1].set_xlabel("PSNR_r, as-shot gains (dB)")
    axes[-1].invert_yaxis()
    figure.suptitle(title)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    return path


def _print(result: dict[str, Any]) -> None:
    sections = [
        [[f"{given}, {space}", *(f"{row[k]:.2f}" for row in rows)] for k, space in enumerate(SPACES)]
        for given, rows in result["stages"].items()
    ]
    print_rows("PSNR against RAW after each stage (dB), frames left out", ["given, space", *TITLES], *sections)
    print("PSNR_r without a stage:", ", ".join(f"{stage} {value:.2f}" for stage, value in result["without"].items()))
