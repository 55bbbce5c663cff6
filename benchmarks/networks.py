"""What training a network costs, with and without augmentation, and what its self-ensemble costs.

    python -m benchmarks.networks [--networks UNet DHDN DnCNN] [--width 16] [--batch 16] [--crop 128] [--quick]
    python -m benchmarks.networks --device cuda --width 128 --networks DHDN --crop 256     (bf16)

A training step is forward, backward and Adam on a batch of packed RAW pairs. Without augmentation the batch is ready;
with it, RawAugment makes it of sRGB first. Each network runs in its own process, whose peak memory is reported; steps
are timed in turn, and the fastest counts.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import resource
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch

import denoisers
import rawaug
from benchmarks.loader import fastest


def measure(name: str, args: argparse.Namespace) -> dict[str, float]:
    """Of one network."""
    torch.set_num_threads(args.threads)
    network = getattr(denoisers, name)(width=args.width).to(args.device, memory_format=torch.channels_last)
    optimizer = torch.optim.Adam(network.parameters())
    augment = rawaug.RawAugment.from_pretrained("universal").to(args.device)
    shape = (args.batch, 3, args.crop, args.crop)
    srgb = torch.randint(256, shape, generator=torch.Generator().manual_seed(0), dtype=torch.uint8).to(args.device)
    ready = augment(srgb)

    def step(pair: rawaug.RawPair) -> None:
        optimizer.zero_grad()
        with torch.autocast(args.device.type, torch.bfloat16, enabled=args.device.type == "cuda"):
            loss = torch.nn.functional.l1_loss(network(pair.noisy, pair.variance), pair.clean)
        loss.backward()
        optimizer.step()

    step(ready)  # memory is found, kernels are chosen
    steps = fastest({"ready": lambda: step(ready), "made": lambda: step(augment(srgb))}, args.repeats, args.device)
    one = {"noisy": ready.noisy[:1], "variance": ready.variance[:1]}
    views = denoisers.SelfEnsemble(network.eval(), augment.isp.cfa, views=8)
    with torch.no_grad():
        runs = {"one": lambda: network(**one), "eight": lambda: views(**one)}
        views(**one)
        ensemble = fastest(runs, 3 * args.repeats, args.device)
    if args.device.type == "cuda":
        peak = torch.cuda.max_memory_allocated(args.device) / 2**20
    else:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "parameters": sum(p.numel() for p in network.parameters()),
        "images/s": args.batch / steps["ready"],
        "images/s, augmented": args.batch / steps["made"],
        "share of augmentation": 1 - steps["ready"] / steps["made"],
        "peak MiB": peak,
        "8 views / 1": ensemble["eight"] / ensemble["one"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", nargs="+", default=["UNet", "DHDN", "DnCNN"])
    parser.add_argument("--width", type=int, default=16, help="features; published: U-Net 32, DHDN 128, DnCNN 64")
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--crop", type=int, default=128, help="side of the sRGB crops")
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    parser.add_argument("--quick", action="store_true", help="one repeat, batches of 4")
    args = parser.parse_args()
    if args.quick:
        args.batch, args.repeats = 4, 1
    shape = f"{args.batch} x {args.crop} x {args.crop}"
    print(f"batches of {shape}, width {args.width} ({args.device}, {args.threads} threads, torch {torch.__version__})")
    figures = {}
    for name in args.networks:
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as own:
            figures[name] = own.submit(measure, name, args).result()
        print(f"  {name:6s}", "  ".join(f"{what} {value:.4g}" for what, value in figures[name].items()))
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1) + "\n")


if __name__ == "__main__":
    main()
