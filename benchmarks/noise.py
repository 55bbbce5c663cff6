"""What noise costs: the time of ``apply`` as a ratio to that of the random numbers alone.

    python -m benchmarks.noise [--json FILE] [--threads N] [--device cpu|cuda] [--quick]

The random numbers alone are, for each picture, one ``normal_`` from a generator of its own; for exact photon
statistics, ``torch.poisson`` of the same rates and one ``normal_``. Below 1 are the compiled loops of the Gaussian on a
CPU: they draw faster than ``normal_`` does.
"""

from __future__ import annotations

from functools import partial

import torch

from benchmarks.measure import arguments, fastest, finish, show, start
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


def measure(shape: tuple[int, ...], repeats: int, device: torch.device) -> dict[str, float]:
    """Ratios by model, and the nanoseconds that a normal number takes."""
    clean = torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(device) * 0.8
    ratios, nanoseconds = {}, 0.0
    for name, model in models().items():
        params = model.sample(len(clean), torch.Generator().manual_seed(1))
        alone = partial(random_numbers, clean, params, name in ("poisson", "eld"))
        taken = fastest({"alone": alone, "apply": partial(model.apply, clean, params)}, repeats, device)
        ratios[name] = taken["apply"] / taken["alone"]
        if name == "gaussian":
            nanoseconds = 1e9 * taken["alone"] / clean.numel()
    return ratios | {"ns a normal number": nanoseconds}


def main() -> None:
    parser = arguments(__doc__, repeats=20, quick="two repeats")
    parser.set_defaults(threads=1)  # as in a DataLoader's worker
    args = parser.parse_args()
    figures = start(args)
    print("time of apply / time of the random numbers alone")
    for shape in SHAPES:
        title = "x".join(map(str, shape))
        figures[title] = measure(shape, 2 if args.quick else args.repeats, args.device)
        show({title: figures[title]}, width=16)
    finish(figures, args)


if __name__ == "__main__":
    main()
