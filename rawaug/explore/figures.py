"""Figures of one pair: histograms of RAW, the drawn tone curve and matrix over the ISP's atoms, noise and its law."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.errors import extra
from rawaug.io import encode_srgb
from rawaug.isp.config import ISPParams
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import STEPS
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.params import RawPair


class Example(NamedTuple):
    """A picture, uint8 ``(3, H, W)``, its augmentation, and one pair of it, without B."""

    srgb: Tensor
    augment: RawAugment
    pair: RawPair


COLOURS = {"R": "tab:red", "G": "tab:green", "B": "tab:blue"}
_ATOMS = 60  # colour atoms drawn, at most
_BINS = 24
_MOST = 2**16  # values of a colour
_FEWEST = 50  # values in a bin of the signal, for its variance to mean something


def histograms(drawn: Example) -> np.ndarray:
    """Plot how often RAW has each value, by colour: clean as a line, noisy as an area; uint8 ``(H, W, 3)``."""
    figure, axis = _figure()
    clean, noisy = (_by_colour(drawn, raw) for raw in (drawn.pair.clean, drawn.pair.noisy))
    edges = torch.linspace(-0.05, 1.0, 106)
    for (name, colour), a, b in zip(COLOURS.items(), clean, noisy, strict=True):
        for values, style in ((b, {"fill": True, "alpha": 0.25, "linewidth": 0}), (a, {"linewidth": 1.2})):
            share = torch.histc(values, len(edges) - 1, -0.05, 1.0) / values.numel()
            axis.stairs(share.numpy(), edges.numpy(), color=colour, **style)
        axis.plot([], [], color=colour, label=name)
    axis.set(xlabel="RAW value, black 0, white 1", xlim=(-0.05, 1.0))
    axis.set(ylabel="share of values", yscale="log", ylim=(1e-6, 1))
    _plain_numbers(axis, axis.yaxis)
    axis.legend(title="line: clean, area: noisy", fontsize=8, title_fontsize=8, ncols=3)
    return _pixels(figure)


def tone_curve(drawn: Example) -> np.ndarray:
    """Plot the drawn tone curve over those of the ISP."""
    figure, tone = _figure()
    isp, setting = drawn.augment.isp, drawn.pair.params.isp
    code = np.arange(256)
    if isp.tone is not None:
        tone.plot(code, isp.tone.curves[:, ::STEPS].T.numpy(), color="0.8", linewidth=0.8)
    tone.plot(code, grey_curve(isp, setting).numpy(), color="tab:blue", linewidth=2)
    title = "learned tone curve" if isp.tone is None else f"tone curve over {len(isp.tone.curves)} atoms"
    tone.set(xlabel="sRGB grey", ylabel="linear", title=title)
    return _pixels(figure)


def colours(drawn: Example) -> np.ndarray:
    """Plot what the drawn matrix makes of colours, over what the colour atoms make of them."""
    figure, colour = _figure()
    isp, setting = drawn.augment.isp, drawn.pair.params.isp
    atoms = isp.colour.atoms()
    patches = torch.cat([torch.eye(3), torch.tensor([[0.6, 0.35, 0.25], [0.25, 0.45, 0.65]])])
    for matrices, size, alpha, edge in ((atoms[:_ATOMS], 12, 0.35, "none"), (setting.matrix[None], 110, 1.0, "black")):
        seen = (patches @ matrices.mT).flatten(0, 1)
        share = seen / seen.sum(dim=1, keepdim=True)
        shown = encode_srgb(patches.repeat(len(matrices), 1)).numpy()
        colour.scatter(share[:, 0], share[:, 1], s=size, c=shown, alpha=alpha, edgecolors=edge)
    colour.set(xlabel="R / (R + G + B)", ylabel="G / (R + G + B)")
    count = f"{_ATOMS} of {len(atoms)}" if len(atoms) > _ATOMS else str(len(atoms))
    colour.set(title=f"colours in the camera over {count} atoms")
    return _pixels(figure)


def noise(drawn: Example) -> np.ndarray:
    """Plot the variance of noisy minus clean against the clean signal, by colour, and its law, on logarithmic axes."""
    pair = drawn.pair
    ramp = torch.logspace(-4, 0, 100)
    params = {name: value[None] for name, value in pair.params.noise.items()}
    law = drawn.augment.noise.variance(ramp.expand(1, 4, 1, -1), params).mean(dim=(0, 1, 2))
    layout = CFA(drawn.augment.cfa) if drawn.augment.pattern is None else CFA.RGGB  # noise models take four planes
    clean = bayer.pack(drawn.augment.mosaic(pair.clean)[None], layout)
    expected = bayer.unpack(drawn.augment.noise.variance(clean, params)[0], layout)
    sites = (_by_colour(drawn, raw) for raw in (pair.clean, pair.noisy, expected))
    measured = [variance_by_signal(*values) for values in zip(*sites, strict=True)]
    figure, axis = _figure()
    for (name, colour), (signal, variance) in zip(COLOURS.items(), measured, strict=True):
        axis.scatter(signal, variance, s=14, color=colour, label=f"{name}, measured")
    axis.plot(ramp, law, color="black", linewidth=1.2, label="law")
    axis.set(xscale="log", yscale="log", xlabel="clean signal", ylabel="variance of the noise")
    _plain_numbers(axis, axis.xaxis, axis.yaxis)
    highest = max([float(law[-1]), *(float(variance.max()) for _, variance in measured if len(variance))])
    axis.set(xlim=(1e-4, 1), ylim=(float(law[0]) / 3, 3 * highest))
    axis.legend(fontsize=8)
    return _pixels(figure)


def variance_by_signal(clean: Tensor, noisy: Tensor, expected: Tensor) -> tuple[Tensor, Tensor]:
    """Mean signal and mean square of the noise in logarithmic bins of the signal.

    Args:
        clean: values ``(N,)``.
        noisy: values ``(N,)`` of the same sites.
        expected: variance ``(N,)`` by the law, by which sites that could saturate are left out.

    Returns:
        Mean and variance, each ``(K,)``, of the K bins that have enough values.
    """
    seen = (clean > 1e-4) & (clean + 3.0 * expected.sqrt() < 1.0)
    signal, square = clean[seen], (noisy[seen] - clean[seen]).square()
    where = ((signal.log10() + 4) * (_BINS / 4)).long().clamp(0, _BINS - 1)
    count = torch.bincount(where, minlength=_BINS)
    sums = [torch.bincount(where, values.double(), minlength=_BINS) for values in (signal, square)]
    enough = count >= _FEWEST
    mean, variance = (total[enough] / count[enough] for total in sums)
    return mean, variance


def _by_colour(drawn: Example, raw: Tensor) -> list[Tensor]:
    """The values of the red, green and blue sites, ``(N,)`` each; of many, evenly spaced ones."""
    mosaic = raw if len(raw) == 1 else drawn.augment.mosaic(raw)
    values = [mosaic[0][plane > 0] for plane in bayer.pattern(drawn.augment.cfa).planes(*mosaic.shape[-2:])]
    return [of_colour[:: max(1, -(-len(of_colour) // _MOST))] for of_colour in values]


def _figure() -> tuple[Any, Any]:
    with extra("train"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

    figure = Figure(figsize=(4.0, 3.1), dpi=140)
    FigureCanvasAgg(figure)
    axis = figure.subplots()
    figure.subplots_adjust(left=0.2, right=0.97, bottom=0.16, top=0.9)
    axis.grid(color="0.92")
    axis.set_axisbelow(True)
    axis.title.set_fontsize(10)
    return figure, axis


def _plain_numbers(axis: Any, *scales: Any) -> None:
    """Label powers of ten as 0.01, without ticks between: typeset labels take longer than the rest of the figure."""
    axis.minorticks_off()
    for scale in scales:
        scale.set_major_formatter("{x:g}")


def _pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())[..., :3]


@torch.no_grad()
def grey_curve(isp: DictionaryISP, setting: ISPParams) -> Tensor:
    """Linear values ``(256,)`` of the 256 greys of sRGB under a setting without B."""
    if isp.tone is None:
        return isp.tone_curve().mean(dim=1)
    return isp.tone.combine(setting.tone_weights[None])[0, ::STEPS]
