"""The photon transfer curve: measured levels and the line through them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rawaug.extras import extra
from rawaug.noise.estimate import NoiseEstimate
from rawaug.printable import printable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_CHANNELS = (("R", "tab:red"), ("Gr", "tab:olive"), ("Gb", "tab:green"), ("B", "tab:blue"))


def plot_noise(
    estimate: NoiseEstimate,
    path: str | Path | None = None,
    *,
    title: str = "",
    reference: tuple[float, float] | None = None,
) -> Figure:
    """Variance against signal, with linear axes and with logarithmic ones, which show the shadows.

    Args:
        estimate: of :func:`rawaug.noise.estimate.estimate_noise`.
        path: where to save it (``.png``, ``.pdf``, ``.svg``), or None.
        title: above the figure.
        reference: another (shot_var, read_var) to draw beside the line, such as that of the DNG's NoiseProfile.

    Returns:
        The matplotlib figure.
    """
    with extra("train"):
        from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    points = estimate.points
    signal, variance = points.signal.numpy(), points.variance.numpy()
    used, channel = points.used.numpy(), points.channel.numpy()
    right = 1.05 * signal[used].max()
    line = np.geomspace(max(signal[used].min(), 1e-5) / 2, right, 200)
    name = f"{estimate.shot_var:.3g} y + {estimate.read_var:.3g}   (R² {estimate.r2:.3f})"
    for axes, scale in zip(figure.subplots(1, 2), ("linear", "log"), strict=True):
        axes.scatter(signal[~used], variance[~used], s=14, facecolors="none", edgecolors="0.7", label="left out")
        for index, (label, colour) in enumerate(_CHANNELS):
            shown = used & (channel == index)
            if shown.any():
                axes.scatter(signal[shown], variance[shown], s=14, color=colour, label=label)
        axes.plot(line, estimate.shot_var * line + estimate.read_var, color="black", lw=1.2, label=name)
        if reference is not None:
            shot_var, read_var = reference
            label = f"{shot_var:.3g} y + {read_var:.3g}   (reference)"
            axes.plot(line, shot_var * line + read_var, color="black", lw=1.2, ls="--", label=label)
        axes.set(xscale=scale, yscale=scale, xlabel="signal (white = 1)", ylabel="variance")
        if scale == "linear":
            axes.set(xlim=(0, right), ylim=(0, 1.3 * variance[used].max()))
            axes.legend(fontsize=8)
        else:
            axes.set(xlim=(line[0], 1.0), ylim=(variance[used].min() / 3, 3 * variance[used].max()))
    figure.suptitle(printable(title), parse_math=False)
    if path is not None:
        figure.savefig(Path(path), dpi=120)
    return figure
