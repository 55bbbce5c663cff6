"""What noise costs: the time of ``apply`` as a ratio to that of the random numbers alone.

    python benchmarks/noise.py [--json FILE] [--threads N] [--device cpu|cuda] [--quick]

The random numbers alone are, for each picture, one ``normal_`` from a generator of its own; for exact photon
statistics, ``torch.poisson`` of the same rates and one ``normal_``. All are timed in turn, and the fastest run of each
counts. Below 1 are the compiled loops of the Gaussian on a CPU: they draw faster than ``normal_`` does.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch

from rawaug.noise import EldNoise, NoiseModel, Params, SensorNoise, noise_levels, noise_model
from rawaug.seeding import keyed_generator

SHAPES = [(16, 4, 32, 32), (16, 4, 64, 64), (16, 4, 128, 128), (4, 4, 512, 512), (1, 4, 1500, 2000)]


def models() -> dict[str, NoiseModel]:
    sidd = noise_levels("cycleisp_sidd")
    return {
        "gaussian": noise_model("cycleisp_sidd"),
        "poisson": noise_model("cycleisp_sidd", poisson=True),
        "gaussian, rows, 12 bits": SensorNoise(sidd, row_var=1e-6, bits=12),
        "eld": EldNoise("SonyA7S2"),
    }


def random_numbers(clean: torch.Tensor, params: Params, poisson: bool) -> None:
    """What no implementation of the noise could do without."""
    noise = torch.empty_like(clean)
    for seed, picture in zip(params["seed"].tolist(), noise, strict=True):
        picture.normal_(generator=keyed_generator(seed, "benchmark", device=clean.device))
    if poisson:
        rates = clean / params["shot_var"].to(clean).reshape(-1, 1, 1, 1)
        for seed, picture in zip(params["seed"].tolist(), rates, strict=True):
            torch.poisson(picture, generator=keyed_generator(seed, "benchmark", device=clean.device))


def fastest(runs: list[Callable[[], object]], repeats: int, device: torch.device) -> list[float]:
    """The least seconds of each, timed in turn."""
    best = [float("inf")] * len(runs)
    for _ in range(repeats):
        for index, run in enumerate(runs):
            start = time.perf_counter()
            run()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            best[index] = min(best[index], time.perf_counter() - start)
    return best


def measure(shape: tuple[int, ...], repeats: int, device: torch.device) -> dict[str, float]:
    """Ratios by model, and the nanoseconds that a normal number takes."""
    clean = torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(device) * 0.8
    ratios, nanoseconds = {}, 0.0
    for name, model in models().items():
        params = model.sample(len(clean), torch.Generator().manual_seed(1))
        alone = partial(random_numbers, clean, params, name in ("poisson", "eld"))
        least, seconds = fastest([alone, partial(model.apply, clean, params)], repeats, device)
        ratios[name] = seconds / least
        if name == "gaussian":
            nanoseconds = 1e9 * least / clean.numel()
    return ratios | {"ns a normal number": nanoseconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the ratios to this file")
    parser.add_argument("--threads", type=int, default=1, help="as in a DataLoader's worker")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--quick", action="store_true", help="two repeats")
    args = parser.parse_args()
    args.repeats = 2 if args.quick else args.repeats
    torch.set_num_threads(args.threads)
    name = torch.cuda.get_device_name(args.device) if args.device.type == "cuda" else platform.processor()
    machine = f"{name or platform.machine()}, {args.threads} threads, torch {torch.__version__}"
    print(f"time of apply / time of the random numbers alone ({machine})")
    results = {}
    for shape in SHAPES:
        results["x".join(map(str, shape))] = row = measure(shape, args.repeats, args.device)
        print("  " + "x".join(map(str, shape)).ljust(16), "  ".join(f"{key} {value:.2f}" for key, value in row.items()))
    if args.json:
        args.json.write_text(json.dumps({"machine": machine, "ratios": results}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
