r"""Measures what the stages of an ISP are worth, on frames that no stage of a fit has seen.

The PSNR of every intermediate image ``x, x1, ..., x5`` of the reverse pass is measured against the demosaiced RAW, in
RGB, in luminance Y and in chrominance UV (ITU-R BT.601), as in the ablation figure of Conde et al., AAAI 2022, with
each frame's as-shot gains and blind. Fits that lack one stage are measured as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data import open_pairs
from rawaug.data.frames import skip_broken
from rawaug.data.pairs import Pair
from rawaug.evaluation.figures import new_figure, save_figure
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.tables import print_rows
from rawaug.experiment.folder import claim, require_free
from rawaug.experiment.recipe import EXPERIMENTS
from rawaug.files import write_json
from rawaug.isp.config import POINTWISE_STAGES
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.samples import block_averages
from rawaug.isp.functional import as_float, frame_coordinates
from rawaug.isp.model import DictionaryISP
from rawaug.progress import progress

YUV = ((0.299, 0.587, 0.114), (-0.14713, -0.28886, 0.436), (0.615, -0.51499, -0.10001))
"""The matrix from RGB to YUV of ITU-R BT.601."""
TITLES = ("x", "x1 tone", "x2 gamma", "x3 colour", "x4 gains", "x5 shading")
SPACES = ("RGB", "Y", "UV")
LEFT_OUT = ("tone", "colour", "gains", "shading")
STRIDE = 4
"""Distance, in both directions, of the pixels of a registered frame that are compared."""
CLIPPED = 0.98
"""The value from which on pixels of a registered frame are left out."""


@dataclass
class Ablation:
    """The settings of the experiment with stages.

    Args:
        name: of the output folder within ``out``.
        data: the pairs; every frame is measured by a fit on the others.
        count: number of pairs to use, the first ones; null for all.
        fit: of the ISP.
        seed: of the fits.
        out: folder of all runs.
    """

    name: str = "ablation"
    data: str = "demo:train"
    count: int | None = None
    fit: FitConfig = field(default_factory=FitConfig)
    seed: int = 0
    out: str = "runs"

    def shortest(self) -> Ablation:
        """Take a few steps on two frames."""
        return replace(self, count=2, fit=self.fit.shortest())


@EXPERIMENTS.register("ablation")
def ablate(ablation: Ablation, overwrite: bool = False) -> dict[str, Any]:
    """Measure what each stage contributes; print a table, and write ``ablation.json`` and ``ablation.png``.

    ``overwrite`` replaces another run of its name.

    Returns:
        ``settings``; ``stages``, PSNR in dB of :data:`TITLES` by :data:`SPACES`; and ``without``, PSNR_r by stage.

    Raises:
        ValueError: if there are fewer than two frames.
    """
    require_free(ablation, overwrite)
    pairs = _first_pairs(ablation)
    config = replace(ablation.fit, seed=ablation.seed)
    folder = claim(ablation, overwrite)

    curves: dict[str, list[list[list[float]]]] = {}
    scores: dict[str, list[float]] = {}
    for test_pair in progress(pairs, label="ablation", unit="frame"):
        training_pairs = [pair for pair in pairs if pair is not test_pair]
        by_setting, without = measure(training_pairs, test_pair, config)
        for setting, curve in by_setting.items():
            curves.setdefault(setting, []).append(curve)
        for stage, score in without.items():
            scores.setdefault(stage, []).append(score)

    result = {
        "settings": asdict(ablation),
        "stages": {setting: torch.tensor(rows).mean(0).tolist() for setting, rows in curves.items()},
        "without": {stage: fmean(values) for stage, values in scores.items()},
    }
    write_json(result, folder / "ablation.json")
    picture = folder / "ablation.png"
    _draw(result, picture, f"{ablation.data}: {len(pairs)} frames, each left out")

    _print(result)
    print(f"picture: {picture}")
    return result


def _first_pairs(ablation: Ablation) -> list[Pair]:
    """Open the pairs to use; raise ValueError if there are fewer than two."""
    readable = skip_broken(open_pairs(ablation.data, split="train"), "data")
    pairs = list(islice(readable, ablation.count))
    if len(pairs) < 2:
        raise ValueError(f"data: {ablation.data} has {len(pairs)} frame; leave-one-out needs two or more")
    return pairs


def measure(
    training_pairs: Sequence[Pair], test_pair: Pair, config: FitConfig
) -> tuple[dict[str, list[list[float]]], dict[str, float]]:
    """Measure one frame by fits to others.

    Returns:
        By setting, ``blind`` or ``as-shot gains``, the PSNR in dB of 6 stages in 3 spaces; and PSNR_r in dB of fits
        without a stage, by the stage, where ``none`` lacks nothing.
    """
    isp = fit_isp(training_pairs, config, progress=False)
    curves = {
        "blind": stage_psnr(isp, test_pair, white_balance=False),
        "as-shot gains": stage_psnr(isp, test_pair, white_balance=True),
    }

    without = {"none": psnr_r(isp, test_pair, white_balance=True)}
    for stage in LEFT_OUT:
        stages = [name for name in config.isp.get("stages", POINTWISE_STAGES) if name != stage]
        lacking = fit_isp(training_pairs, replace(config, isp={**config.isp, "stages": tuple(stages)}), progress=False)
        without[stage] = psnr_r(lacking, test_pair, white_balance=stage != "gains")
    return curves, without


def _print(result: dict[str, Any]) -> None:
    sections = []
    for setting, rows in result["stages"].items():
        section = []
        for k, space in enumerate(SPACES):
            section.append([f"{setting}, {space}", *(f"{row[k]:.2f}" for row in rows)])
        sections.append(section)

    print_rows("PSNR against RAW after each stage (dB), frames left out", ["setting, space", *TITLES], *sections)
    without = ", ".join(f"{stage} {value:.2f}" for stage, value in result["without"].items())
    print(f"PSNR_r without a stage: {without}")


@torch.no_grad()
def stage_psnr(isp: DictionaryISP, pair: Pair, white_balance: bool) -> list[list[float]]:
    """Compute PSNR in dB of x, x1 ... x5 in RGB, Y and UV: 6 rows of 3; a missing stage repeats the one before."""
    srgb, raw, coordinates, unclipped = _comparable_pixels(pair)
    params = isp.choose(pair.srgb[None])
    if white_balance:
        params = isp.with_white_balance(params, pair.clean.white_balance)

    images: dict[str, Tensor] = {}
    isp.stages.reverse(srgb, params, coordinates, images)

    rows = []
    image = srgb
    for title in TITLES:
        image = images.get(title[:2].rstrip(), image)
        difference = (image - raw).permute(1, 0, 2, 3)[:, unclipped[:, 0]]
        yuv = torch.tensor(YUV) @ difference
        rows.append([_decibels(difference), _decibels(yuv[:1]), _decibels(yuv[1:])])
    return rows


def _comparable_pixels(pair: Pair) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Give sRGB, RAW of three colours, coordinates and the mask of unclipped pixels, all ``(1, C, h, w)``."""
    if not pair.registered:
        srgb, raw, clipped, coordinates = block_averages(pair.srgb, pair.clean.mosaic, pair.cfa)
        return srgb[None], raw[None], coordinates, (~clipped)[None, None]

    every_fourth = (..., slice(None, None, STRIDE), slice(None, None, STRIDE))
    raw = bayer.demosaic(pair.clean.mosaic[None], pair.cfa)[every_fourth]
    coordinates = frame_coordinates(*pair.clean.mosaic.shape[-2:])[every_fourth]
    srgb = as_float(pair.srgb[None])[every_fourth]

    unclipped = (srgb.amax(1, keepdim=True) < CLIPPED) & (raw.amax(1, keepdim=True) < CLIPPED)
    return srgb, raw, coordinates, unclipped


def _decibels(difference: Tensor) -> float:
    return float(-10.0 * (difference**2).mean().log10())


def _draw(result: dict[str, Any], path: Path, title: str) -> None:
    figure = new_figure(13, 4)
    axes = figure.subplots(1, 3, width_ratios=(2, 2, 1.3))
    ticks = [stage.replace(" ", "\n") for stage in TITLES]

    for axis, (setting, rows) in zip(axes, result["stages"].items(), strict=False):
        curves = torch.tensor(rows)
        for k, space in enumerate(SPACES):
            axis.plot(range(len(TITLES)), curves[:, k], marker="o", label=space)

        axis.set_xticks(range(len(TITLES)), ticks)
        axis.set_title(setting)
        axis.set_ylabel("PSNR against RAW (dB)")
        axis.grid(alpha=0.3)
        axis.legend()

    labels = ["all stages", *(f"without {stage}" for stage in LEFT_OUT)]
    axes[-1].barh(labels, list(result["without"].values()))
    axes[-1].set_xlabel("PSNR_r, as-shot gains (dB)")
    axes[-1].invert_yaxis()
    figure.suptitle(title)
    save_figure(figure, path)
