"""What a network costs: parameters, GMAC and seconds a mosaic megapixel, training steps, and PSNR for equal minutes.

    python -m benchmarks.networks [--networks UNet PMRID] [--batch 16] [--crop 128] [--quick]
    python -m benchmarks.networks --device cuda --crop 256 --workers 8 --compile default reduce-overhead
    python -m benchmarks.networks --minutes 20 --pictures PHOTOS --validation RAW_DIR --figure OUT.png      two hours

A training step is forward, backward and Adam on a batch of packed RAW pairs. Without augmentation the batch is ready;
with it, RawAugment makes it of sRGB first; with ``--workers``, RawPairs makes it in the workers of a loader. On a GPU
the networks have the sizes of :data:`GPU_SIZES` and train in bf16. ``--compile`` times the steps once more under
torch.compile in each of the modes, of which reduce-overhead uses CUDA graphs. Each network runs in a process of its
own, whose peak memory in training is reported; steps are timed in turn, and the fastest counts. With ``--minutes``
each network, in the form of :data:`SIZES`, is trained for the same time on RAW of published cameras with :data:`NOISE`
and scored on the validation frames, beside NonLocalMeans, ``rawaug-small`` and, with ``--pmrid FILE``, PMRID's
published weights.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader
from torch.utils.flop_counter import FlopCounterMode

import denoisers
import rawaug
from benchmarks.measure import arguments, fastest, finish, memory_used, show, start
from rawaug.bayer import CFA
from rawaug.data import open_pairs, open_pictures
from rawaug.data.folders import Cached
from rawaug.data.pairs import Pair
from rawaug.denoise.denoiser import RawDenoiser
from rawaug.evaluation.scores import group_rows, score
from rawaug.evaluation.trials import trial_of
from rawaug.noise import noise_model
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.loop import train, validate
from rawaug.training.stream import PictureCrops, TrainingStream

SIZES: dict[str, dict[str, Any]] = {
    "UNet": {"width": 16, "scales": 4},
    "DHDN": {"width": 16},
    "DnCNN": {"width": 32, "depth": 12},
    "PMRID": {"variance_map": True},
    "NAFNet": {"width": 16, "encoder": [1, 1, 2], "middle": 4, "decoder": [1, 1, 1]},
    "DRUNet": {"width": 32, "blocks": 1, "limits": True, "variance_map": False, "domain": "anscombe"},
}
"""The networks in sizes for a CPU."""
GPU_SIZES: dict[str, dict[str, Any]] = {
    "UNet": {"width": 32},
    "DHDN": {"width": 128},
    "DnCNN": {"width": 64, "depth": 17},
    "PMRID": {"variance_map": True},
    "NAFNet": {},
    "DRUNet": {},
}
"""The networks in their published sizes, the U-Net's included."""

SIDE = 512
"""Packed pixels on the side of the picture that inference is timed on, a mosaic megapixel."""


def inference(network: denoisers.Denoiser, args: argparse.Namespace) -> dict[str, float]:
    """GMAC and seconds a mosaic megapixel; on a CPU on one and on two threads."""
    noisy = torch.rand(1, 4, args.side, args.side, device=args.device)
    inputs = [x.contiguous(memory_format=torch.channels_last) for x in (noisy, 1e-3 * noisy + 1e-5)]
    megapixels, figures = 4 * args.side**2 / 1e6, dict[str, float]()
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


Step = Callable[[rawaug.RawPair], None]


def step_of(network: Any, optimizer: torch.optim.Optimizer, device: torch.device) -> Step:
    """Forward, backward and Adam, in bf16 on a GPU."""

    def step(pair: rawaug.RawPair) -> None:
        optimizer.zero_grad()
        with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
            loss = torch.nn.functional.l1_loss(network(pair.noisy, pair.variance), pair.clean)
        loss.backward()
        optimizer.step()

    return step


def in_workers(step: Step, srgb: Tensor, args: argparse.Namespace) -> float:
    """Seconds a step in the middle of a pass whose pairs are made in workers and copied to the device."""
    first, timed = 1 + 2 * args.workers, 4 * args.repeats
    pairs = rawaug.RawPairs(list(srgb.cpu()) * (first + timed), "universal", crop=args.crop)
    pinned = args.device.type == "cuda"
    loader = DataLoader(pairs, args.batch, num_workers=args.workers, pin_memory=pinned)
    start = 0.0
    for number, pair in enumerate(loader):
        if number == first:  # the workers have started, and what they had fetched ahead is used up
            start = clock(args.device)
        step(pair.map(lambda tensor: tensor.to(args.device, non_blocking=True)))
    return (clock(args.device) - start) / timed


def clock(device: torch.device) -> float:
    """Seconds, once the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def training(network: denoisers.Denoiser, args: argparse.Namespace) -> dict[str, float]:
    """Images a second without and with augmentation, under every mode of ``args.compile`` too, and peak memory."""
    augment = rawaug.RawAugment.from_pretrained("universal").to(args.device)
    shape = (args.batch, 3, args.crop, args.crop)
    srgb = torch.randint(256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8).to(args.device)
    ready, optimizer = augment(srgb), torch.optim.Adam(network.parameters())
    figures = dict[str, float]()
    for mode in (None, *args.compile):
        model = network if mode is None else torch.compile(network, mode=mode)
        step, label = step_of(model, optimizer, args.device), "" if mode is None else f", {mode}"
        step(ready)  # memory is found, kernels are chosen
        if args.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(args.device)
        runs = {"ready": lambda step=step: step(ready), "made": lambda step=step: step(augment(srgb))}
        steps = fastest(runs, args.repeats, args.device)
        figures |= {
            f"images/s{label}": args.batch / steps["ready"],
            f"images/s, augmented{label}": args.batch / steps["made"],
            f"share of augmentation{label}": 1 - steps["ready"] / steps["made"],
            f"peak MiB{label}": memory_used(args.device) / 2**20,
        }
    if args.workers:
        step = step_of(network, optimizer, args.device)
        figures["images/s, in workers"] = args.batch / in_workers(step, srgb, args)
    return figures


def ensemble(network: denoisers.Denoiser, args: argparse.Namespace) -> float:
    """The time of eight views over that of one."""
    noisy = torch.rand(1, 4, args.crop // 2, args.crop // 2, device=args.device)
    one = {"noisy": noisy, "variance": 1e-3 * noisy + 1e-5}
    views = denoisers.SelfEnsemble(network, "RGGB", views=8)
    with torch.no_grad():
        views(**one)
        seconds = fastest({"one": lambda: network(**one), "eight": lambda: views(**one)}, 3 * args.repeats, args.device)
    return seconds["eight"] / seconds["one"]


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
    frames = [trial_of(pair, noise, cfa) for pair in middles(args)]
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
    trials = (trial_of(pair, noise, cfa) for pair in middles(args))
    rows = {}
    for label, scores in group_rows(score(everyone, trials, "references")).items():
        rows[label] = {key: fmean(getattr(row, key) for row in scores) for key in ("psnr", "psnr_srgb")}
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


# -- all of them -------------------------------------------------------------------------------------------------------


def measure(name: str, args: argparse.Namespace, size: dict[str, Any] | None = None) -> dict[str, float]:
    """Of one network, in the size of the table if none is given."""
    torch.set_num_threads(args.threads)
    sizes = GPU_SIZES if args.device.type == "cuda" and not args.minutes else SIZES
    size = (sizes[name] if size is None else size) | ({"width": args.width} if args.width else {})
    network = denoisers.build(name, **size)
    network = network.to(args.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    costs = {"parameters": sum(p.numel() for p in network.parameters()), **inference(network.eval(), args)}
    if args.minutes:
        return costs | trained(name, size, args)
    steps = training(network.train(), args)
    return {**costs, **steps, "8 views / 1": ensemble(network.eval(), args)}


def main() -> None:
    parser = arguments(__doc__, repeats=5, quick="one repeat, batches of 4")
    parser.add_argument("--networks", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--width", type=int, help="features, in place of the table's")
    parser.add_argument("--workers", type=int, default=0, help="also make the pairs in so many workers")
    modes = ("default", "reduce-overhead", "max-autotune")
    parser.add_argument("--compile", nargs="*", choices=modes, default=[], help="also train under torch.compile")
    parser.add_argument("--minutes", type=float, default=0.0, help="train each for so long, and score it")
    parser.add_argument("--precision", default="32-true", help="of --minutes, such as bf16-mixed")
    parser.add_argument("--pictures", default="demo:", help="sRGB pictures of --minutes")
    parser.add_argument("--validation", default="demo:validation", help="frames of --minutes")
    parser.add_argument("--bin", type=int, default=1, help="bins these K x K by colour site: clean references")
    parser.add_argument("--pmrid", help="file of PMRID's published weights, to be scored beside --minutes")
    parser.add_argument("--figure", type=Path, help="draw --minutes' PSNR over seconds a megapixel into this PNG")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--crop", type=int, default=128, help="side of the sRGB crops")
    parser.add_argument("--side", type=int, default=SIDE, help="of the packed picture that inference is timed on")
    args = parser.parse_args()
    args.batch, args.repeats = (4, 1) if args.quick else (args.batch, args.repeats)
    figures = start(args)
    print(f"batches of {args.batch} x {args.crop} x {args.crop}")
    for name in args.networks:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as own:
            figures[name] = own.submit(measure, name, args).result()
        show({name: figures[name]}, width=6)
    if args.minutes:
        figures["references"] = references(args)
        show(figures["references"])
        if args.figure:
            chart({name: figures[name] for name in args.networks}, figures["references"], args.figure)
    finish(figures, args)


if __name__ == "__main__":
    main()
