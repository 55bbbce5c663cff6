r"""Denoisers side by side: the same frozen noise on the same clean references, at four strengths.

.. math:: \operatorname{var}(y) = \mathrm{shot\_var}\, y + \mathrm{read\_var}

Each denoiser is given the true levels, and in a second table the levels as estimated from the noisy frame, which is
what a photographer has. A third table simulates real sensors: hot pixels, banding, black levels and colours that are
slightly off, rounding to 12 bits. A reference is the middle of a frame, binned by colour site if it has noise of its
own. The hash of all noisy inputs says whether the figures of two people can be compared.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from statistics import fmean
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from rawaug import bayer
from rawaug.data.pairs import Pair, centre
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.errors import count_of
from rawaug.evaluation.figures import Panels, make_panels
from rawaug.evaluation.scores import METRICS, NOISY, Row, group_rows, score, summary
from rawaug.evaluation.tables import join_figures
from rawaug.evaluation.trials import TEST_NOISE, Trial, freeze_noise, raw_trial
from rawaug.evaluation.verdict import paired_interval
from rawaug.files import digest
from rawaug.noise import (
    FixedLevels,
    NoiseLevels,
    NoiseModel,
    NoiseSpec,
    SensorNoise,
    ShotReadNoise,
    estimate_noise,
    noise_levels,
)
from rawaug.progress import progress

STRENGTHS = {
    "base ISO": (2.3e-4, 2e-6),
    "phone": (1.8e-3, 1.2e-5),
    "strong": (7e-3, 1.8e-4),
    "very strong": (2.8e-2, 2.5e-3),
}
"""(shot_var, read_var) of Google's Pixel at ISO 100, 800 and 3200 by its tags, and of noise two stops stronger."""

_SENSOR: dict[str, Any] = {
    "row_var": 2e-6,
    "black_offset_sd": 5e-4,
    "colour_bias_sd": 5e-4,
    "hot": 2e-4,
    "bits": 12,
    "black_level": 64,
}
"""The faults that sensors add to shot and read noise, at the strengths of :data:`_OF_SENSORS` or at the caller's."""

_OF_SENSORS = ("phone", "strong")
"""The strengths at which real sensors are simulated."""

_MOST_SHOWN = 4
"""Largest number of frames on the page, and in the figure."""

_TILE = 510
"""Operations are counted on this many pixels a side: a pattern that is moved by a pixel needs no larger tile."""

_CONDITIONS = TOLD, ESTIMATED, REAL = "levels told", "levels estimated", "sensors as they are"
"""What the denoisers are told, or how the sensor behaves; each has a table."""


def choose_strengths(noise: NoiseSpec | None = None, isos: Sequence[float] | None = None) -> dict[str, NoiseLevels]:
    """Noise levels by the name of their column: :data:`STRENGTHS`, or those of ``noise`` at each of ``isos``.

    Raises:
        ValueError: if the noise is unknown, or there are ISO values but no camera.
    """
    if noise is None:
        if isos:
            raise ValueError("iso: needs the name of a camera as noise")
        return {name: FixedLevels(*levels) for name, levels in STRENGTHS.items()}
    if not isos:
        return {str(noise): noise_levels(noise)}

    levels_by_iso = {}
    for iso in isos:
        levels_by_iso[f"ISO {iso:g}"] = noise_levels(noise, iso=iso)
    return levels_by_iso


def benchmark_trials(
    frames: Iterable[Pair],
    crop: int,
    seed: int = 0,
    strengths: Mapping[str, NoiseLevels] | None = None,
    conditions: Collection[str] = _CONDITIONS,
) -> list[Trial]:
    """Make the middles of all frames under every condition and strength; same frames and seed give the same bits.

    Noise is added to whole frames, from which the levels are estimated; if that fails, the condition has no trial.

    Args:
        frames: clean references.
        crop: side of the middles in pixels of the mosaic.
        seed: seed of the noise.
        strengths: noise levels by name, see :func:`choose_strengths`.
        conditions: which of the three are wanted, by the names of their tables.
    """
    strengths = strengths or choose_strengths()
    with_faults = set(_OF_SENSORS).intersection(strengths) or set(strengths)
    if REAL not in conditions:
        with_faults = set()

    trials: list[Trial] = []
    for frame in progress(frames, label="noise", unit="frame"):
        middle = frame.middle(crop)
        for name, levels in strengths.items():
            exact = draw_noisy(frame, name, levels, seed)
            if TOLD in conditions:
                trials.append(_middle(exact, middle, crop, TOLD, name))

            if ESTIMATED in conditions:
                with suppress(ValueError):  # too little of the frame is flat
                    estimate = estimate_noise(bayer.unpack(exact.image, frame.cfa)[0], frame.cfa)
                    estimated = Noisy.of(exact.image, (estimate.shot_var, estimate.read_var), frame.cfa)
                    trials.append(_middle(estimated, middle, crop, ESTIMATED, name))

            if name in with_faults:
                faulty = draw_noisy(frame, name, levels, seed, real=True)
                trials.append(_middle(faulty, middle, crop, REAL, name))

    return trials


def draw_noisy(frame: Pair, strength: str, levels: NoiseLevels, seed: int, real: bool = False) -> Noisy:
    """Make a whole frame with noise of a strength, ``(1, 4, h, w)``.

    Args:
        frame: the clean reference.
        strength: a name; one that is not in :data:`STRENGTHS` stands for the caller's levels, whose noise is the same
            as in ``rawaug evaluate``.
        levels: the noise levels.
        seed: seed of the noise.
        real: whether to add the faults of sensors, :data:`_SENSOR`.
    """
    noise: NoiseModel = ShotReadNoise(levels)
    if real:
        noise = SensorNoise(levels, **_SENSOR)

    key: tuple[str, ...] = (TEST_NOISE,)
    if strength in STRENGTHS:
        key = "benchmark", strength

    packed = bayer.pack(frame.clean.mosaic[None], frame.cfa)
    noisy, _, exact = freeze_noise(packed, noise, seed, *key, frame.name)
    assert exact is not None
    return Noisy.of(noisy, exact, frame.cfa)


def _middle(noisy: Noisy, frame: Pair, crop: int, condition: str, strength: str) -> Trial:
    """Cut the middle out of a noisy frame and its clean one, ``crop`` pixels of the mosaic."""
    assert noisy.variance is not None
    side = crop // 2
    image = centre(noisy.image, side, side, step=1)
    variance = centre(noisy.variance, side, side, step=1)
    clean = bayer.pack(frame.clean.mosaic[None], frame.cfa)
    return raw_trial(frame, image, clean, variance, noisy.levels, frame.cfa, condition=condition, strength=strength)


def hash_trials(trials: Iterable[Trial]) -> str:
    """Eight digits of the SHA-256 of all noisy inputs, rounded to steps of 2^-12, on which all processors agree."""
    trials = list(trials)
    strengths = _strengths_in(trials)
    trials.sort(key=lambda trial: (_CONDITIONS.index(trial.condition), strengths.index(trial.strength)))

    images = []
    for trial in trials:
        steps = (trial.noisy * 4096).round().to(torch.int32)
        images.append(steps.numpy().tobytes())

    return digest(*images)[:8]


def benchmark(denoisers: Sequence[RawDenoiser], trials: Sequence[Trial]) -> dict[str, Any]:
    """Score every denoiser, by its name, on these :func:`benchmark_trials`, along with the noisy input.

    Returns:
        ``frames``, ``hash``, and ``rows`` by name: ``gmac`` and ``seconds`` per mosaic megapixel, and ``scores`` by
        condition and strength, means of :data:`rawaug.evaluation.scores.METRICS` and, in ``images``, the scores of each
        frame.
    """
    strengths = _strengths_in(trials)
    rows_by_name = group_rows(score([NOISY, *denoisers], trials, "benchmark"))

    rows: dict[str, dict[str, Any]] = {}
    for name, of_one in rows_by_name.items():
        rows[name] = {"gmac": None, "seconds": None, "scores": _by_condition(of_one, strengths)}

    for denoiser in denoisers:
        seconds = fmean(row.seconds for row in rows_by_name[denoiser.name])
        rows[denoiser.name]["seconds"] = round(seconds, 3)
        rows[denoiser.name]["gmac"] = count_gmac(denoiser)

    frames = list(dict.fromkeys(trial.frame for trial in trials))
    return {"frames": frames, "hash": hash_trials(trials), "rows": rows}


def _strengths_in(trials: Iterable[Trial]) -> list[str]:
    """List the strengths of these trials, in their order."""
    return list(dict.fromkeys(trial.strength for trial in trials))


def _by_condition(rows: Sequence[Row], strengths: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Average the scores of one denoiser by condition and strength; real sensors have only some of the strengths."""
    scores: dict[str, dict[str, Any]] = {}
    for condition in _CONDITIONS:
        of_condition = group_rows(rows, "condition").get(condition, [])
        of_strengths = group_rows(of_condition, "strength")
        for strength in strengths:
            cell = of_strengths.get(strength, [])
            if condition == REAL and not cell:
                continue

            means = summary(cell)
            figures: dict[str, Any] = {}
            for key in (*METRICS, "own_noise"):
                if key in means:
                    figures[key] = means[key]
            figures["frames"] = len(cell)
            figures["images"] = means["images"]
            scores.setdefault(condition, {})[strength] = figures

    return scores


def noise_note(trials: Sequence[Trial], strengths: Iterable[str], seed: int) -> str:
    """Describe the noise of :func:`benchmark_trials` in a sentence, by strength and levels, and that it is drawn."""
    parts = []
    for name in strengths:
        levels = []
        for trial in trials:
            if trial.levels is not None and (trial.condition, trial.strength) == (TOLD, name):
                levels.append(trial.levels)

        ranges = []
        for column in zip(*levels, strict=True):
            bounds = dict.fromkeys([f"{min(column):.2g}", f"{max(column):.2g}"])
            ranges.append(" to ".join(bounds))
        parts.append(f"{name} ({', '.join(ranges)})")

    return (
        "The noise is synthetic: Gaussian of variance shot_var y + read_var, drawn on clean frames with seed "
        f"{seed}, not a camera's own. Strengths, with shot_var and read_var: {'; '.join(parts)}."
    )


def count_gmac(denoiser: RawDenoiser) -> float | None:
    """Count the multiplications that PyTorch computes, in 10^9 a megapixel of the mosaic; None if there are none.

    They are counted on a whole tile, as on a user's frame: a smaller crop is padded, which costs up to twice as much.
    """
    side = _TILE // 2
    ramp = torch.linspace(0.0, 0.9, side).expand(1, 4, side, side)
    with FlopCounterMode(display=False) as counter:
        denoiser(Noisy.of(ramp, (1e-3, 1e-6), bayer.CFA.RGGB))

    return round(counter.get_total_flops() / 2e3 / ramp.numel(), 2) or None


def ranking(result: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each strength: by how much the best denoiser leads the next one, frame by frame."""
    for strength in result["rows"]["noisy input"]["scores"][TOLD]:
        means = {}
        for name, row in result["rows"].items():
            scores = row["scores"][TOLD][strength]
            if "psnr" in scores:
                means[name] = scores["psnr"]
        if len(means) < 2:
            continue

        first, second = sorted(means, key=lambda name: -means[name])[:2]
        gains = paired_gains(result, first, second, strength)
        line = f"{strength}: {first} against {second}: {fmean(gains):+.2f} dB"
        if len(gains) > 1:
            low, high = paired_interval(gains)
            line += f" (between {low:+.2f} and {high:+.2f})"
        ahead = sum(gain > 0 for gain in gains)
        yield f"{line}, ahead in {ahead} of {count_of(len(gains), 'frame')}"


def paired_gains(result: Mapping[str, Any], first: str, second: str, strength: str, key: str = "psnr") -> list[float]:
    """Subtract the scores of ``second`` from those of ``first``, frame by frame, where both have one; levels told."""
    of_first, of_second = (result["rows"][name]["scores"][TOLD][strength]["images"] for name in (first, second))
    gains = []
    for image, other in zip(of_first, of_second, strict=True):
        if key in image and key in other:
            gains.append(image[key] - other[key])
    return gains


def benchmark_tables(result: Mapping[str, Any]) -> Iterator[tuple[str, list[str], dict[str, list[str]]]]:
    """Yield title, columns and cells by denoiser of each condition's table; heads say how many could be estimated."""
    count = len(result["frames"])

    for condition in _CONDITIONS:
        of_input = result["rows"]["noisy input"]["scores"][condition]
        strength_of_ssim = display_strength(of_input)

        head = []
        for strength, scores in of_input.items():
            column = strength
            if scores["frames"] != count:
                column += f" ({scores['frames']} of {count} frames)"
            head.append(column)
        if condition == TOLD:
            head += [f"SSIM, {strength_of_ssim}", "GMAC", "s"]

        cells = {}
        for name, row in result["rows"].items():
            scores = row["scores"][condition]
            cells[name] = [join_figures(scores[strength], "psnr", "psnr_srgb") for strength in of_input]
            if condition == TOLD:
                cells[name].append(join_figures(scores[strength_of_ssim], "ssim", "ssim_srgb"))
                cells[name].append(_format_cost(row["gmac"]))
                cells[name].append(_format_cost(row["seconds"]))

        yield f"{condition}: PSNR of RAW / sRGB in dB", head, cells


def _format_cost(value: float | None) -> str:
    if value is None:
        return ""

    return f"{value:.2f}"


def collect_costs(result: Mapping[str, Any]) -> dict[str, tuple[float | None, float, float]]:
    """Get GMAC per megapixel and PSNR of RAW and sRGB, at the strength that is shown, by denoiser."""
    strength = display_strength(result["rows"]["noisy input"]["scores"][TOLD])
    costs = {}
    for name, row in result["rows"].items():
        if name == "noisy input":
            continue
        scores = row["scores"][TOLD][strength]
        costs[name] = row["gmac"], scores["psnr"], scores["psnr_srgb"]

    return costs


def display_strength(strengths: Collection[str]) -> str:
    """The strength whose pictures and SSIM are shown."""
    if "strong" in strengths:
        return "strong"

    *_, last = strengths
    return last


def make_crops(denoisers: Sequence[RawDenoiser], trials: Iterable[Trial]) -> Iterator[Panels]:
    """Make pictures for the page: the first few frames with noise of :func:`display_strength`, by denoiser."""
    trials = list(trials)
    strength = display_strength(_strengths_in(trials))
    count = 0
    for trial in trials:
        if trial.condition == TOLD and trial.strength == strength and count < _MOST_SHOWN:
            yield make_panels(denoisers, trial)
            count += 1
