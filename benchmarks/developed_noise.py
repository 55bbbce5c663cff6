"""Noise of developed pictures: how it is correlated, how it grows with light, and what demosaicing alone changes.

    python -m benchmarks.developed_noise RAW_FILE [--figure docs/developed_noise.png]

The same law var = shot_var y + read_var goes two ways. The RAW frame with this noise is developed by LibRaw (AHD, the
camera's white balance, BT.709), and LibRaw's picture of the clean frame goes through pairs of ``target="srgb"``, eight
draws for each demosaicing. Noise is the noisy picture minus the clean one, of the green channel, in the frame's middle:
left its autocorrelation along rows, after division by its deviation at each brightness, right this deviation.

Printed are dB on the demo photographs, as they are and enlarged twofold: developed clean RAW against the picture it was
made from, which is the error of demosaicing, and noisy against clean.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.measure import parser
from rawaug import bayer
from rawaug.data.demo import demo_photographs
from rawaug.data.pairs import centre
from rawaug.io import RawFrame, read_raw, write_dng
from rawaug.io.raw import develop
from rawaug.metrics import psnr
from rawaug.noise import noise_model
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.crops import enlarge
from rawaug.plugin.draw import Draw
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Srgb

LEVELS = (2e-3, 1e-5)
SIDE, LAGS, BINS, DRAWS = 1024, 7, 20, 8
FEWEST = 1000
"""Pixels of a brightness."""


def spread(clean: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """The middles of bins of brightness in [0, 1], and the noise's deviation there; NaN where there are few pixels."""
    where = (clean.flatten() * BINS).long().clamp_max(BINS - 1)
    count = torch.bincount(where, minlength=BINS)
    square = torch.bincount(where, noise.flatten().square().double(), minlength=BINS) / count
    return (torch.arange(BINS) + 0.5) / BINS, torch.where(count >= FEWEST, square.sqrt(), torch.nan)


def correlation(clean: Tensor, noise: Tensor) -> Tensor:
    """Autocorrelation ``(LAGS,)`` along the rows of noise ``(H, W)`` over its deviation, away from black and white."""
    deviation = spread(clean, noise)[1].float()[(clean * BINS).long().clamp_max(BINS - 1)]
    scaled = noise / deviation
    seen = (clean > 0.05) & (clean < 0.9) & scaled.isfinite()
    scaled = torch.where(seen, scaled, 0.0)
    products = [(scaled[:, lag:] * scaled[:, : scaled.shape[1] - lag]) for lag in range(LAGS)]
    pairs = [(seen[:, lag:] & seen[:, : seen.shape[1] - lag]).sum() for lag in range(LAGS)]
    by_lag = torch.stack([product.sum() / number for product, number in zip(products, pairs, strict=True)])
    return by_lag / by_lag[0]


def by_libraw(frame: RawFrame, noisy: Tensor) -> tuple[Tensor, Tensor]:
    """Noisy and clean mosaics of the frame as LibRaw develops them, ``(3, H, W)`` in [0, 1]."""
    black = (0.1 * frame.white,) * 4  # so that noise is not clipped at black
    shown = []
    with tempfile.TemporaryDirectory() as folder:
        for mosaic in (noisy, frame.mosaic):
            write_dng(Path(folder) / "frame.dng", replace(frame, mosaic=mosaic.clamp(-0.1, 1.0), black=black))
            shown.append(develop(Path(folder) / "frame.dng") / 255.0)
    return shown[0], shown[1]


def curves(path: Path) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """(clean, noise) of the green channel, by how it was developed."""
    whole = read_raw(path)
    mosaic = centre(whole.mosaic, SIDE, SIDE)
    frame = replace(whole, mosaic=mosaic, gain_maps=(), noise_profile=None)  # LibRaw applies no maps of the lens
    model, packed = noise_model(LEVELS), bayer.pack(frame.mosaic[None], frame.cfa)
    noisy_raw = bayer.unpack(model.apply(packed, model.sample(1, torch.Generator().manual_seed(0))), frame.cfa)[0]
    noisy, clean = by_libraw(frame, noisy_raw)
    found = {"RAW": [(frame.mosaic[0], (noisy_raw - frame.mosaic)[0])], "LibRaw": [(clean[1], (noisy - clean)[1])]}
    for method in bayer.METHODS:
        augment = RawAugment.from_pretrained(
            "universal", LEVELS, target=Srgb(demosaicing=method), draw=Draw(exposure=0.0)
        )
        pairs = [augment(clean, torch.Generator().manual_seed(k)) for k in range(DRAWS)]
        found[f"rawaug, {method}"] = [(pair.clean[1], (pair.noisy - pair.clean)[1]) for pair in pairs]
    return found


def draw(found: dict[str, list[tuple[Tensor, Tensor]]], path: Path) -> None:
    """The figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.8, 3.1), layout="constrained")
    near, bright = figure.subplots(1, 2)
    for (name, seen), colour in zip(found.items(), ("0.6", "black", "C0", "C1", "C2", "C3"), strict=True):
        correlations = torch.stack([correlation(*one) for one in seen])
        near.plot(range(LAGS), correlations.mean(0), "o-", color=colour, markersize=3, label=name)
        if name != "RAW":
            for number, one in enumerate(seen):
                middles, deviation = spread(*one)
                style = {"linewidth": 2.0} if len(seen) == 1 else {"linewidth": 0.8, "alpha": 0.8}
                bright.plot(255 * middles, 255 * deviation, color=colour, label=None if number else name, **style)
    near.set(xlabel="distance along the row (pixels)", ylabel="autocorrelation of the noise")
    bright.set(xlabel="brightness (8 bits)", ylabel="deviation of the noise (8 bits)", ylim=(0, None))
    for axis in (near, bright):
        axis.grid(color="0.92")
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=90)


def differences(pictures: Sequence[Tensor], method: str) -> list[float]:
    """Mean dB over uint8 pictures: developed clean RAW against the picture, and noisy against clean."""
    augment = RawAugment.from_pretrained("universal", target=Srgb(demosaicing=method), draw=Draw(exposure=(-0.5, 0.0)))
    rows = []
    for number, picture in enumerate(pictures):
        pair = augment(trim_to_even(picture), torch.Generator().manual_seed(number))
        truth = trim_to_even(picture)[None] / 255.0
        rows.append([psnr(pair.clean[None], truth).item(), psnr(pair.noisy[None], pair.clean[None]).item()])
    return torch.tensor(rows).mean(0).tolist()


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("frame", type=Path, help="a RAW file with little noise")
    cli.add_argument("--figure", type=Path, default=None, help="draw to this file")
    options = cli.parse_args()
    found = curves(options.frame)
    for name, seen in found.items():
        by_lag = torch.stack([correlation(*one) for one in seen]).mean(0)
        print(f"{name:20}", *(f"{value:6.2f}" for value in by_lag.tolist()))
    sharp = list(demo_photographs("test").values())
    large = [enlarge(p, (2 * p.shape[-2], 2 * p.shape[-1])) for p in sharp]
    for method in bayer.METHODS:
        for name, pictures in (("as they are", sharp), ("enlarged", large)):
            demosaicing, noise = differences(pictures, method)
            print(f"{method}, {name}: demosaicing {demosaicing:.1f} dB, noise of cycleisp_sidd {noise:.1f} dB")
    if options.figure:
        draw(found, options.figure)


if __name__ == "__main__":
    main()
