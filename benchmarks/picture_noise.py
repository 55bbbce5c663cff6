r"""Noise of developed pictures, real beside drawn: its correlation, its spectrum, and where in the picture it is.

    python -m benchmarks.picture_noise cc15:DIR --pictures PHOTOS [--figure docs/picture_noise.png]

Noise is the noisy picture less the clean one, in middles of 256 x 256. Printed are, as means over the pictures, the
autocorrelation along rows and columns at 1 to 4 pixels, of G, R and B; the correlation of R-G, R-B and G-B; the power
of luma around .03, .06, .125, .25 and .5 cycles a pixel, the fourth being 1; and as medians the variance of luma noise
in the tenth of the pixels with the strongest gradients over that in the weaker half, and its kurtosis. The drawn pairs
are crops of PHOTOS, enlarged 1.5 to 4.5 times as pictures at 100 % are soft, whose noise is as strong as the real one.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.measure import parser
from rawaug.data import open_pictures
from rawaug.data.pairs import centre
from rawaug.data.picture_pairs import open_picture_pairs
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.crops import enlarge
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.pictures import trim_to_even
from rawaug.plugin.targets import Srgb

SIDE, LAGS = 256, 4
BANDS = ((0.02, 0.04), (0.05, 0.08), (0.11, 0.14), (0.22, 0.28), (0.45, 0.5))
"""Cycles a pixel."""
STRENGTHS = (29.0, 39.0)
"""PSNR of the noisy pictures that are drawn, in dB."""
ENLARGED = (1.5, 3.0)
NAMES = [*(f"{c}{k}" for c in "GRB" for k in range(1, LAGS + 1)), "R-G", "R-B", "G-B"]
NAMES += [".03", ".06", ".125", ".25", ".5", "edges", "kurtosis"]
_LUMA = torch.tensor([0.299, 0.587, 0.114])

Pictures = tuple[Tensor, Tensor]
"""Noisy and clean sRGB ``(3, H, W)`` in [0, 1]."""


def statistics(noisy: Tensor, clean: Tensor) -> list[float]:
    """The numbers of :data:`NAMES` of a noisy and a clean picture ``(3, H, W)``."""
    noise = noisy - clean
    noise = noise - noise.mean((1, 2), keepdim=True)
    luma, light = (torch.einsum("c,chw->hw", _LUMA, x) for x in (noise, clean))
    found = [value for channel in (1, 0, 2) for value in autocorrelation(noise[channel])]
    between = torch.corrcoef(noise.flatten(1))
    found += [between[0, 1].item(), between[0, 2].item(), between[1, 2].item()]
    power = spectrum(luma)
    return [*found, *(value / power[3] for value in power), *place(luma, light)]


def autocorrelation(noise: Tensor) -> list[float]:
    """Of ``(H, W)`` at 1 to :data:`LAGS` pixels, along rows and columns."""
    shifted = [(noise[:, k:] * noise[:, :-k]).mean() + (noise[k:] * noise[:-k]).mean() for k in range(1, LAGS + 1)]
    return [(product / (2.0 * noise.square().mean())).item() for product in shifted]


def spectrum(luma: Tensor) -> list[float]:
    """Mean power of ``(H, W)`` in each of :data:`BANDS`."""
    window = torch.outer(*(torch.hann_window(side) for side in luma.shape))
    power = torch.fft.rfft2((luma - luma.mean()) * window).abs().square()
    height, width = luma.shape
    radius = (torch.fft.fftfreq(height)[:, None].square() + torch.fft.rfftfreq(width).square()).sqrt()
    return [power[(radius >= low) & (radius < high)].mean().item() for low, high in BANDS]


def place(luma: Tensor, light: Tensor) -> list[float]:
    """Variance of noise at edges of ``light`` over that where it is flat, and the noise's kurtosis."""
    smooth = F.avg_pool2d(light[None, None], 3, 1)[0, 0]
    slope = (smooth[2:, 1:-1] - smooth[:-2, 1:-1]).square() + (smooth[1:-1, 2:] - smooth[1:-1, :-2]).square()
    inner = luma[2:-2, 2:-2].flatten()
    order = slope.flatten().argsort()
    flat, edges = inner[order[: len(order) // 2]], inner[order[-(len(order) // 10) :]]
    return [(edges.var() / flat.var()).item(), (inner.pow(4).mean() / inner.var().square()).item()]


def real(spec: str) -> Iterator[Pictures]:
    """The middles of real pairs, see :func:`rawaug.data.picture_pairs.open_picture_pairs`."""
    for pair in open_picture_pairs(spec):
        noisy, clean = (centre(x, SIDE, SIDE) / 255.0 for x in (pair.noisy, pair.clean))
        yield noisy, clean


def drawn(pictures: Sequence[Tensor], finish: bool, noise: Sequence[str], seed: int) -> Iterator[Pictures]:
    """Pairs of ``target="srgb"`` of the strengths of :data:`STRENGTHS`."""
    augment = RawAugment.from_pretrained("universal", noise=noise, target=Srgb(finish=finish))
    scales = [ENLARGED[0] + (ENLARGED[1] - ENLARGED[0]) * (k % 10) / 9 for k in range(len(pictures))]
    larger = [enlarge(p, [round(s * side) for side in p.shape[1:]]) for p, s in zip(pictures, scales, strict=True)]  # type: ignore[arg-type]
    pairs = RawPairs([trim_to_even(picture) for picture in larger], augment, SIDE, seed=seed)
    for epoch in range(1000):
        pairs.set_epoch(epoch)
        for index in range(len(pairs)):
            pair = pairs[index]
            strength = -10.0 * math.log10((pair.noisy - pair.clean).square().mean().item() + 1e-12)
            if STRENGTHS[0] < strength < STRENGTHS[1]:
                yield pair.noisy, pair.clean


def summed_up(pictures: Iterator[Pictures]) -> Tensor:
    """The means of the statistics, of the last two the medians."""
    rows = torch.tensor([statistics(*one) for one in pictures])
    return torch.cat([rows[:, :-2].mean(0), rows[:, -2:].median(0).values])


def draw(table: dict[str, Tensor], path: Path) -> None:
    """The figure: autocorrelation of R and G, and power by band."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    axes = figure.subplots(1, 3)
    for (name, values), colour in zip(table.items(), ("black", "C0", "C1"), strict=True):
        axes[0].plot(range(LAGS + 1), [1.0, *values[:LAGS]], "o-", color=colour, markersize=3, label=name)
        axes[1].plot(range(LAGS + 1), [1.0, *values[LAGS : 2 * LAGS]], "o-", color=colour, markersize=3)
        axes[2].loglog([0.03, 0.06, 0.125, 0.25, 0.5], values[15:20], "o-", color=colour, markersize=3)
    axes[0].set(xlabel="distance (pixels)", ylabel="autocorrelation of G")
    axes[1].set(xlabel="distance (pixels)", ylabel="autocorrelation of R")
    axes[2].set(xlabel="cycles a pixel", ylabel="power of luma, 1 at .25")
    axes[2].set_xticks([0.03, 0.06, 0.125, 0.25, 0.5], [".03", ".06", ".125", ".25", ".5"], minor=False)
    axes[2].minorticks_off()
    axes[0].legend(fontsize=7)
    for axis in axes:
        axis.grid(color="0.92")
    figure.savefig(path, dpi=90)


def main() -> None:
    cli = parser(__doc__)
    cli.add_argument("pairs", help="real pairs, as cc15:DIR")
    cli.add_argument("--pictures", default="demo:", help="photographs without noise to draw from")
    cli.add_argument("--count", type=int, default=40, help="drawn pairs")
    cli.add_argument("--seed", type=int, default=0)
    cli.add_argument("--figure", type=Path, default=None, help="draw to this file")
    options = cli.parse_args()
    source = open_pictures(options.pictures, min_side=SIDE)
    pictures = [source[index] for index in range(0, len(source), max(1, len(source) // options.count))]
    table = {"real": summed_up(real(options.pairs))}
    for name, finish in (("drawn, no finishing", False), ("drawn", True)):
        pairs = drawn(pictures, finish, ["any camera", "cycleisp_sidd"], options.seed)
        table[name] = summed_up(islice(pairs, options.count))
    print(f"{'':20}", *(f"{name:>5}" for name in NAMES))
    for name, values in table.items():
        print(f"{name:20}", *(f"{value:5.2f}" for value in values.tolist()))
    off = ((table["drawn"] / table["real"]).log().abs() > math.log(1.2)).tolist()
    print("drawn is more than 20 % off at:", ", ".join(n for n, wrong in zip(NAMES, off, strict=True) if wrong) or "-")
    if options.figure:
        draw(table, options.figure)


if __name__ == "__main__":
    main()
