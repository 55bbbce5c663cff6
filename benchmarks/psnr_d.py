"""What each part of the universal ISP is worth: PSNR_d of denoisers trained on RAW made without it.

    python -m benchmarks.psnr_d --pictures PHOTOS [MORE ...] --test NAME=RAW_DIR [NAME=...] [--real NAME=RAW_DIR ...]
        [--seeds 0 1 2] [--recipe RECIPE.yaml] [--steps 1200] [--out runs/psnr_d]

Network, steps, noise and pictures are those of recipes/reconstruction.yaml, or of the training recipe that is given,
but for its zoom, and the same in every row; a row differs in the way from sRGB to RAW. The test frames have
cycleisp_sidd noise. ``without tone``: the sRGB curve alone. ``without consistent gains``: gains of another camera
in another light. ``without the wide hull``: one camera's matrix. ``pairs of 41.18 dB``: noise scaled, in training
alone, to the pairs of Conde et al. ``real``: trained on crops of real RAW frames in place of pictures. --rows picks
rows. Each network is scored on every test set. What is finished is taken from OUT, so that a stopped run can be
started again; another recipe or number of steps needs another OUT.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from benchmarks.measure import parser
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import Row, score
from rawaug.evaluation.tables import mean_and_spread, print_rows
from rawaug.evaluation.trials import make_trial
from rawaug.experiment.recipe import find_recipe, read_recipe
from rawaug.files import write_json
from rawaug.isp.model import DictionaryISP
from rawaug.noise import NoiseModel, noise_model
from rawaug.paper.baselines import UPI
from rawaug.paper.downstream import DownstreamConfig, MadeCrops, score_on, train_on
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw
from rawaug.plugin.pictures import trim_to_even
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.sources import PictureCrops, RealCrops, Source

CONFIG = DownstreamConfig(
    denoiser=DenoiserConfig("UNet", {"width": 16, "scales": 4}), train=TrainConfig(steps=1500, batch=8, crop=64)
)
PAIR_PSNR = 41.18
"""Mean PSNR in dB of the training pairs of Conde et al., AAAI 2022."""
Rows = dict[str, dict[str, dict[str, list[float]]]]
"""By row, seed and test set: PSNR in RAW and developed."""
NARROW = "Canon EOS 5D Mark III"
"""The camera that stands for all where the hull is taken away."""


def settings(recipe: str | None, steps: int | None) -> tuple[DownstreamConfig, NoiseModel]:
    """Network and loop, and the noise of the training samples, of a training recipe; None for :data:`CONFIG`'s."""
    config, noise = CONFIG, noise_model(CONFIG.noise)
    if recipe is not None:
        found = read_recipe(find_recipe(recipe))
        train = TrainConfig(**{**found["train"], "workers": 0})
        config = replace(CONFIG, denoiser=DenoiserConfig(**found["denoiser"]), train=train)
        noise = noise_model(found["noise"])
    return replace(config, train=replace(config.train, steps=steps or config.train.steps)), noise


def without_tone(isp: DictionaryISP) -> DictionaryISP:
    """The ISP with the linear rendering for every tone atom."""
    assert isp.tone is not None
    linear = isp.tone.curves[isp.info["tones"].index("linear")].clone()
    isp.tone.curves.copy_(linear.expand_as(isp.tone.curves))
    return isp


def sources(
    pictures: Sequence[Tensor], real: dict[str, list[str]], noise: NoiseModel, crop: int
) -> Iterator[tuple[str, Source]]:
    """Rows: name and training samples."""

    def universal() -> DictionaryISP:
        return DictionaryISP.from_pretrained("universal")

    def made(isp: DictionaryISP, draw: Draw = Draw()) -> Source:
        return PictureCrops(RawPairs(pictures, RawAugment(isp, noise, draw=draw), crop))

    yield "universal", made(universal())
    upi = UPI()
    yield "UPI", MadeCrops(pictures, upi.draw, upi.cfa, noise, crop)
    yield "without tone", made(without_tone(universal()))
    yield "without consistent gains", made(universal(), Draw(sampling="independent"))
    calibrated = RawAugment(universal(), noise_model({"pair_psnr": PAIR_PSNR}))
    yield f"pairs of {PAIR_PSNR} dB", PictureCrops(RawPairs(pictures, calibrated, crop))
    yield "without the wide hull", made(universal().with_cameras(NARROW))
    for name, specs in real.items():
        pairs = [pair for spec in specs for pair in open_pairs(spec)]
        yield f"real RAW, {name}", RealCrops(pairs, noise, crop, CFA.RGGB)


def means(rows: Sequence[Row]) -> list[float]:
    """Mean PSNR over frames; that of sRGB over those that can be developed."""
    return [fmean(row.psnr for row in rows), fmean(row.psnr_srgb for row in rows if row.psnr_srgb is not None)]


def filtered(specs: Sequence[str], factor: int) -> list[float]:
    """The row that needs no training."""
    noise, cfa = noise_model(CONFIG.noise), CFA.RGGB
    frames = [pair.middle(1024) for spec in specs for pair in open_pairs(spec, split="test", bin=factor)]
    return means(list(score([RawDenoiser.of("NonLocalMeans")], (make_trial(pair, noise, cfa) for pair in frames))))


def named(values: Sequence[str]) -> dict[str, list[str]]:
    """``NAME=SPEC`` arguments; a name may come several times."""
    specs: dict[str, list[str]] = {}
    for value in values:
        name, spec = value.split("=", 1)
        specs.setdefault(name, []).append(spec)
    return specs


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("--pictures", nargs="+", required=True)
    cli.add_argument("--test", nargs="+", required=True, metavar="NAME=RAW")
    cli.add_argument("--bin", type=int, default=1, help="bins the tests K x K by colour site: clean references")
    cli.add_argument("--real", nargs="*", default=[], metavar="NAME=RAW")
    cli.add_argument("--rows", nargs="*", default=[], help="names of rows to run; all by default")
    cli.add_argument("--recipe", help="a training recipe; its network, loop, noise and crops")
    cli.add_argument("--steps", type=int, help="in place of the recipe's")
    cli.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    cli.add_argument("--out", type=Path, default=Path("runs/psnr_d"))
    options = cli.parse_args()
    torch.set_num_threads(1)
    config, noise = settings(options.recipe, options.steps)
    config = replace(config, bin=options.bin)
    crop = config.train.crop
    folders = [open_pictures(folder, min_side=crop) for folder in options.pictures]
    pictures = [trim_to_even(folder[k]) for folder in folders for k in range(len(folder))]
    tests, known = named(options.test), options.out / "scores.json"
    rows: Rows = json.loads(known.read_text(encoding="utf-8")) if known.is_file() else {}
    for seed in options.seeds:
        for row, crops in sources(pictures, named(options.real), noise, crop):
            if options.rows and row not in options.rows:
                continue
            scores = rows.setdefault(row, {}).setdefault(str(seed), {})
            if tests.keys() <= scores.keys():
                continue
            net = train_on(crops, config, options.out / row.replace(" ", "-").replace(",", ""), seed)
            scores |= {
                test: means(score_on(net, replace(config, test=specs), CFA.RGGB)) for test, specs in tests.items()
            }
            write_json(rows, known)
    rows["NonLocalMeans"] = {"": {test: filtered(specs, options.bin) for test, specs in tests.items()}}
    heads = [f"{test}, {domain}" for test in tests for domain in ("RAW", "sRGB")]
    cells = [
        [row, *(mean_and_spread([s[test][k] for s in scores.values()], 2) for test in tests for k in (0, 1))]
        for row, scores in rows.items()
    ]
    print_rows(f"PSNR_d in dB, {len(pictures)} pictures, seeds {options.seeds}", ["RAW of", *heads], cells)


if __name__ == "__main__":
    main()
