"""Figures of one pair: histograms of RAW, the drawn tone curve and matrix over the ISP's atoms, noise and its law."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.errors import extra
from rawaug.io import encode_srgb
from rawaug.isp.config import ISPParams
from rawaug.isp.description import tone_table
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import STEPS
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.params import RawPair


class Example(NamedTuple):
    """A picture, uint8 ``(3, H, W)``, with its augmentation and one pair made from it, without B."""

    srgb: Tensor
    augment: RawAugment
    pair: RawPair


COLOURS = {"R": "tab:red", "G": "tab:green", "B": "tab:blue"}
"""Plots draw the channels in these colours."""

_ATOMS = 60
"""A plot has at most this many colour atoms."""

_BINS = 24
"""The signal has this many bins."""

_MOST = 2**16
"""At most this many values of a colour are used; of more, evenly spaced ones are taken."""

_FEWEST = 50
"""A variance is estimated from at least this many values in a bin of the signal."""


def histograms(example: Example) -> np.ndarray:
    """Plot how often RAW has each value, by colour, clean as a line and noisy as an area; uint8 ``(H, W, 3)``."""
    figure, axis = _figure()
    clean = _by_colour(example, example.pair.clean)
    noisy = _by_colour(example, example.pair.noisy)
    edges = torch.linspace(-0.05, 1.0, 106)

    def shares(values: Tensor) -> np.ndarray:
        count: np.ndarray = torch.histc(values, len(edges) - 1, -0.05, 1.0).numpy()
        return count / values.numel()

    for (name, colour), clean_values, noisy_values in zip(COLOURS.items(), clean, noisy, strict=True):
        axis.stairs(shares(noisy_values), edges.numpy(), color=colour, fill=True, alpha=0.25, linewidth=0)
        axis.stairs(shares(clean_values), edges.numpy(), color=colour, linewidth=1.2)
        axis.plot([], [], color=colour, label=name)

    axis.set(xlabel="RAW value, black 0, white 1", xlim=(-0.05, 1.0))
    axis.set(ylabel="share of values", yscale="log", ylim=(1e-6, 1))
    _plain_numbers(axis, axis.yaxis)
    axis.legend(title="line: clean, area: noisy", fontsize=8, title_fontsize=8, ncols=3)
    return _pixels(figure)


def tone_curve(example: Example) -> np.ndarray:
    """Plot the drawn tone curve over those of the ISP."""
    figure, tone = _figure()
    isp, setting = example.augment.isp, example.pair.params.isp
    code = np.arange(256)
    title = "learned tone curve"

    if isp.tone is not None:
        tone.plot(code, isp.tone.curves[:, ::STEPS].T.numpy(), color="0.8", linewidth=0.8)
        title = f"tone curve over {len(isp.tone.curves)} atoms"
    tone.plot(code, grey_curve(isp, setting).numpy(), color="tab:blue", linewidth=2)
    tone.set(xlabel="sRGB grey", ylabel="linear", title=title)
    return _pixels(figure)


def colours(example: Example) -> np.ndarray:
    """Plot what the drawn matrix makes of colours, over what the colour atoms make of them."""
    figure, colour = _figure()
    isp, setting = example.augment.isp, example.pair.params.isp
    atoms = isp.colour.atoms()
    patches = torch.cat([torch.eye(3), torch.tensor([[0.6, 0.35, 0.25], [0.25, 0.45, 0.65]])])

    def scatter(matrices: Tensor, **style: Any) -> None:
        """Draw what matrices ``(N, 3, 3)`` make of the patches."""
        in_camera = (patches @ matrices.mT).flatten(0, 1)
        share = in_camera / in_camera.sum(dim=1, keepdim=True)
        srgb = encode_srgb(patches.repeat(len(matrices), 1)).numpy()
        colour.scatter(share[:, 0], share[:, 1], c=srgb, **style)

    scatter(atoms[:_ATOMS], s=12, alpha=0.35, edgecolors="none")
    scatter(setting.matrix[None], s=110, alpha=1.0, edgecolors="black")

    colour.set(xlabel="R / (R + G + B)", ylabel="G / (R + G + B)")
    count = str(len(atoms))
    if len(atoms) > _ATOMS:
        count = f"{_ATOMS} of {len(atoms)}"
    colour.set(title=f"colours in the camera over {count} atoms")
    return _pixels(figure)


def noise(example: Example) -> np.ndarray:
    """Plot the variance of noisy minus clean against the clean signal, by colour, and its law, on logarithmic axes."""
    pair, augment = example.pair, example.augment
    params = {name: value[None] for name, value in pair.params.noise.items()}
    ramp = torch.logspace(-4, 0, 100)
    law = augment.noise.variance(ramp.expand(1, 4, 1, -1), params).mean(dim=(0, 1, 2))

    layout = CFA.RGGB  # also for other patterns, as noise models take four planes
    if augment.pattern is None:
        layout = CFA(augment.cfa)
    mosaic = bayer.pack(augment.mosaic(pair.clean)[None], layout)
    expected = bayer.unpack(augment.noise.variance(mosaic, params)[0], layout)

    figure, axis = _figure()
    highest = float(law[-1])
    sites = zip(
        COLOURS.items(),
        _by_colour(example, pair.clean),
        _by_colour(example, pair.noisy),
        _by_colour(example, expected),
        strict=True,
    )
    for (name, colour), clean_values, noisy_values, expected_values in sites:
        signal, variance = variance_by_signal(clean_values, noisy_values, expected_values)
        axis.scatter(signal, variance, s=14, color=colour, label=f"{name}, measured")
        if len(variance):
            highest = max(highest, float(variance.max()))
    axis.plot(ramp, law, color="black", linewidth=1.2, label="law")

    axis.set(xscale="log", yscale="log", xlabel="clean signal", ylabel="variance of the noise")
    _plain_numbers(axis, axis.xaxis, axis.yaxis)
    axis.set(xlim=(1e-4, 1), ylim=(float(law[0]) / 3, 3 * highest))
    axis.legend(fontsize=8)
    return _pixels(figure)


def variance_by_signal(clean: Tensor, noisy: Tensor, expected: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean signal and the mean square of the noise in logarithmic bins of the signal.

    Args:
        clean: values ``(N,)``.
        noisy: values ``(N,)`` of the same sites.
        expected: variance ``(N,)`` by the law, by which sites that could saturate are left out.

    Returns:
        Mean and variance, each ``(K,)``, of the K bins that have enough values.
    """
    usable = (clean > 1e-4) & (clean + 3.0 * expected.sqrt() < 1.0)
    signal = clean[usable]
    square = (noisy[usable] - signal).square()

    bins = ((signal.log10() + 4) * (_BINS / 4)).long().clamp(0, _BINS - 1)
    count = torch.bincount(bins, minlength=_BINS)
    signal_sum = torch.bincount(bins, signal.double(), minlength=_BINS)
    square_sum = torch.bincount(bins, square.double(), minlength=_BINS)

    enough = count >= _FEWEST
    return signal_sum[enough] / count[enough], square_sum[enough] / count[enough]


def _by_colour(example: Example, raw: Tensor) -> list[Tensor]:
    """Take the values of the red, green and blue sites, ``(N,)`` each; if there are many, evenly spaced ones."""
    mosaic = raw
    if len(raw) != 1:
        mosaic = example.augment.mosaic(raw)

    values = []
    for plane in bayer.pattern(example.augment.cfa).planes(*mosaic.shape[-2:]):
        of_colour = mosaic[0][plane > 0]
        step = max(1, math.ceil(len(of_colour) / _MOST))
        values.append(of_colour[::step])
    return values


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
    """Label powers of ten as 0.01, without ticks between; typeset labels would take longer than all the rest."""
    axis.minorticks_off()
    for scale in scales:
        scale.set_major_formatter("{x:g}")


def _pixels(figure: Any) -> np.ndarray:
    figure.canvas.draw()
    return np.array(figure.canvas.buffer_rgba())[..., :3]


@torch.no_grad()
def grey_curve(isp: DictionaryISP, setting: ISPParams) -> Tensor:
    """Compute the linear values ``(256,)`` of the 256 greys of sRGB under a setting without B."""
    if isp.tone is None:
        return tone_table(isp).mean(dim=1)
    return isp.tone.combine(setting.tone_weights[None])[0, ::STEPS]
