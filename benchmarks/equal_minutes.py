"""What networks reach in equal minutes of training: PSNR on validation frames, in RAW and in developed sRGB.

Steps are fitted to the time: after a first run, which fills the cache of decoded pictures, a second is timed, on a CPU
in the process's own seconds, which other programs beside it leave as they are.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor

import denoisers
import rawaug
from denoisers.files import find
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.folders import Cached
from rawaug.data.pairs import Pair, Sample
from rawaug.evaluation.contestants import published_pmrid
from rawaug.evaluation.scores import classical_method, frozen_sample, network_method, score_method
from rawaug.noise import noise_model
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train
from rawaug.training.stream import PictureCrops, TrainingStream
from rawaug.training.validation import validate, watched

NOISE = ["any camera", "cycleisp_sidd"]
MIDDLE = 512
"""Mosaic pixels on the side of what is scored of each validation frame."""
SHIPPED = "rawaug-small"
PROBE, CACHE = 60, 2048
"""Steps that are timed, and MB of decoded pictures."""


def middles(args: argparse.Namespace) -> list[Pair]:
    """The middles of the validation frames."""
    return [pair.middle(MIDDLE) for pair in open_pairs(args.validation, split="validation", bin=args.bin)]


def trained(name: str, size: dict[str, Any], args: argparse.Namespace) -> dict[str, float]:
    """PSNR in dB of one network after ``args.minutes`` of training on what ``recipes/pretrain.yaml`` describes.

    Args:
        size: the network's settings, but for its domain.
    """
    noise = noise_model(NOISE)
    pictures = Cached(open_pictures(args.pictures, min_side=args.crop + 6), CACHE)
    augment = rawaug.RawAugment.from_pretrained("universal", noise=noise)
    crops = PictureCrops(rawaug.RawPairs(pictures, augment, args.crop, zoom=2.0))
    cfa = augment.isp.cfa
    frames = [watched(frozen_sample(pair, noise, cfa, 0), pair, cfa) for pair in middles(args)]
    stream = TrainingStream(None, crops, args.batch, 1.0, seed=0)
    config = TrainConfig(batch=args.batch, crop=args.crop, learning_rate=1e-3, weigh="mixed", clip_norm=1.0)
    config.precision = args.precision
    network = DenoiserConfig(name, {"domain": "ksigma"} | size)
    clock = time.process_time if args.device.type == "cpu" else time.perf_counter

    def run(steps: int) -> tuple[denoisers.Denoiser, float]:
        config.steps, config.validate_every, config.checkpoint_every = steps, steps, steps
        config.ema = 0.999 if steps > 5000 else 0.99
        with tempfile.TemporaryDirectory() as folder:
            began = clock()
            model = train(stream, frames, network, config, Path(folder), device=args.device.type, label=name)
            return model, clock() - began

    run(PROBE)
    _, probe = run(PROBE)
    steps = max(PROBE, round(PROBE * 60.0 * args.minutes / probe))
    model, seconds = run(steps)
    scores = validate(model, frames, torch.device("cpu"))
    return {"minutes": seconds / 60, "steps": steps, "psnr": scores["psnr"], "psnr_srgb": scores["psnr_srgb"]}


def references(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """The same scores of NonLocalMeans, of the shipped weights and, where ``args.pmrid`` is a file, of PMRID's."""
    noise, cfa = noise_model(NOISE), CFA.RGGB
    shipped, info = denoisers.load(find(SHIPPED))
    methods = {
        "NonLocalMeans": classical_method("NonLocalMeans", noise, 0),
        SHIPPED: network_method(shipped, cfa, CFA(info["cfa"])),
    }
    if args.pmrid:
        published = published_pmrid(args.pmrid)

        def pmrid(_: Pair, sample: Sample) -> Tensor:
            return denoisers.tiled(published, sample.noisy, sample.variance).clamp(0.0, 1.0)

        methods["PMRID, published weights"] = pmrid
    rows = {}
    for label, method in methods.items():
        scores = list(score_method(method, middles(args), noise, cfa, 0, label))
        rows[label] = {key: fmean(getattr(score, key) for score in scores) for key in ("psnr", "psnr_srgb")}
    return rows


def chart(networks: Mapping[str, Mapping[str, float]], references: Mapping[str, Any], place: Path) -> None:
    """PSNR over seconds a mosaic megapixel on one thread, with the references as lines, as a PNG."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    for axes, key, title in zip(figure.subplots(1, 2), ("psnr", "psnr_srgb"), ("RAW", "developed sRGB"), strict=True):
        for name, row in networks.items():
            seconds = next(value for what, value in row.items() if what.startswith("s/Mpix"))
            axes.plot(seconds, row[key], "o", markersize=8, label=f"{name}, {row['parameters'] / 1e6:.2f} M")
        for (label, row), style in zip(references.items(), ("--", "-", ":"), strict=False):
            axes.axhline(row[key], color="0.4", linestyle=style, label=label)
        axes.set(xlabel="seconds a megapixel, one thread", ylabel="PSNR (dB)", title=title)
        axes.set_xlim(left=0)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right")
    figure.savefig(place, dpi=120)
