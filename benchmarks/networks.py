"""What a network costs: parameters, GMAC and seconds a mosaic megapixel, and PSNR for equal minutes of training.

    python -m benchmarks.networks [--networks UNet PMRID] [--device cuda] [--quick]
    python -m benchmarks.networks --minutes 20 --pictures PHOTOS --validation RAW_DIR      two hours

Each network runs in a process of its own, and the fastest run counts. With ``--minutes`` each is trained for the same
time on RAW of published cameras with :data:`NOISE` and scored on the validation frames, beside NonLocalMeans,
``rawaug-small`` and, with ``--pmrid FILE``, PMRID's published weights. ``benchmarks.loader`` times training steps.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

import denoisers
import rawaug
from benchmarks.measure import arguments, fastest, finish, show, start
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.frames import Cached
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import group_rows, score
from rawaug.evaluation.trials import make_trial
from rawaug.noise import noise_model
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train, validate
from rawaug.training.sources import PictureCrops
from rawaug.training.stream import TrainingStream

SIZES: dict[str, dict[str, Any]] = {
    "UNet": {"width": 16, "scales": 4},
    "DHDN": {"width": 16},
    "DnCNN": {"width": 32, "depth": 12},
    "PMRID": {"variance_map": True},
    "NAFNet": {"width": 16, "encoder": [1, 1, 2], "middle": 4, "decoder": [1, 1, 1]},
    "DRUNet": {"width": 32, "blocks": 1, "limits": True, "variance_map": False, "domain": "anscombe"},
}
"""The networks in sizes for a CPU."""
SIDE = 512
"""Packed pixels on the side of the picture that inference is timed on, a mosaic megapixel."""


def inference(network: denoisers.Denoiser, args: argparse.Namespace) -> dict[str, float]:
    """GMAC and seconds a mosaic megapixel; on a CPU on one and on two threads."""
    noisy = torch.rand(1, 4, SIDE, SIDE, device=args.device)
    inputs = [x.contiguous(memory_format=torch.channels_last) for x in (noisy, 1e-3 * noisy + 1e-5)]
    megapixels, figures = 4 * SIDE**2 / 1e6, dict[str, float]()
    with torch.inference_mode():
        with FlopCounterMode(display=False) as counter:
            network(*inputs)
        figures["GMAC/Mpix"] = counter.get_total_flops() / 2e9 / megapixels
        before = torch.get_num_threads()
        for threads in (1, 2) if args.device.type == "cpu" else (before,):
            torch.set_num_threads(threads)
            seconds = fastest({"one": lambda: network(*inputs)}, args.repeats, args.device)["one"]
            figures[f"s/Mpix, {threads} thread(s)"] = seconds / megapixels
        torch.set_num_threads(before)
    return figures


# -- equal minutes -----------------------------------------------------------------------------------------------------

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
    """PSNR in dB of one network after ``args.minutes`` of training on RAW of published cameras.

    Args:
        size: the network's settings, but for its domain.
    """
    noise = noise_model(NOISE)
    pictures = Cached(open_pictures(args.pictures, min_side=args.crop + 6), CACHE)
    augment = rawaug.RawAugment.from_pretrained("universal", noise=noise)
    crops = PictureCrops(rawaug.RawPairs(pictures, augment, args.crop, zoom=2.0))
    cfa = augment.isp.cfa
    frames = [make_trial(pair, noise, cfa) for pair in middles(args)]
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
    (_, once), (_, twice) = run(PROBE), run(2 * PROBE)  # what is done once, such as validation, is in both
    each = (twice - once) / PROBE
    steps = max(PROBE, round((60.0 * args.minutes - once) / each) + PROBE)
    model, seconds = run(steps)
    scores = validate(model, frames, torch.device("cpu"))
    return {"minutes": seconds / 60, "steps": steps, "psnr": scores["psnr"], "psnr_srgb": scores["psnr_srgb"]}


def references(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """The same scores of NonLocalMeans, of the shipped weights and, where ``args.pmrid`` is a file, of PMRID's."""
    noise, cfa = noise_model(NOISE), CFA.RGGB
    named = [SHIPPED, *([args.pmrid] if args.pmrid else [])]
    everyone = [RawDenoiser.of(name) for name in ("NonLocalMeans", *named)]
    trials = (make_trial(pair, noise, cfa) for pair in middles(args))
    rows = {}
    for label, scores in group_rows(score(everyone, trials, "references")).items():
        rows[label] = {key: fmean(getattr(row, key) for row in scores) for key in ("psnr", "psnr_srgb")}
    return rows


# -- all of them -------------------------------------------------------------------------------------------------------


def measure(name: str, args: argparse.Namespace) -> dict[str, float]:
    """Of one network."""
    torch.set_num_threads(args.threads)
    size = SIZES[name] | ({"width": args.width} if args.width else {})
    network = denoisers.build(name, **size)
    network = network.to(args.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    costs = {"parameters": sum(p.numel() for p in network.parameters()), **inference(network.eval(), args)}
    if args.minutes:
        return costs | trained(name, size, args)
    return costs


def main() -> None:
    parser = arguments(__doc__, repeats=5, quick="one repeat")
    parser.add_argument("--networks", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--width", type=int, help="features, in place of the table's")
    parser.add_argument("--minutes", type=float, default=0.0, help="train each for so long, and score it")
    parser.add_argument("--precision", default="32-true", help="of --minutes, such as bf16-mixed")
    parser.add_argument("--pictures", default="demo:", help="sRGB pictures of --minutes")
    parser.add_argument("--validation", default="demo:validation", help="frames of --minutes")
    parser.add_argument("--bin", type=int, default=1, help="bins these K x K by colour site: clean references")
    parser.add_argument("--pmrid", help="file of PMRID's published weights, to be scored beside --minutes")
    parser.add_argument("--batch", type=int, default=16, help="crops in a step of --minutes")
    parser.add_argument("--crop", type=int, default=128, help="side of these sRGB crops")
    args = parser.parse_args()
    args.repeats = 1 if args.quick else args.repeats
    figures = start(args)
    for name in args.networks:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as own:
            figures[name] = own.submit(measure, name, args).result()
        show({name: figures[name]}, width=6)
    if args.minutes:
        figures["references"] = references(args)
        show(figures["references"])
    finish(figures, args)


if __name__ == "__main__":
    main()
