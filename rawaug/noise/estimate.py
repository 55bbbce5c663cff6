r"""A camera's own noise, measured on its RAW files: photon transfer on flat blocks, and dark frames.

.. math:: \operatorname{var} = \mathrm{shot\_var} \cdot \operatorname{mean} + \mathrm{read\_var}

is fitted to local mean and variance on same-colour sites (Janesick, "Photon transfer", 2007; Foi et al. 2008). Each
packed plane is cut into 8 x 8 blocks and transformed by the orthonormal DCT, where white noise has the same variance in
every coefficient. Low coefficients say whether a block is flat, high ones how noisy it is (Ponomarenko et al., 2007).
As they are independent, the choice of blocks does not bias the measurement. The first row and column are not used, so
that banding does not count. A level is left out if its noise is not white, because a codec smoothed it or texture is
mixed in. Do not trust ``read_var`` on files that a codec quantised coarsely.

With the lens capped, :math:`y = b_c + r_{row} + n`. Differences between horizontal neighbours of one colour contain n
alone, at twice its variance; those between the means of successive sensor rows contain the banding as well (after Wei
et al. 2020). Slow gradients cancel in both.

Signals are black-subtracted, white = 1; the variance of rounding to the sensor's grid is part of ``read_var``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug.bayer import CFA, pack, pattern, plane_indices
from rawaug.errors import escape, extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORST_FIT = 0.5
"""Minimum R^2 of a fit."""
BLOCK = 8
"""Side of a block, in sites of one plane."""

# The bands of a block's DCT, by the sum of a coefficient's row and column.
_order = np.add.outer(np.arange(BLOCK), np.arange(BLOCK))
_inner = np.logical_and.outer(np.arange(BLOCK) > 0, np.arange(BLOCK) > 0)
_LOW = (_order > 0) & (_order < 5)
_HIGH = _inner & (_order >= 5)
_MIDDLE = _HIGH & (_order <= 7)
_TOP = _inner & (_order >= 9)

_DOF = int(_HIGH.sum())
_MEDIAN = (1 - 2 / (9 * _DOF)) ** 3
"""Median of chi-squared over its degrees of freedom (Wilson and Hilferty)."""
_RELATIVE_SD = math.sqrt(2 / _DOF)
"""Relative standard deviation of one block's variance."""

_FLAT = 1.2
"""Largest ratio of low to expected energy in a flat block; 70 % of the blocks that contain only noise have less."""
_WHITE = 0.15
"""Largest relative difference between the bands' energies."""
_CLIP_MARGIN = 4.0
"""Minimum distance to clipping, in standard deviations of a pixel."""
_MIN_BLOCKS = 30
"""Minimum number of blocks of a level."""
_MIN_POINTS = 6
"""Minimum number of points of a line."""
_ROUNDS = 10
"""Number of repetitions of the fit."""

_OUTLIER = 8.0
"""Deviation of a hot pixel, in robust standard deviations; tails have less."""
_PILED_UP = 0.25
"""Share of pixels at the lowest value, above which nothing can be measured."""


@dataclass(frozen=True)
class NoisePoints:
    """The N measured points of a camera, tensors ``(N,)``.

    Args:
        signal: mean signal, white = 1.
        variance: variance of the noise at this signal.
        channel: 0 to 3 for R, Gr, Gb, B.
        blocks: number of flat blocks that were measured.
        used: False if the point was left out of the line: it had too few blocks, was not white, or was far from others.
    """

    signal: Tensor
    variance: Tensor
    channel: Tensor
    blocks: Tensor
    used: Tensor


@dataclass(frozen=True)
class NoiseEstimate:
    """The line that was fitted to a camera's points.

    Args:
        shot_var: its slope.
        read_var: its intercept, 0 if it cannot be measured.
        r2: R^2 over the used points.
        points: all points.
    """

    shot_var: float
    read_var: float
    r2: float
    points: NoisePoints


class _Blocks(NamedTuple):
    """Measurements of N blocks, ``(N,)`` each: mean, mean energies of the DCT bands, and the distance to clipping."""

    channel: Tensor
    signal: Tensor
    low: Tensor
    high: Tensor
    middle: Tensor
    top: Tensor
    to_black: Tensor
    to_white: Tensor

    def take(self, index: Tensor) -> _Blocks:
        """Take some of the blocks by an index ``(n,)``."""
        return _Blocks(*(values[index] for values in self))


def estimate_noise(
    mosaics: Tensor | Sequence[Tensor], cfa: CFA | str, *, read_var: float | None = None
) -> NoiseEstimate:
    """Estimate the levels of one camera at one ISO from the flat regions of its RAW files.

    Args:
        mosaics: one or several ``(1, H, W)`` or ``(1, 1, H, W)``, black-subtracted, white = 1. Signals near white are
            left out, and so are those near another clipping level, where the file's lowest or highest value piles up.
        cfa: the pattern of all mosaics: Bayer, X-Trans or Quad-Bayer. For the last two each site of the cell is a plane
            of its own, so flat regions must be three or two times as wide.
        read_var: the value known from dark frames (:func:`estimate_dark_noise`); by default it is fitted, too.

    Raises:
        ValueError: if there are too few flat regions, or they do not cover a range of signals.

    Example:
        >>> estimate = estimate_noise([mosaic], "RGGB")  # doctest: +SKIP
        >>> model = noise_model((estimate.shot_var, estimate.read_var))  # doctest: +SKIP
    """
    frames = [mosaics] if isinstance(mosaics, Tensor) else list(mosaics)
    if not frames:
        raise ValueError("no frames given to measure the noise of")
    blocks = [_measure(frame, cfa) for frame in frames]
    levels = _split_levels(_Blocks(*map(torch.cat, zip(*blocks, strict=True))))

    first = points = _start(levels)
    try:
        for _ in range(_ROUNDS):
            slope, intercept, _ = _fit(points, read_var)
            points = _points(levels, slope, intercept)
        slope, intercept, points = _fit(points, read_var)
    except ValueError:
        if float(first.variance.median()) <= _rounding(frames[0]):
            raise ValueError("no noise found: flat regions vary by no more than the file's rounding") from None
        raise

    x, y = points.signal[points.used], points.variance[points.used]
    r2 = float(1 - (y - slope * x - intercept).square().sum() / (y - y.mean()).square().sum())
    return NoiseEstimate(slope, intercept, r2, points)


def _rounding(frame: Tensor) -> float:
    """Compute twice the variance of rounding to the steps between a frame's values."""
    stride = max(1, frame.numel() // 2**18)
    steps = frame.flatten()[::stride].double().unique().diff()
    if not len(steps):
        return math.inf
    return 2.0 * float(steps.min()) ** 2 / 12.0


def _measure(frame: Tensor, cfa: CFA | str) -> _Blocks:
    from scipy.fft import dctn

    if frame.shape[:-3].numel() != 1 or frame.ndim < 3 or frame.shape[-3] != 1:
        raise ValueError(f"a mosaic must have shape (1, H, W) or (1, 1, H, W), got {tuple(frame.shape)}")
    if min(frame.shape[-2:]) < pattern(cfa).period * BLOCK:
        raise ValueError(f"a mosaic of {tuple(frame.shape[-2:])} is too small to estimate noise from")

    floor, ceiling = -math.inf, 1.0
    lowest, highest = frame.aminmax()
    if _piles_up(frame, lowest, highest):
        floor = float(lowest)
    if _piles_up(frame, highest, lowest):
        ceiling = min(float(highest), 1.0)

    planes, channels = _planes(frame.reshape(1, *frame.shape[-2:]).float(), cfa)
    tiles = planes.unfold(-2, BLOCK, BLOCK).unfold(-2, BLOCK, BLOCK).reshape(len(channels), -1, BLOCK, BLOCK)
    energy = torch.from_numpy(dctn(tiles.cpu().numpy(), axes=(-2, -1), norm="ortho")).square_()
    signal = tiles.mean((-2, -1)).flatten()

    blocks = _Blocks(
        channel=channels.to(tiles.device).repeat_interleave(tiles.shape[1]),
        signal=signal,
        low=_band_energy(energy, _LOW),
        high=_band_energy(energy, _HIGH),
        middle=_band_energy(energy, _MIDDLE),
        top=_band_energy(energy, _TOP),
        to_black=signal - floor,
        to_white=ceiling - signal,
    )
    unclipped = ((tiles > floor) & (tiles < ceiling)).all(-1).all(-1).flatten()
    return _Blocks(*(values[unclipped].double().cpu() for values in blocks))


def _band_energy(energy: Tensor, band: np.ndarray[Any, Any]) -> Tensor:
    """Compute the mean energy of a band of the coefficients ``(n, N, BLOCK, BLOCK)``, flattened."""
    return energy[..., torch.from_numpy(band)].mean(-1).flatten()


def _planes(mosaic: Tensor, cfa: CFA | str) -> tuple[Tensor, Tensor]:
    """Split a mosaic ``(1, H, W)`` into planes ``(n, h, w)``, one for each site of the cell, and say which they are."""
    if cfa in CFA.__members__:
        return pack(mosaic, cfa), torch.arange(4)

    period = pattern(cfa).period
    height = mosaic.shape[-2] // period * period
    width = mosaic.shape[-1] // period * period
    return F.pixel_unshuffle(mosaic[:, :height, :width], period), plane_indices(cfa).flatten()


def _piles_up(frame: Tensor, extreme: Tensor, opposite: Tensor) -> bool:
    """Whether one extreme value, the lowest or the highest, is frequent, and at least as frequent as the next."""
    at_extreme = frame == extreme
    count = int(torch.count_nonzero(at_extreme))
    if count < max(10, frame.numel() // 100_000) or count == frame.numel():
        return False

    ends = frame.masked_fill(at_extreme, float(opposite)).aminmax()
    next_value = min(ends, key=lambda end: float((end - extreme).abs()))
    return count >= int(torch.count_nonzero(frame == next_value))


def _split_levels(blocks: _Blocks) -> list[_Blocks]:
    """Split the blocks by colour and signal into levels, each with the same number of blocks within a colour."""
    levels = []
    for channel in range(4):
        index = torch.nonzero(blocks.channel == channel).flatten()
        index = index[blocks.signal[index].argsort()]
        count = min(32, max(4, len(index) // 200))
        for part in index.tensor_split(count):
            if len(part) >= _MIN_BLOCKS:
                levels.append(blocks.take(part))

    if len(levels) < _MIN_POINTS:
        raise ValueError("too few blocks without clipped pixels to estimate noise; give larger or more frames")
    return levels


def _start(levels: list[_Blocks]) -> NoisePoints:
    """Make a first guess from the twentieth of each level's blocks that varies least in the low frequencies."""
    flattest = []
    variances = []
    for level in levels:
        count = max(_MIN_BLOCKS, len(level.low) // 20)
        blocks = level.take(level.low.argsort()[:count])
        flattest.append(blocks)
        variances.append(blocks.high.median() / _MEDIAN)
    return _gather(flattest, variances)


def _points(levels: list[_Blocks], shot_var: float, read_var: float) -> NoisePoints:
    """Measure each level's signal and variance over the blocks that the line says are flat and clear of clipping."""
    flat_levels = []
    variances = []
    for level in levels:
        expected = (shot_var * level.signal.clamp(min=0) + read_var).clamp(min=1e-12)
        is_clear = torch.minimum(level.to_black, level.to_white) > _CLIP_MARGIN * expected.sqrt()
        is_regular = level.high < (1 + 6 * _RELATIVE_SD) * expected
        is_flat = level.low < _FLAT * expected
        index = torch.nonzero(is_clear & is_regular & is_flat).flatten()
        if len(index) == 0:
            continue

        # Take the median of the ratio to the line, so that a wide level is not skewed by its spread of signals.
        flat, expected = level.take(index), expected[index]
        flat_levels.append(flat)
        variances.append((flat.high / expected).median() / _MEDIAN * expected.mean())

    if not flat_levels:
        raise ValueError("no flat regions found to estimate noise from; give frames with sky, walls or a chart")
    return _gather(flat_levels, variances)


def _gather(levels: list[_Blocks], variances: list[Tensor]) -> NoisePoints:
    """Make one point for each level from its blocks and their variance."""
    signals = []
    channels = []
    counts = []
    whiteness = []
    for level in levels:
        signals.append(level.signal.mean())
        channels.append(level.channel[0])
        counts.append(len(level.signal))
        whiteness.append(level.top.mean() / level.middle.mean())

    blocks = torch.tensor(counts)
    is_white = (torch.stack(whiteness) - 1).abs() < _WHITE
    return NoisePoints(
        signal=torch.stack(signals),
        variance=torch.stack(variances).clamp(min=1e-12),
        channel=torch.stack(channels).long(),
        blocks=blocks,
        used=(blocks >= _MIN_BLOCKS) & is_white,
    )


def _fit(points: NoisePoints, dark_var: float | None) -> tuple[float, float, NoisePoints]:
    """Fit slope and intercept by robust weighted least squares, and mark outliers among the points as unused.

    The intercept is ``dark_var`` if dark frames have given it.
    """
    used = points.used
    x, y, n = points.signal, points.variance, points.blocks.double()
    if int(used.sum()) < _MIN_POINTS or x[used].max() < 1.5 * x[used].min().clamp(min=1e-6):
        raise ValueError("too few flat regions, or all of one brightness, to fit noise; give more frames, or charts")

    variance, trust = y, used
    for _ in range(_ROUNDS):
        weight = trust * n / variance.square()
        slope, intercept = _line(x, y, weight, dark_var)
        variance = (slope * x.clamp(min=0) + intercept).clamp(min=1e-12)
        residual = y / variance - 1
        scale = max(1.4826 * float(residual[used].abs().median()), 0.02)
        trust = used & (residual.abs() < 4 * scale)
    return slope, intercept, replace(points, used=trust)


def _line(x: Tensor, y: Tensor, weight: Tensor, dark_var: float | None) -> tuple[float, float]:
    """Fit the slope, and the intercept unless it is ``dark_var``, by weighted least squares; it is at least 0."""
    w = float(weight.sum())
    wx, wxx = float((weight * x).sum()), float((weight * (x * x)).sum())
    wy, wxy = float((weight * y).sum()), float((weight * x * y).sum())

    if dark_var is None:
        determinant = w * wxx - wx * wx
        intercept = (wxx * wy - wx * wxy) / determinant
        if intercept >= 0:
            return (w * wxy - wx * wy) / determinant, intercept
    else:
        intercept = dark_var

    intercept = max(intercept, 0.0)
    return (wxy - intercept * wx) / wxx, intercept


def own_noise(raw: Tensor, cfa: CFA | str) -> tuple[float, float] | None:
    """Measure the noise of a reference itself, on the whole frame as its camera gave it.

    Args:
        raw: the mosaic ``(1, H, W)``, not binned.
        cfa: its pattern.

    Returns:
        (shot_var, read_var), or None if too little of the frame is flat or its points follow no line.
    """
    try:
        estimate = estimate_noise(raw, cfa)
    except ValueError:
        return None

    if estimate.r2 < WORST_FIT:
        return None
    return estimate.shot_var, estimate.read_var


def own_noise_share(levels: tuple[float, float], reference: Tensor, squared_error: float) -> float:
    """Compute the share of a mean squared error that is the reference's own noise; a perfect denoiser reaches 1.

    ``levels`` are (shot_var, read_var) of the reference ``(..., H, W)``, white = 1.
    """
    shot_var, read_var = levels
    return (shot_var * float(reference.mean()) + read_var) / squared_error


@dataclass(frozen=True)
class DarkNoise:
    """The noise of a camera without light, white = 1.

    Args:
        read_var: variance of the pixels, including fixed pattern noise.
        row_var: variance of banding along rows, 0 if it cannot be measured.
        black_offset: error of the black level in R, Gr, Gb, B.
    """

    read_var: float
    row_var: float
    black_offset: tuple[float, float, float, float]


def estimate_dark_noise(frames: Sequence[Tensor], cfa: CFA | str) -> DarkNoise:
    """Estimate the noise without light as the mean over dark frames ``(1, H, W)`` of one camera at one ISO.

    Raises:
        ValueError: if there is no frame, or one is clipped at black.

    Example:
        >>> frame = torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0)) * 1e-3
        >>> dark = estimate_dark_noise([frame], "RGGB")
        >>> 0.9e-6 < dark.read_var < 1.1e-6  # for estimate_noise(mosaics, cfa, read_var=dark.read_var)
        True
    """
    if not frames:
        raise ValueError("no dark frames given")

    figures = []
    for frame in frames:
        mosaic = frame.reshape(1, *frame.shape[-2:]).double()
        figures.append(_measure_dark(pack(mosaic, cfa)))

    read_var, row_var, *offsets = torch.stack(figures).mean(0).tolist()
    return DarkNoise(read_var, max(row_var, 0.0), (offsets[0], offsets[1], offsets[2], offsets[3]))


def _measure_dark(planes: Tensor) -> Tensor:
    """Measure read_var, row_var and the offsets of R, Gr, Gb, B of packed ``(4, h, w)``: ``(6,)``."""
    lowest = planes == planes.min()
    if float(lowest.double().mean()) > _PILED_UP:
        raise ValueError("a dark frame is clipped at black, so its noise cannot be measured")

    difference = planes.diff(dim=-1)
    scale = 1.4826 * difference.abs().median()
    is_regular = torch.ones_like(difference, dtype=torch.bool)
    limit = planes.abs().max()
    if scale > 0:
        limit = _OUTLIER * scale
        is_regular = difference.abs() <= limit
    read_var = difference[is_regular].square().mean() / 2

    # A median is coarse on digital numbers, so cap the outliers.
    offsets = planes.flatten(1).median(-1).values
    levelled = (planes - offsets[:, None, None]).clamp(-limit, limit)

    # R and Gr share a row of the sensor, Gb and B the next.
    rows = levelled.reshape(2, 2, *planes.shape[1:]).mean((1, 3))
    row_var = rows.diff(dim=-1).square().mean() / 2 - read_var / (2 * planes.shape[-1])
    return torch.cat([read_var[None], row_var[None], levelled.mean((1, 2)) + offsets])


_CHANNELS = (("R", "tab:red"), ("Gr", "tab:olive"), ("Gb", "tab:green"), ("B", "tab:blue"))


def plot_noise(estimate: NoiseEstimate, path: str | Path | None = None, *, title: str = "") -> Figure:
    """Plot variance against signal on linear and logarithmic axes, and save it to ``path`` (.png, .pdf or .svg)."""
    with extra("train"):
        from matplotlib.figure import Figure

    points = estimate.points
    signal, variance = points.signal.numpy(), points.variance.numpy()
    used, channel = points.used.numpy(), points.channel.numpy()

    right = 1.05 * signal[used].max()
    line = np.geomspace(max(signal[used].min(), 1e-5) / 2, right, 200)
    name = f"{estimate.shot_var:.3g} y + {estimate.read_var:.3g}   (R² {estimate.r2:.3f})"

    figure = Figure(figsize=(11, 4.6), layout="constrained")
    for axes, scale in zip(figure.subplots(1, 2), ("linear", "log"), strict=True):
        axes.scatter(signal[~used], variance[~used], s=14, facecolors="none", edgecolors="0.7", label="left out")
        for index, (label, colour) in enumerate(_CHANNELS):
            of_channel = used & (channel == index)
            if of_channel.any():
                axes.scatter(signal[of_channel], variance[of_channel], s=14, color=colour, label=label)

        axes.plot(line, estimate.shot_var * line + estimate.read_var, color="black", lw=1.2, label=name)
        axes.set(xscale=scale, yscale=scale, xlabel="signal (white = 1)", ylabel="variance")
        if scale == "linear":
            axes.set(xlim=(0, right), ylim=(0, 1.3 * variance[used].max()))
            axes.legend(fontsize=8)
        else:
            axes.set(xlim=(line[0], 1.0), ylim=(variance[used].min() / 3, 3 * variance[used].max()))

    figure.suptitle(escape(title), parse_math=False)
    if path is not None:
        from rawaug.files import write_bytes

        file = BytesIO()
        figure.savefig(file, dpi=120, format=Path(path).suffix.removeprefix("."))
        write_bytes(file.getbuffer(), path)
    return figure
