"""What the learned components of an ISP are worth: fits that lack one, scored on frames that no stage has seen.

Encoders, end-to-end training, the loss on the images between the stages and that on the weights' consistency (Conde et
al., AAAI 2022, "Training") are switched off one by one. Each seed draws its own frames: photographs, cameras in turn,
lights, and which photographs are left out; all variants of a seed share them, so that differences are within a seed.
Each fit's figures go into a file of their own, so that a stopped run can resume.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rawaug.data import PictureFolder, open_pictures
from rawaug.data.demo.pairs import FRAME
from rawaug.data.pairs import Pair
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.experiment.run_folder import claim, require_free
from rawaug.files import fingerprint, write_json
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import cycle_error
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr, worst_and_best_quarter
from rawaug.paper.frames import synthetic_frames
from rawaug.paper.methods import kept
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS, checked_settings
from rawaug.seeding import keyed_generator

CAMERAS = (
    *("Canon EOS 5D Mark III", "Nikon D750", "Sony ILCE-7M3", "Fujifilm X-T3", "Panasonic DC-GH5"),
    *("Olympus E-M1 Mark II", "Pentax K-3", "Samsung Galaxy S7"),
)
PIXELS = 8192
"""Of a frame on which the forward pass is scored."""
COLUMNS = {
    "psnr_r": "PSNR_r",
    "worst25": "worst 25%",
    "as_shot": "as-shot gains",
    "forward": "RAW to sRGB",
    "cycle": "cycle",
}


@dataclass
class ComponentAblation:
    """What the learned parts are worth.

    Args:
        experiment: "learned".
        name: of the folder in ``out`` that it writes.
        pictures: a folder of photographs of 288 x 448 or more, or "demo:"; one frame is made of each.
        cameras: published ones, in turn.
        frames: number of frames that an ISP is fitted to.
        left_out: number of further frames that it is scored on.
        fit: of the ISP with all parts.
        variants: by name, the keys of ``fit`` in which a fit differs.
        seed: of the first run.
        seeds: number of runs, each with frames of its own.
        out: folder of all runs.
    """

    experiment: str = "learned"
    name: str = "learned"
    pictures: str = "demo:"
    cameras: list[str] = field(default_factory=lambda: list(CAMERAS))
    frames: int = 64
    left_out: int = 32
    fit: FitConfig = field(default_factory=lambda: FitConfig(encoders="on", joint_steps=1000))
    variants: dict[str, dict[str, Any]] = field(default_factory=lambda: {"all parts": {}})
    seed: int = 0
    seeds: int = 3
    out: str = "runs"

    def __post_init__(self) -> None:
        if min(self.frames, self.left_out, self.seeds, len(self.variants), len(self.cameras)) < 1:
            raise ValueError("frames, left_out, seeds, variants and cameras must each be at least one")
        for name, changes in self.variants.items():
            if "seed" in changes:
                raise ValueError(f"variants: {name}: all variants of a run share its seed; set seed, not fit.seed")
            replace(self.fit, **checked_settings(f"variants: {name}", FitConfig, changes))

    def shortest(self) -> ComponentAblation:
        """A few steps of every variant, on two frames."""
        few = {name: changes | {"steps": 2, "joint_steps": 0} for name, changes in self.variants.items()}
        return replace(
            self, frames=2, left_out=1, fit=replace(self.fit.shortest(), joint_steps=0), variants=few, seeds=1
        )


@EXPERIMENTS.register("learned")
def ablate_components(learned: ComponentAblation, overwrite: bool = False) -> dict[str, dict[str, Any]]:
    """Run it: a table, and ``table.json`` with every figure; ``overwrite`` replaces another of its name."""
    require_free(learned, overwrite)
    pictures = open_pictures(learned.pictures, min_side=min(FRAME))
    folder = claim(learned, overwrite)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in learned.variants}
    for seed in range(learned.seed, learned.seed + learned.seeds):
        chosen = photographs(pictures, learned, seed)
        frames = synthetic_frames(chosen[: learned.frames], learned.cameras, seed, "train")
        left_out = synthetic_frames(chosen[learned.frames :], learned.cameras, seed, "left-out")
        for name, changes in progress(learned.variants.items(), label=f"seed {seed}", unit="fit"):
            config = replace(learned.fit, **changes, seed=seed)
            place = folder / f"seed{seed}" / f"{name.replace(' ', '-').replace('/', '_')}.json"
            found[name].append(variant_scores(place, config, frames, left_out))
    rows = {name: _row(runs) for name, runs in found.items()}
    write_json({"settings": asdict(learned), "rows": rows}, folder / "table.json")
    _print(rows, learned)
    return rows


def photographs(pictures: Sequence[Tensor] | PictureFolder, learned: ComponentAblation, seed: int) -> list[Tensor]:
    """As many as are needed, in a random order, of those that hold a frame.

    Raises:
        ValueError: if there are fewer.
    """
    order = torch.randperm(len(pictures), generator=keyed_generator(seed, "photographs")).tolist()
    large = (p for p in (pictures[k] for k in order) if p.shape[-2] >= FRAME[0] and p.shape[-1] >= FRAME[1])
    chosen = list(islice(large, learned.frames + learned.left_out))
    if len(chosen) < learned.frames + learned.left_out:
        raise ValueError(
            f"pictures: {learned.pictures} has {len(chosen)} of {FRAME[0]} x {FRAME[1]} or more, but frames and "
            f"left_out together need {learned.frames + learned.left_out}; give a larger folder or smaller numbers"
        )
    return chosen


def variant_scores(place: Path, config: FitConfig, frames: Sequence[Pair], left_out: Sequence[Pair]) -> dict[str, Any]:
    """The scores of one fit, from its file where it is there."""
    sums = [float(pair.raw.double().sum()) for pair in (*frames, *left_out)]
    key = fingerprint("learned", asdict(config), sums)
    if (known := kept(place, key)) is not None:
        return known
    place.parent.mkdir(parents=True, exist_ok=True)
    isp = fit_isp(frames, config, progress=False, state=place.with_suffix(".state"))
    scores = [score(isp, pair) for pair in left_out]
    result = {"key": key, "joint": isp.info.get("joint"), "parameters": isp.reverse_parameters}
    result |= {name: [one[name] for one in scores] for name in scores[0]}
    write_json(result, place)
    return result


@torch.no_grad()
def score(isp: DictionaryISP, pair: Pair) -> dict[str, float]:
    """PSNR in dB of both passes on a frame; the forward one pointwise, under the setting that it chooses itself."""
    part, _ = sample_pixels([pair], PIXELS, seed=0)
    own = isp.forward(pair.raw[None]).params
    forward = cycle_error(isp, part, own, {}, FitConfig())
    srgb = pair.srgb[None].float() / 255.0
    return {
        "psnr_r": psnr_r(isp, pair),
        "as_shot": psnr_r(isp, pair, white_balance=True),
        "forward": float(-10.0 * forward.log10()),
        "cycle": psnr(isp.cycle_without_mosaic(srgb), srgb).item(),
    }


def _row(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Each column's mean over frames, one a seed."""
    means = {key: [statistics.fmean(run[key]) for run in runs] for key in COLUMNS if key != "worst25"}
    worst = [worst_and_best_quarter(run["psnr_r"])[0] for run in runs]
    return means | {"worst25": worst, "joint": [run["joint"] for run in runs], "parameters": runs[0]["parameters"]}


def _print(rows: dict[str, dict[str, Any]], learned: ComponentAblation) -> None:
    first = next(iter(rows.values()))
    cells = []
    for name, row in rows.items():
        apart = [a - b for a, b in zip(row["psnr_r"], first["psnr_r"], strict=True)]
        figures = [mean_and_spread(row[key], 2) for key in COLUMNS]
        cells.append([name, *figures, "" if row is first else mean_and_spread(apart, 2)])
    title = (
        f"{learned.name}: fitted to {learned.frames} frames of {len(learned.cameras)} cameras, scored on "
        f"{learned.left_out} others, seeds: {learned.seeds}; dB"
    )
    print_rows(title, ["fit", *COLUMNS.values(), "PSNR_r beside the first"], cells)
