r"""Denoisers judged on a file of one's own, which has no clean version: their PSNR by an unbiased estimate of the risk.

.. math:: \mathrm{PSNR} = -10 \log_{10} \Big( \frac{1}{n} \sum_i u_i \Big), \qquad \operatorname{E} u_i
          = \operatorname{E} (f_i(y) - x_i)^2

with u of :mod:`rawaug.denoising.risk`. Its deviation is that of the noise's energy on this frame, which nobody knows,

.. math:: \operatorname{var} \sum_i u_i \approx \sum_i (2 \sigma_i^4 + 8 \sigma_i^2 u_i + (k_i - \bar k)^2),

where k is the term of the derivatives, whose single values scatter since one probe measures all of them at once. It is
nearly the same for all denoisers, and the difference of two is known far better: its interval comes from blocks. What
all have in common is corrected by the best denoiser, whose error is also read from noise drawn on its own result.
After development D, all terms are taken through its derivative J at f(y), which is right to first order:
:math:`|J (f - y)|^2 - |J n|^2 + 2 (J \sigma^2 b) \cdot J (f(y + e) - f(y)) / e`, where n is drawn noise.

All of it rests on noise of the stated levels that is independent from pixel to pixel. Flat places show whether it is:
there y - f(y) is the noise, its variance must be that of the levels at every signal, and neighbours, rows and columns
must not resemble each other. A frame that fails is refused with the reason.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug import bayer
from rawaug.data.development import render_raw
from rawaug.data.pairs import centre
from rawaug.denoising.denoiser import Levels, Noisy, RawDenoiser, shipped_of_mosaics
from rawaug.denoising.levels import Noise, find_levels
from rawaug.denoising.raw import equalise_greens
from rawaug.denoising.risk import Probe, bootstrap_error, combine_estimates, estimate_risk, probe_denoiser
from rawaug.evaluation.figures import new_figure, save_figure
from rawaug.evaluation.tables import print_rows
from rawaug.io import RawFrame, read_raw
from rawaug.progress import progress

BLOCK = 16
"""Side of the blocks in which harm is looked for, in cells: 32 pixels of the mosaic."""

WRONG_LEVELS = 1.2
"""Levels are refused if the noise of flat places has this many times their variance, or this part of it."""

CORRELATED = (-0.15, 0.05)
"""Noise is refused if the correlation of neighbours in flat places is outside; the noise that a denoiser keeps is
missing from the residual, which makes it negative."""

BANDED = 0.01
"""Noise is refused if offsets of rows, or of columns, have this share of its variance."""

MOST_CLIPPED = 0.2
"""A frame is refused if this share of it is clipped at white; what is clipped is left out in any case."""

LEVELS_ERROR = 0.02
"""Levels that were estimated from the frame are wrong by this part of the variance: of drawn noise on the frames of
``real:`` and ``demo:`` they were, by 0.01 to 0.03 in the mean of squares, which the interval contains."""

_SURE = 5.0
"""A fault is one if it is beyond its limit, and this many of its deviations from what is right."""
_HARM = 3.0
"""A block is harmed if its error is above that of its input by this many deviations."""
_BINS = 3
"""Flat places are looked for in as many ranges of signal."""
_FLAT = 0.15
"""This share of a range's blocks, those with the least contrast, are taken for flat places."""
_PLACE = 8
"""Side of a flat place, in cells."""
_LEAST_LINES = 32
"""Fewer lines than this say nothing of the others."""
_OF_LINES = 0.3
"""Lines correlate neighbours by less than this, unless there is hardly any other noise."""
_LEAST_FLAT = 10
"""Fewer flat places than this in a range say nothing."""
_NORMAL = 1.96


@dataclass(frozen=True)
class Judged:
    """What is estimated of one denoiser on one frame.

    Attributes:
        psnr: its PSNR in dB.
        interval: the ends of its 95% interval.
        behind: by how many dB it is behind the best denoiser, and the ends of the 95% interval, which is much narrower.
        colours: PSNR of the planes R, Gr, Gb, B.
        harmed: share of the blocks whose error is above that of the input.
        gain: the input's error less the result's, in units of the input's, by block ``(1, 1, h / 16, w / 16)``; NaN
            where most of a block is clipped.
        psnr_srgb: PSNR after development, to first order; None if the frame was not developed.
        seconds: time of one pass.
    """

    psnr: float
    interval: tuple[float, float]
    behind: tuple[float, float, float]
    colours: tuple[float, ...]
    harmed: float
    gain: Tensor = field(repr=False)
    psnr_srgb: float | None = None
    seconds: float = 0.0


@dataclass(frozen=True)
class Judgement:
    """What :func:`judge` says of a frame.

    Attributes:
        name: of the frame.
        levels: (shot_var, read_var) of its noise.
        noise_source: where they come from.
        refusals: reasons why no figure is given; without any, ``denoisers`` can be believed.
        remarks: what could not be checked, or was left out.
        psnr_noisy: PSNR of the frame itself, by its levels.
        denoisers: by name, the best first; empty if the frame was refused.
    """

    name: str
    levels: Levels
    noise_source: str
    refusals: tuple[str, ...]
    remarks: tuple[str, ...]
    psnr_noisy: float
    denoisers: dict[str, Judged]


def judge(
    source: str | Path | RawFrame,
    denoisers: Sequence[Any] | None = None,
    noise: Noise = "auto",
    *,
    crop: int | None = None,
    probes: int = 1,
    seed: int = 0,
    device: str = "auto",
) -> Judgement:
    """Estimate the PSNR of denoisers on a RAW file that has no clean version.

    Args:
        source: a RAW file of a Bayer sensor, or a frame.
        denoisers: whatever :meth:`rawaug.RawDenoiser.of` takes; by default NonLocalMeans and the shipped networks.
        noise: where the levels come from, see :data:`rawaug.denoising.levels.Noise`.
        crop: judge only the middle of this side, in pixels of the mosaic.
        probes: number of small changes with which each denoiser is run once more; several scatter less.
        seed: seed of the small changes, and of the noise that is drawn on the best result.
        device: where networks run: auto, cpu, cuda, ...

    Raises:
        FileNotFoundError, OSError: if the file is missing or cannot be read.
        ValueError: if the sensor is not Bayer's, the levels are unknown, or there is no such denoiser.

    Example:
        >>> judgement = rawaug.judge("in.dng", ["rawaug-small", "NonLocalMeans"])  # doctest: +SKIP
        >>> judgement.denoisers["rawaug-small"].psnr                               # doctest: +SKIP
        44.6
    """
    frame = source if isinstance(source, RawFrame) else read_raw(source)
    if frame.cfa not in bayer.CFA.__members__:
        raise ValueError(f"{frame.name}: judge takes Bayer mosaics, not {frame.cfa}")
    frame, _ = equalise_greens(frame)
    shot_var, read_var, noise_source = find_levels(frame, noise)

    specs = ["NonLocalMeans", *shipped_of_mosaics()] if denoisers is None else denoisers
    opened = [RawDenoiser.of(spec, device).require_mosaic() for spec in specs]

    packed = bayer.pack(frame.mosaic[None], frame.cfa)
    if crop is not None:
        packed = centre(packed, crop // 2, crop // 2, step=1)

    def develop(image: Tensor) -> Tensor:
        mosaic = bayer.unpack(image, frame.cfa)[0]
        return render_raw(mosaic, frame.cfa, frame.white_balance, frame.color_matrix, "bilinear", least=None)

    noisy = Noisy.of(packed, (shot_var, read_var), frame.cfa)
    levels_error = LEVELS_ERROR if noise_source.startswith("estimate") else 0.0
    return judge_noisy(noisy, opened, develop, frame.name, noise_source, seed, levels_error, probes)


def judge_noisy(
    noisy: Noisy,
    denoisers: Sequence[RawDenoiser],
    develop: Callable[[Tensor], Tensor] | None = None,
    name: str = "",
    noise_source: str = "given",
    seed: int = 0,
    levels_error: float = 0.0,
    probes: int = 1,
) -> Judgement:
    """Judge denoisers on packed RAW ``(1, 4, h, w)`` with known levels; see :func:`judge`.

    ``levels_error`` is by what part of the noise's variance the levels may be wrong, a deviation.
    """
    if noisy.levels is None or noisy.image.shape[1] != 4:
        raise ValueError(f"{name}: judge needs packed RAW (1, 4, h, w) and the levels of its noise")
    image, levels = noisy.image, noisy.levels

    probe_by_name: dict[str, Probe] = {}
    seconds: dict[str, float] = {}
    for denoiser in progress(denoisers, label=name or "judge", unit="denoiser"):
        start = time.perf_counter()
        probe_by_name[denoiser.name] = probe_denoiser(denoiser, noisy, seed, probes)
        seconds[denoiser.name] = (time.perf_counter() - start) / (1 + probes)

    risks = {key: estimate_risk(probe, image, levels) for key, probe in probe_by_name.items()}
    best = min(risks, key=lambda key: float(risks[key].mean()))
    is_whole = _is_below_white(probe_by_name[best])
    refusals, remarks = _check_noise(noisy, probe_by_name[best], is_whole)
    noise_energy = float((probe_by_name[best].variance * is_whole).sum() / is_whole.sum().clamp_min(1))
    psnr_noisy = _decibels(noise_energy)
    if refusals:
        return Judgement(name, levels, noise_source, tuple(refusals), tuple(remarks), psnr_noisy, {})

    denoiser = next(one for one in denoisers if one.name == best)
    bootstrapped = bootstrap_error(denoiser, probe_by_name[best], noisy, is_whole, seed)
    error = float(risks[best][is_whole].mean())
    deviation = _deviation(probe_by_name[best], error, is_whole, levels_error * noise_energy)
    median, *ends = combine_estimates(error, deviation, bootstrapped)
    for risk in risks.values():
        risk -= (error - median) * probe_by_name[best].variance / noise_energy

    judged = {}
    for key in sorted(risks, key=lambda key: float((risks[key] * is_whole).sum())):
        scores = _judge_one(probe_by_name[key], risks[key], risks[best], is_whole, (median - ends[0], ends[1] - median))
        psnr_srgb = None
        if develop is not None:
            psnr_srgb = _developed(probe_by_name[key], image, develop, seed)
        judged[key] = replace(scores, psnr_srgb=psnr_srgb, seconds=seconds[key])
    return Judgement(name, levels, noise_source, (), tuple(remarks), psnr_noisy, judged)


def _deviation(probe: Probe, error: float, is_whole: Tensor, energy_error: float) -> float:
    """Estimate the standard deviation of the mean of the risk, from that of the noise's energy and of the probe.

    ``energy_error`` is the deviation of the noise's energy if its levels are not known exactly.
    """
    count = is_whole.sum().clamp_min(1)
    kept = 2.0 * probe.variance * probe.kept
    spread = 2.0 * probe.variance.square() + 8.0 * probe.variance * max(error, 0.0)
    spread += (kept - (kept * is_whole).sum() / count).square()
    return math.hypot(float((spread * is_whole).sum().sqrt() / count), energy_error)


def _judge_one(
    probe: Probe, risk: Tensor, least_risk: Tensor, is_whole: Tensor, reach_of_best: tuple[float, float]
) -> Judged:
    """Judge one denoiser beside the best, without the values that are clipped.

    ``reach_of_best`` is how far the error of the best denoiser may be below and above its estimate.
    """
    count = is_whole.sum().clamp_min(1)
    error = float((risk * is_whole).sum() / count)

    size = _pool(is_whole.to(risk))
    is_judged = size > 0.5
    difference = float(((risk - least_risk) * is_whole).sum() / count)
    by_block = (_pool((risk - least_risk) * is_whole) / size.clamp_min(0.5))[is_judged]
    reach = _NORMAL * float(by_block.std() / math.sqrt(max(1, by_block.numel()))) if by_block.numel() > 1 else math.inf
    interval = (
        _decibels(error + math.hypot(reach_of_best[1], reach)),
        _decibels(error - math.hypot(reach_of_best[0], reach)),
    )
    least = max(error - difference, 1e-12)
    behind = []
    for step in (difference, difference - reach, difference + reach):
        behind.append(10.0 * math.log10(max(least + step, 1e-12) / least))

    colours = []
    for plane in range(risk.shape[1]):
        sites = is_whole[:, plane]
        colours.append(_decibels(float((risk[:, plane] * sites).sum() / sites.sum().clamp_min(1))))

    gain = _pool((probe.variance - risk) * is_whole)
    block_spread = _pool((2.0 * probe.variance.square() + 8.0 * probe.variance * risk.clamp_min(0.0)) * is_whole)
    is_harmed = gain < -_HARM * (block_spread / (4 * BLOCK**2)).sqrt()
    harmed = float((is_harmed & is_judged).sum() / is_judged.sum().clamp_min(1))
    relative = gain / _pool(probe.variance * is_whole).clamp_min(1e-12)
    relative = relative.masked_fill(~is_judged, math.nan)
    return Judged(_decibels(error), interval, (behind[0], behind[1], behind[2]), tuple(colours), harmed, relative)


def _developed(probe: Probe, image: Tensor, develop: Callable[[Tensor], Tensor], seed: int) -> float:
    """Estimate the PSNR after development, whose derivative at the denoised image is taken by finite differences."""
    at = develop(probe.denoised)
    step = 0.02

    def carry(direction: Tensor) -> Tensor:
        return (develop(probe.denoised + step * direction) - at) / step

    generator = torch.Generator().manual_seed(seed + 1)
    noise = torch.randn(image.shape, generator=generator) * probe.variance.sqrt()
    removed = carry(probe.denoised - image).square().mean()
    energy = carry(noise).square().mean()
    # sigma^2 b / e = sigma^2 e / e^2, and e^2 is the same multiple of sigma^2 everywhere
    scale = (probe.variance / probe.change.square()).mean()
    kept = torch.zeros(())
    for change, response in zip(probe.change, probe.response, strict=True):
        kept += (carry(change[None]) * carry(response[None])).mean() * scale / len(probe.change)
    return _decibels(float(removed - energy + 2.0 * kept))


# -- whether the noise is as the estimate needs it ---------------------------------------------------------------------


def _check_noise(noisy: Noisy, probe: Probe, is_whole: Tensor) -> tuple[list[str], list[str]]:
    """List the reasons why the noise of a frame is not what its levels say, and what could not be checked."""
    refusals: list[str] = []
    remarks: list[str] = []
    clipped = 1.0 - float(is_whole.float().mean())
    if clipped > MOST_CLIPPED:
        refusals.append(f"{clipped:.0%} of it is clipped at white")
    elif clipped > 0.001:
        remarks.append(f"{clipped:.1%} of it is clipped at white and left out")

    lowest = noisy.image.min()
    at_lowest = float((noisy.image == lowest).float().mean())
    if at_lowest > 0.02 and lowest >= -1e-6:
        refusals.append(f"clipping: {at_lowest:.0%} of its values are at black, where noise should go below")

    residual = (noisy.image - probe.denoised) / probe.variance.sqrt()
    is_flat = torch.zeros_like(_pool(residual, _PLACE), dtype=torch.bool)
    wrong = []
    for places, signal in _flat_places(probe, is_whole):
        is_flat |= places
        energy = _pool(residual.square(), _PLACE)[places].mean()
        kept = _pool(probe.kept, _PLACE)[places].mean()
        ratio = float(energy / (1.0 - kept).clamp_min(0.2))
        deviation = math.sqrt(2.0 / (int(places.sum()) * 4 * _PLACE**2))
        if not 1.0 / WRONG_LEVELS < ratio < WRONG_LEVELS and abs(ratio - 1.0) > _SURE * deviation:
            wrong.append(f"{ratio:.2f} times what they say at a signal of {signal:.3f}")
    if not is_flat.any():
        remarks.append("no place is flat enough to check its noise against the levels")
        return refusals, remarks

    correlation, neighbours = _correlation(residual, is_flat, noisy.cfa)
    lines = _banding(residual, is_flat)
    if lines and abs(correlation) < _OF_LINES:
        refusals.append(lines)
    elif not CORRELATED[0] < correlation < CORRELATED[1]:
        cause = "demosaiced, binned or compressed with loss?"
        return [f"its noise is correlated: {correlation:+.2f} between {neighbours} ({cause})"], remarks
    if wrong:
        refusals.insert(0, f"the levels do not fit: its noise has a variance of {', '.join(wrong)}")
    return refusals, remarks


def _flat_places(probe: Probe, is_whole: Tensor) -> list[tuple[Tensor, float]]:
    """Find the places with the least contrast in each range of signal, a mask ``(1, 1, h', w')`` and the mean signal.

    They are flat if the denoised image varies by less than the noise within them.
    """
    denoised = probe.denoised
    mean = F.avg_pool2d(denoised, _PLACE)
    square = F.avg_pool2d(denoised.square(), _PLACE)
    contrast = ((square - mean.square()) / F.avg_pool2d(probe.variance, _PLACE)).mean(1, keepdim=True)
    signal = mean.mean(1, keepdim=True)
    is_inside = _pool(is_whole.to(denoised), _PLACE) == 1.0

    flat: list[tuple[Tensor, float]] = []
    if not is_inside.any():
        return flat
    ends = torch.quantile(signal[is_inside], torch.linspace(0, 1, _BINS + 1))
    for low, high in pairwise(ends.tolist()):
        inside = is_inside & (signal >= low) & (signal <= high)
        limit = torch.quantile(contrast[inside], _FLAT)
        places = inside & (contrast <= limit) & (contrast < 1.0)
        if int(places.sum()) >= _LEAST_FLAT:
            flat.append((places, float(signal[places].mean())))
    return flat


def _correlation(residual: Tensor, is_flat: Tensor, cfa: str) -> tuple[float, str]:
    """Find the largest correlation of neighbours in flat places, and say between which; 0 if it may be chance."""
    mosaic = bayer.unpack(residual, cfa)[0, 0]
    mask = is_flat[0, 0].repeat_interleave(2 * _PLACE, 0).repeat_interleave(2 * _PLACE, 1)
    mosaic = mosaic[: mask.shape[0], : mask.shape[1]]
    worst, neighbours = 0.0, ""
    lags = {
        (0, 1): "pixels side by side",
        (1, 0): "pixels one above the other",
        (0, 2): "pixels of one colour side by side",
        (2, 0): "pixels of one colour one above the other",
    }
    for (down, right), words in lags.items():
        first, second = mosaic[: mosaic.shape[0] - down, : mosaic.shape[1] - right], mosaic[down:, right:]
        both = mask[: mosaic.shape[0] - down, : mosaic.shape[1] - right] & mask[down:, right:]
        product = (first * second)[both]
        energy = (first.square() + second.square())[both] / 2
        correlation = float(product.mean() / energy.mean().clamp_min(1e-12))
        is_sure = abs(correlation) > _SURE / math.sqrt(max(1, product.numel()))
        if is_sure and abs(correlation) > abs(worst):
            worst, neighbours = correlation, words
    return worst, neighbours


def _banding(residual: Tensor, is_flat: Tensor) -> str:
    """Say what share of the noise the offsets of rows or columns hold, by the scatter of their means; empty if little.

    A denoiser keeps little of a line that its neighbours do not have, so it is in the residual.
    """
    mask = is_flat.repeat_interleave(_PLACE, 2).repeat_interleave(_PLACE, 3)
    height, width = mask.shape[-2:]
    mask = mask.expand(1, 4, height, width).to(residual)
    residual = residual[..., :height, :width] * mask
    energy = (residual.square().sum() / mask.sum()).clamp_min(1.0)
    for axis, lines in ((3, "rows"), (2, "columns")):
        count = mask.sum(axis)
        is_long = count >= 2 * _PLACE
        scatter = (residual.sum(axis).square() / count.clamp_min(1) / energy)[is_long]
        if scatter.numel() < _LEAST_LINES:
            continue
        excess = float(scatter.mean()) - 1.0
        share = excess / float(count[is_long].mean())
        if share > BANDED and excess > _SURE * math.sqrt(2.0 / scatter.numel()):
            return f"its noise has {lines}: offsets of whole {lines} hold {share:.1%} of its variance"
    return ""


def _is_below_white(probe: Probe) -> Tensor:
    """Mark the values that noise does not bring to white, by the denoised image, whose noise is small."""
    return probe.denoised < 1.0 - 4.0 * probe.variance.sqrt()


def _pool(values: Tensor, side: int = BLOCK) -> Tensor:
    """The means over blocks and planes, ``(1, 1, h / side, w / side)``."""
    return F.avg_pool2d(values.mean(1, keepdim=True), side)


def _decibels(error: float) -> float:
    return -10.0 * math.log10(error) if error > 0 else math.inf


# -- what is shown -----------------------------------------------------------------------------------------------------


def print_judgement(judgement: Judgement) -> None:
    """Print the table of a frame, or why there is none, and what could not be checked."""
    shot_var, read_var = judgement.levels
    print(f"{judgement.name}: levels ({shot_var:.3g}, {read_var:.3g}), {judgement.noise_source}")
    for remark in judgement.remarks:
        print(f"{judgement.name}: {remark}")
    for refusal in judgement.refusals:
        print(f"{judgement.name}: not judged, {refusal}")
    if judgement.refusals:
        return

    rows = [["noisy input", f"{judgement.psnr_noisy:.2f}", "", "", "", "", "", ""]]
    for name, scores in judgement.denoisers.items():
        low, high = scores.interval
        distance, nearest, farthest = scores.behind
        behind = "best" if distance == 0 else f"{distance:.2f} ({nearest:.2f} to {farthest:.2f})"
        colours = " ".join(f"{value:.1f}" for value in scores.colours)
        srgb = "" if scores.psnr_srgb is None else f"{scores.psnr_srgb:.2f}"
        cells = [f"{scores.psnr:.2f}", f"{low:.2f} to {high:.2f}", behind, colours, srgb]
        rows.append([name, *cells, f"{scores.harmed:.1%}", f"{scores.seconds:.1f}"])
    head = ["denoiser", "PSNR", "95%", "behind the best", "R Gr Gb B", "sRGB", "harmed", "s"]
    print_rows(f"{judgement.name}: estimated PSNR in dB, without a clean frame", head, rows)


def plot_judgement(judgement: Judgement, path: Path) -> None:
    """Draw where each denoiser gains and where it harms, as a share of the noise's variance, and write the picture."""
    if not judgement.denoisers:
        raise ValueError(f"{judgement.name}: was not judged, so there is nothing to draw")

    columns = min(4, len(judgement.denoisers))
    lines = math.ceil(len(judgement.denoisers) / columns)
    figure = new_figure(3.2 * columns, 3.0 * lines)
    axes = figure.subplots(lines, columns, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (name, scores) in zip(axes.flat, judgement.denoisers.items(), strict=False):
        shown = axis.imshow(scores.gain[0, 0].numpy(), cmap="RdYlGn", vmin=-1.0, vmax=1.0, interpolation="nearest")
        axis.set_title(f"{name}\n{scores.psnr:.2f} dB, {scores.harmed:.1%} harmed", fontsize=9, parse_math=False)
    figure.colorbar(shown, ax=axes, shrink=0.7, label="share of the noise removed")
    save_figure(figure, path)
