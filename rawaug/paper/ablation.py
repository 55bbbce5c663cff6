r"""What the stages and the learned parts of an ISP are worth, on frames that no stage of a fit has seen.

*Stages*: PSNR of every intermediate image ``x, x1, ..., x5`` of the reverse pass against the demosaiced RAW, in RGB, in
luminance Y and in chrominance UV (ITU-R BT.601), as in the ablation figure of Conde et al., AAAI 2022; with each
frame's as-shot gains and blind. And the other way round: fits that lack one stage.

*Learned parts*: encoders, end-to-end training, the loss on the images between the stages and that on the weights'
consistency are switched off one by one. Each seed draws its own frames, which all variants share: photographs are the
scenes before the demo camera's lens and sensor, in the colours of a published camera and the balance of a light. The
figures of each fit go into a file of their own, so that a stopped run can resume.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import islice
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.camera.psnr_r import psnr_r
from rawaug.data import DemoCamera, PictureFolder, open_pairs, open_pictures
from rawaug.data.demo import FRAME
from rawaug.data.folders import skip_broken
from rawaug.data.pairs import Pair
from rawaug.evaluation.scores import mean_and_spread, new_figure, print_rows
from rawaug.experiment.plan import claim, require_free
from rawaug.files import fingerprint, write_json
from rawaug.isp import staged
from rawaug.isp.cameras import camera_from_srgb, gains_in_light, load_cameras, sample_lights
from rawaug.isp.config import POINTWISE_STAGES
from rawaug.isp.dictionary import is_plausible
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import cycle_error
from rawaug.isp.fit.samples import block_averages, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import as_float, frame_coordinates
from rawaug.metrics import psnr, worst_and_best_quarter
from rawaug.paper.methods import cycle_without_mosaic, resume, reverse_parameters
from rawaug.progress import progress
from rawaug.registry import EXPERIMENTS, check_settings
from rawaug.seeding import keyed_generator

YUV = ((0.299, 0.587, 0.114), (-0.14713, -0.28886, 0.436), (0.615, -0.51499, -0.10001))
"""The matrix from RGB to YUV of ITU-R BT.601."""
TITLES = ("x", "x1 tone", "x2 gamma", "x3 colour", "x4 gains", "x5 shading")
SPACES = ("RGB", "Y", "UV")
LEFT_OUT = ("tone", "colour", "gains", "shading")
STRIDE = 4
"""Every fourth pixel of a registered frame is compared, in both directions."""


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
        """A few steps on two frames."""
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
    pairs = list(skip_broken(open_pairs(ablation.data, split="train"), "data"))[: ablation.count]
    if len(pairs) < 2:
        raise ValueError(f"data: {ablation.data} has {len(pairs)} frame; leave-one-out needs two or more")
    config, folder = replace(ablation.fit, seed=ablation.seed), claim(ablation, overwrite)
    every = [
        measure([pair for pair in pairs if pair is not left_out], left_out, config)
        for left_out in progress(pairs, label="ablation", unit="frame")
    ]
    means = {given: torch.tensor([curves[given] for curves, _ in every]).mean(0).tolist() for given in every[0][0]}
    without = {stage: fmean(values[stage] for _, values in every) for stage in every[0][1]}
    result = {"settings": asdict(ablation), "stages": means, "without": without}
    write_json(result, folder / "ablation.json")
    picture = folder / "ablation.png"
    _draw(result, picture, f"{ablation.data}: {len(pairs)} frames, each left out")
    sections = [
        [[f"{given}, {space}", *(f"{row[k]:.2f}" for row in rows)] for k, space in enumerate(SPACES)]
        for given, rows in means.items()
    ]
    print_rows("PSNR against RAW after each stage (dB), frames left out", ["given, space", *TITLES], *sections)
    print("PSNR_r without a stage:", ", ".join(f"{stage} {value:.2f}" for stage, value in without.items()))
    print(f"picture: {picture}")
    return result


def measure(
    others: Sequence[Pair], left_out: Pair, config: FitConfig
) -> tuple[dict[str, list[list[float]]], dict[str, float]]:
    """Measure one frame by fits on the others: :func:`stage_psnr`, blind and with its gains, and PSNR_r by stage."""
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
    """PSNR in dB of x, x1 ... x5 in RGB, Y and UV: 6 rows of 3; a stage that is left out repeats the one before."""
    srgb, raw, coordinates, known = _comparable_pixels(pair)
    given = pair.white_balance if white_balance else None
    params = staged.with_white_balance(isp, isp.choose(pair.srgb[None]), given, None)
    seen: dict[str, Tensor] = {}
    isp.reverse_pixels(srgb, params, coordinates, seen)
    rows, image = [], srgb
    for title in TITLES:
        image = seen.get(title[:2].rstrip(), image)
        difference = (image - raw).permute(1, 0, 2, 3)[:, known[:, 0]]
        yuv = torch.tensor(YUV) @ difference
        rows.append([_decibels(difference), _decibels(yuv[:1]), _decibels(yuv[1:])])
    return rows


def _comparable_pixels(pair: Pair) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """sRGB, RAW of three colours, coordinates and the mask of unclipped pixels, all ``(1, C, h, w)``."""
    if not pair.registered:
        blocks = block_averages(pair.srgb, pair.raw, pair.cfa)
        return blocks.srgb[None], blocks.raw[None], blocks.coordinates, (~blocks.clipped)[None, None]
    picked = (..., slice(None, None, STRIDE), slice(None, None, STRIDE))
    raw = bayer.demosaic(pair.raw[None], pair.cfa)[picked]
    coordinates = frame_coordinates(*pair.raw.shape[-2:])[picked]
    srgb = as_float(pair.srgb[None])[picked]
    return srgb, raw, coordinates, (srgb.amax(1, keepdim=True) < 0.98) & (raw.amax(1, keepdim=True) < 0.98)


def _decibels(difference: Tensor) -> float:
    return float(-10.0 * (difference**2).mean().log10())


def _draw(result: dict[str, Any], path: Path, title: str) -> None:
    figure = new_figure(13, 4)
    axes = figure.subplots(1, 3, width_ratios=(2, 2, 1.3))
    for axis, (given, rows) in zip(axes, result["stages"].items(), strict=False):
        for k, space in enumerate(SPACES):
            axis.plot(range(len(TITLES)), [row[k] for row in rows], marker="o", label=space)
        axis.set_xticks(range(len(TITLES)), [t.replace(" ", "\n") for t in TITLES])
        axis.set_title(given)
        axis.set_ylabel("PSNR against RAW (dB)")
        axis.grid(alpha=0.3)
        axis.legend()
    without = {"all stages" if k == "none" else f"without {k}": value for k, value in result["without"].items()}
    axes[-1].barh(list(without), list(without.values()))
    axes[-1].set_xlabel("PSNR_r, as-shot gains (dB)")
    axes[-1].invert_yaxis()
    figure.suptitle(title)
    figure.savefig(path, dpi=130)


CAMERAS = (
    *("Canon EOS 5D Mark III", "Nikon D750", "Sony ILCE-7M3", "Fujifilm X-T3", "Panasonic DC-GH5"),
    *("Olympus E-M1 Mark II", "Pentax K-3", "Samsung Galaxy S7"),
)
LIGHTS_TRIED = 32
PIXELS = 8192
"""Number of pixels of a frame on which the forward pass is scored."""
COLUMNS = {
    "psnr_r": "PSNR_r", "worst25": "worst 25%", "as_shot": "as-shot gains", "forward": "RAW to sRGB", "cycle": "cycle",
}  # fmt: skip


@dataclass
class ComponentAblation:
    """The settings of the experiment with learned parts.

    Args:
        name: of the output folder within ``out``.
        pictures: a folder of photographs of 288 x 448 or more, or "demo:"; one frame is made of each.
        cameras: names of published cameras, which the frames have in turn.
        frames: number of frames that an ISP is fitted to.
        left_out: number of further frames that it is scored on.
        fit: of the ISP with all parts.
        variants: by name, the keys of ``fit`` in which a fit differs.
        seed: of the first run.
        seeds: number of runs, each with frames of its own.
        out: folder of all runs.
    """

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
            replace(self.fit, **check_settings(f"variants: {name}", FitConfig, changes))

    def shortest(self) -> ComponentAblation:
        """A few steps of every variant, on two frames."""
        few = {name: changes | {"steps": 2, "joint_steps": 0} for name, changes in self.variants.items()}
        return replace(
            self, frames=2, left_out=1, fit=replace(self.fit.shortest(), joint_steps=0), variants=few, seeds=1
        )


@EXPERIMENTS.register("learned")
def ablate_components(learned: ComponentAblation, overwrite: bool = False) -> dict[str, dict[str, Any]]:
    """Measure what each learned part contributes; print a table, and write ``table.json`` with every figure.

    ``overwrite`` replaces another run of its name.

    Returns:
        By variant the figures of ``COLUMNS``, means over frames in dB, one a seed.
    """
    pictures = open_pictures(learned.pictures, min_side=min(FRAME))
    folder = claim(learned, overwrite)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in learned.variants}
    for seed in range(learned.seed, learned.seed + learned.seeds):
        chosen = photographs(pictures, learned, seed)
        frames = synthetic_frames(chosen[: learned.frames], learned.cameras, seed, "train")
        left_out = synthetic_frames(chosen[learned.frames :], learned.cameras, seed, "left-out")
        for name, changes in progress(learned.variants.items(), label=f"seed {seed}", unit="fit"):
            config = replace(learned.fit, **changes, seed=seed)
            path = folder / f"seed{seed}" / f"{name.replace(' ', '-').replace('/', '_')}.json"
            found[name].append(score_variant(path, config, frames, left_out))
    rows = {name: _row(runs) for name, runs in found.items()}
    write_json({"settings": asdict(learned), "rows": rows}, folder / "table.json")
    title = (
        f"{learned.name}: fitted to {learned.frames} frames of {len(learned.cameras)} cameras, scored on "
        f"{learned.left_out} others, seeds: {learned.seeds}; dB"
    )
    first, cells = next(iter(rows.values())), []
    for name, row in rows.items():
        apart = [a - b for a, b in zip(row["psnr_r"], first["psnr_r"], strict=True)]
        figures = [mean_and_spread(row[key], 2) for key in COLUMNS]
        cells.append([name, *figures, "" if row is first else mean_and_spread(apart, 2)])
    print_rows(title, ["fit", *COLUMNS.values(), "PSNR_r beside the first"], cells)
    return rows


def synthetic_frames(pictures: Sequence[Tensor], cameras: Sequence[str], seed: int, part: str) -> list[Pair]:
    """A frame of 288 x 448 of each picture, each in a light of its own.

    Args:
        pictures: uint8 sRGB ``(3, H, W)``, the scenes.
        cameras: names of published ones, which take turns.
        seed: decides crops and lights.
        part: of the experiment; its name is part of the seed and of the frames' names.
    """
    matrices = load_cameras().select(cameras)
    frames = []
    for k, picture in enumerate(pictures):
        which, generator = k % len(cameras), keyed_generator(seed, "varied frame", part, k)
        shot_of = _camera_in_light(matrices[which], generator)
        factor = min(side // size for side, size in zip(picture.shape[-2:], FRAME, strict=True))
        small = F.avg_pool2d(picture[None].float(), factor)[0].round().to(torch.uint8)  # the largest whole reduction
        scene = bayer.RandomCrop(FRAME)(small, generator)
        frames.append(shot_of(scene, f"{part}_{k:03d}_{cameras[which].replace(' ', '-')}"))
    return frames


def _camera_in_light(xyz_to_camera: Tensor, generator: torch.Generator) -> Callable[[Tensor, str], Pair]:
    """The demo camera with these colours in a random light: a function from scene and name to a frame."""
    balances = gains_in_light(xyz_to_camera, torch.from_numpy(sample_lights(LIGHTS_TRIED, generator))).numpy()
    red, green, blue = balances[is_plausible(balances)][0].tolist()
    least = min(red, green, blue)
    to_srgb = torch.linalg.inv(camera_from_srgb(xyz_to_camera)).tolist()
    camera = DemoCamera(color_matrix=tuple((r, g, b) for r, g, b in to_srgb))
    shot = camera.sample(generator, iso=100)._replace(white_balance=(red / least, green / least, blue / least))
    return lambda scene, name: camera.apply(scene, shot, name)


def photographs(pictures: Sequence[Tensor] | PictureFolder, learned: ComponentAblation, seed: int) -> list[Tensor]:
    """Draw as many uint8 pictures ``(3, H, W)`` as are needed, in a random order, of those that are large enough.

    Raises:
        ValueError: if there are too few.
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


def score_variant(path: Path, config: FitConfig, frames: Sequence[Pair], left_out: Sequence[Pair]) -> dict[str, Any]:
    """The scores of one fit.

    Args:
        path: of the JSON file that holds them once they are measured.
        config: of the fit.
        frames: what is fitted.
        left_out: what is scored.
    """
    sums = [float(pair.raw.double().sum()) for pair in (*frames, *left_out)]
    path.parent.mkdir(parents=True, exist_ok=True)

    def measure() -> dict[str, Any]:
        isp = fit_isp(frames, config, progress=False, state=path.with_suffix(".state"))
        scores = [score(isp, pair) for pair in left_out]
        by_name = {name: [one[name] for one in scores] for name in scores[0]}
        return {"joint": isp.info.get("joint"), "parameters": reverse_parameters(isp), **by_name}

    return resume(path, fingerprint("learned", asdict(config), sums), measure)


@torch.no_grad()
def score(isp: DictionaryISP, pair: Pair) -> dict[str, float]:
    """PSNR in dB of both passes on a frame; the forward one pointwise, under the setting that it chooses itself."""
    part = sample_pixels([pair], PIXELS, seed=0).pixels
    forward = cycle_error(isp, part, isp.forward(pair.raw[None]).params, {}, FitConfig())
    srgb = pair.srgb[None].float() / 255.0
    return {
        "psnr_r": psnr_r(isp, pair),
        "as_shot": psnr_r(isp, pair, white_balance=True),
        "forward": float(-10.0 * forward.log10()),
        "cycle": psnr(cycle_without_mosaic(isp, srgb), srgb).item(),
    }


def _row(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Each column's mean over frames, one a seed."""
    means = {key: [fmean(run[key]) for run in runs] for key in COLUMNS if key != "worst25"}
    worst = [worst_and_best_quarter(run["psnr_r"])[0] for run in runs]
    return means | {"worst25": worst, "joint": [run["joint"] for run in runs], "parameters": runs[0]["parameters"]}
