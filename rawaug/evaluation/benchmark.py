r"""Denoisers side by side: the same frozen noise on the same clean references, at four strengths.

.. math:: \operatorname{var}(y) = \mathrm{shot\_var}\, y + \mathrm{read\_var}

Each denoiser is told the levels as they are, and once more as they are estimated from the noisy frame, which is what a
photographer has. A second table has sensors as they are: hot pixels, banding, black levels and colours that are a
little off, rounding to 12 bits. A reference is the middle of a frame, binned by colour site if it has noise of its own.
A denoiser is what :func:`rawaug.evaluation.contestants.contestant` finds. The hash of all noisy inputs says whether the
figures of two people can be compared.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain, product
from statistics import fmean
from typing import Any

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.data.pairs import Pair, Sample, centre
from rawaug.evaluation.contestants import Contestant
from rawaug.evaluation.scores import compared
from rawaug.evaluation.tables import METRICS, Row, both
from rawaug.files import digest
from rawaug.metrics import psnr
from rawaug.noise import FixedLevels, NoiseLevels, SensorNoise, ShotReadNoise, estimate_noise, noise_levels
from rawaug.progress import progress
from rawaug.seeding import keyed_generator

STRENGTHS = {
    "base ISO": (2.3e-4, 2e-6),
    "phone": (1.8e-3, 1.2e-5),
    "strong": (7e-3, 1.8e-4),
    "very strong": (2.8e-2, 2.5e-3),
}
"""(shot_var, read_var): of Google's Pixel at ISO 100, 800 and 3200 by its tags, and two stops more."""
SENSOR: dict[str, Any] = {
    "row_var": 2e-6,
    "black_offset_sd": 5e-4,
    "colour_bias_sd": 5e-4,
    "hot": 2e-4,
    "bits": 12,
    "black_level": 64,
}
"""What sensors do besides, at the strengths of :data:`OF_SENSORS`, or at the caller's."""
OF_SENSORS = ("phone", "strong")
TOLD, ESTIMATED, REAL = "levels told", "levels estimated", "sensors as they are"


def strengths_of(
    noise: str | Sequence[float] | Sequence[str] | None = None, isos: Sequence[float] | None = None
) -> dict[str, NoiseLevels]:
    """Noise levels by the name of their column: :data:`STRENGTHS`, or those of ``noise``, at each ISO if it has any."""
    if noise is None:
        if isos:
            raise ValueError("iso: needs the name of a camera as noise")
        return {name: FixedLevels(*levels) for name, levels in STRENGTHS.items()}
    if not isos:
        return {str(noise): noise_levels(noise)}
    return {f"ISO {iso:g}": noise_levels(noise, iso=iso) for iso in isos}


Columns = dict[tuple[str, str], list[Sample | None]]
"""By condition and strength the noisy inputs, a sample a frame; None where its levels cannot be estimated."""


def columns_of(
    frames: Sequence[Pair], crop: int, seed: int = 0, strengths: Mapping[str, NoiseLevels] | None = None
) -> Columns:
    """The middles of all frames under every condition and strength; the same bits for the same frames and seed.

    Noise is put on whole frames, from which the levels are estimated.
    """
    strengths = strengths or strengths_of()
    of_sensors = [name for name in strengths if name in OF_SENSORS] or strengths
    columns: Columns = {pair: [] for pair in [*product((TOLD, ESTIMATED), strengths), *product((REAL,), of_sensors)]}
    for frame in progress(frames, label="noise", unit="frame"):
        for name, levels in strengths.items():
            told, real = (noisy_sample(frame, name, levels, seed, real) for real in (False, True))
            for condition, sample in ((TOLD, told), (ESTIMATED, _estimated(told, frame.cfa)), (REAL, real)):
                if (condition, name) in columns:
                    columns[condition, name].append(sample and middle_of(sample, crop))
    return columns


def noisy_sample(frame: Pair, strength: str, levels: NoiseLevels, seed: int, real: bool = False) -> Sample:
    """A whole frame with noise of a strength, ``(1, 4, h, w)``; that of the caller's levels is that of ``evaluate``."""
    noise = SensorNoise(levels, **SENSOR) if real else ShotReadNoise(levels)
    clean = bayer.pack(frame.raw[None], frame.cfa)
    key = ("benchmark", strength) if strength in STRENGTHS else ("test noise",)
    params = noise.sample(1, keyed_generator(seed, *key, frame.name))
    noisy = noise.apply(clean, params)
    return Sample(noisy, clean, noise_variance(noisy, params["shot_var"].item(), params["read_var"].item()))


def _estimated(sample: Sample, cfa: CFA) -> Sample | None:
    try:
        found = estimate_noise(bayer.unpack(sample.noisy, cfa)[0], cfa)
    except ValueError:  # too little of the frame is flat
        return None
    return Sample(sample.noisy, sample.clean, noise_variance(sample.noisy, found.shot_var, found.read_var))


def middle_of(sample: Sample, crop: int) -> Sample:
    """The middle of packed RAW as :meth:`rawaug.data.Pair.middle` takes it, ``crop`` pixels of the mosaic."""
    return Sample(*(centre(image, crop // 2, crop // 2, step=1) for image in sample))


def hash_of(columns: Columns) -> str:
    """Eight digits of the SHA-256 of all noisy inputs, in steps of 2^-12, which processors do not round differently."""
    samples = filter(None, chain.from_iterable(columns.values()))
    return digest(*((sample.noisy * 4096).round().to(torch.int32).numpy().tobytes() for sample in samples))[:8]


def benchmark(
    contestants: Sequence[Contestant],
    frames: Sequence[Pair],
    crop: int,
    seed: int = 0,
    strengths: Mapping[str, NoiseLevels] | None = None,
) -> dict[str, Any]:
    """Scores of every denoiser, by its name, on the middles of the references, beside those of the noisy input.

    Returns:
        ``frames``, ``hash``, and ``rows`` by name: ``gmac`` and ``seconds`` a mosaic megapixel, and ``scores`` by
        condition and strength, means of :data:`rawaug.evaluation.tables.METRICS`.
    """
    columns = columns_of(frames, crop, seed, strengths)
    frames = [frame.middle(crop) for frame in frames]
    inputs = Contestant("noisy input", lambda noisy, variance, cfa: noisy)
    rows = {one.name: _row(one, frames, columns) for one in (inputs, *contestants)}
    rows["noisy input"] |= {"gmac": None, "seconds": None}
    return {"frames": [frame.name for frame in frames], "seed": seed, "hash": hash_of(columns), "rows": rows}


def _row(one: Contestant, frames: Sequence[Pair], columns: Columns) -> dict[str, Any]:
    first = next(filter(None, chain.from_iterable(columns.values())))
    megapixels = first.noisy.numel() / 1e6
    with FlopCounterMode(display=False) as counter:  # of what PyTorch computes; it warms up, too
        denoised_by(one, first, frames[0].cfa)
    gmac = counter.get_total_flops() / 2e9 / megapixels
    scores: dict[str, dict[str, dict[str, float]]] = {}
    seconds: list[float] = []
    for (condition, strength), samples in progress(columns.items(), label=one.name, unit="column"):
        found, own, errors = [], [], []
        for frame, sample in zip(frames, samples, strict=True):
            if sample is None:
                continue
            start = time.perf_counter()
            denoised = denoised_by(one, sample, frame.cfa)
            seconds.append((time.perf_counter() - start) / (sample.noisy.numel() / 1e6))
            found.append(compared(denoised, sample.clean, frame.cfa, frame))
            if frame.own_noise is not None:
                own.append(noise_variance(sample.clean, *frame.own_noise).mean().item())
                errors.append(10 ** (-found[-1][0] / 10))
        means: dict[str, float] = dict(zip(METRICS, map(fmean, zip(*found, strict=True)), strict=True)) if found else {}
        share = {"own_noise": sum(own) / sum(errors)} if own else {}
        scores.setdefault(condition, {})[strength] = means | {"frames": len(found)} | share
    return {"gmac": round(gmac, 2) or None, "seconds": round(fmean(seconds), 3), "scores": scores}


def denoised_by(one: Contestant, sample: Sample, cfa: CFA) -> Tensor:
    try:
        with torch.inference_mode():
            denoised = one.run(sample.noisy.clone(), sample.variance.clone(), cfa)
    except Exception as error:  # anybody's function
        raise ValueError(f"{one.name}: {type(error).__name__}: {' '.join(str(error).split())}") from error
    if denoised.shape != sample.noisy.shape or not denoised.isfinite().all():
        shape = f"{tuple(denoised.shape)} for {tuple(sample.noisy.shape)}"
        raise ValueError(f"{one.name}: the result is not finite, or of another shape: {shape}")
    return denoised.float()


def tables(result: Mapping[str, Any]) -> Iterator[tuple[str, list[str], dict[str, list[str]]]]:
    """Title, columns and cells of each condition's table; of frames whose levels cannot be estimated there are none."""
    for condition in (TOLD, ESTIMATED, REAL):
        scored = {name: at["frames"] for name, at in result["rows"]["noisy input"]["scores"][condition].items()}
        count = len(result["frames"])
        head = [name if n == count else f"{name} ({n} of {count} frames)" for name, n in scored.items()]
        shown = shown_of(scored)
        head += [f"SSIM, {shown}", "GMAC", "s"] if condition == TOLD else []
        cells = {}
        for name, row in result["rows"].items():
            scores = row["scores"][condition]
            cells[name] = [both(scores[strength], "psnr", "psnr_srgb") for strength in scored]
            if condition == TOLD:
                costs = ["" if row[key] is None else f"{row[key]:.2f}" for key in ("gmac", "seconds")]
                cells[name] += [both(scores[shown], "ssim", "ssim_srgb"), *costs]
        yield f"{condition}: PSNR of RAW / sRGB in dB, {count} frame{'s' * (count != 1)}", head, cells


def costs_of(result: Mapping[str, Any]) -> dict[str, tuple[float | None, float, float]]:
    """GMAC a megapixel and the PSNR of RAW and sRGB of each denoiser, at the strength that is shown."""
    shown = shown_of(result["rows"]["noisy input"]["scores"][TOLD])
    scored = {name: (row["gmac"], row["scores"][TOLD][shown]) for name, row in result["rows"].items()}
    return {
        name: (gmac, scores["psnr"], scores["psnr_srgb"])
        for name, (gmac, scores) in scored.items()
        if name != "noisy input"
    }


def shown_of(strengths: Collection[str]) -> str:
    """The strength whose pictures and SSIM are shown."""
    *_, last = strengths
    return "strong" if "strong" in strengths else last


def crops(
    contestants: Sequence[Contestant],
    frames: Sequence[Pair],
    crop: int,
    seed: int,
    strengths: Mapping[str, NoiseLevels],
) -> Iterator[tuple[Row, CFA]]:
    """Pictures for the page: each frame with noise of :func:`shown_of`, by every denoiser, and clean."""
    shown = shown_of(strengths)
    for frame in frames:
        sample = middle_of(noisy_sample(frame, shown, strengths[shown], seed), crop)
        row = Row(frame.middle(crop), {"noisy": sample.noisy}, {})
        for one in contestants:
            row.panels[one.name] = denoised_by(one, sample, frame.cfa)
        for name, panel in row.panels.items():
            row.captions[name] = f"{psnr(panel, sample.clean).item():.2f} dB"
        row.panels["clean"] = sample.clean
        yield row, frame.cfa
