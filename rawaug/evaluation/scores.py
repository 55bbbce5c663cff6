"""PSNR and SSIM of an ISP or a denoiser, image by image.

An ISP's PSNR_r is the mean over non-overlapping 256 x 256 mosaic patches of reconstruction against RAW. A denoiser's
PSNR_d and SSIM are taken on the whole mosaic, on frozen noise: the captured one, or one keyed by (seed, name); and once
more on sRGB, after one fixed development (:func:`rawaug.data.development.develop_packed`) of result and clean frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

import denoisers
from denoisers.classical import Stabilised
from denoisers.network import PACKED, Denoiser
from rawaug import bayer
from rawaug.bayer import CFA, aligned
from rawaug.data.development import develop_packed, exposure_of
from rawaug.data.pairs import Pair, Sample
from rawaug.evaluation.tables import METRICS, Row
from rawaug.metrics import psnr, ssim, worst_and_best_quarter
from rawaug.noise import NoiseModel, anscombe
from rawaug.progress import progress
from rawaug.registry import FILTERS, Spec, name_and_settings
from rawaug.seeding import keyed_generator

Run = Callable[..., Tensor]
"""``run(noisy, variance) -> denoised``, packed RAW."""
SHOWN_FAULTS = 5

Method = Callable[[Pair, Sample], Tensor]
"""Denoises the packed RAW of a sample; of the pair it may use the noise levels only."""


@dataclass(frozen=True)
class Score:
    """Of one image, on the mosaic and developed to sRGB; ``noisy`` ones are those of the input.

    ``shot_var`` and ``read_var`` are the noise levels that the denoiser was given, if it was given any;
    ``levels_from_clean`` is True where they had been measured against the clean frame, else None.
    """

    name: str
    psnr: float
    ssim: float | None = None
    psnr_srgb: float | None = None
    ssim_srgb: float | None = None
    psnr_noisy: float | None = None
    ssim_noisy: float | None = None
    psnr_srgb_noisy: float | None = None
    ssim_srgb_noisy: float | None = None
    shot_var: float | None = None
    read_var: float | None = None
    levels_from_clean: bool | None = None


def frozen_sample(pair: Pair, noise: NoiseModel, cfa: CFA, seed: int) -> Sample:
    """The frame as a test case ``(1, 4, h, w)``: its own captured noise, or noise keyed by (seed, name)."""
    pair = pair.with_levels()
    clean = bayer.pack(aligned(pair.raw, pair.cfa, cfa)[None], cfa)
    if pair.noisy is not None and pair.shot_var is not None and pair.read_var is not None:
        noisy = bayer.pack(aligned(pair.noisy, pair.cfa, cfa)[None], cfa)
        return Sample(noisy, clean, bayer.noise_variance(noisy, pair.shot_var, pair.read_var))
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    noisy = noise.apply(clean, params)
    return Sample(noisy, clean, noise.variance(noisy, params))


@torch.inference_mode()
def denoise(
    model: Denoiser,
    sample: Sample,
    cfa: CFA,
    views: int = 1,
    own: CFA | None = None,
    at_test: Callable[[Run], Run] | None = None,
) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` denoised where the model is, in tiles if it is large; linear RGB if it demosaics.

    Args:
        cfa: of the sample's mosaic.
        views: 1, or 4 or 8 of a self-ensemble.
        own: the pattern that the model was trained for, if another: the mosaic is continued by a mirrored line on the
            sides where the patterns differ, and the result cropped.
        at_test: what the estimator of the training puts around the network.
    """
    if own is not None and own != cfa:
        rows, columns = cfa.shift_to(own)
        mosaics = (bayer.unpack(x, cfa) for x in (sample.noisy, sample.variance))
        noisy, variance = (bayer.pack(F.pad(x, (columns, columns, rows, rows), mode="reflect"), own) for x in mosaics)
        denoised = denoise(model, Sample(noisy, noisy, variance), own, views, at_test=at_test)
        packed = denoised.shape[1] == PACKED
        image = aligned(bayer.unpack(denoised, own) if packed else denoised, own, cfa)
        return bayer.pack(image, cfa) if packed else image
    run: Run = partial(denoisers.tiled, model, each=counted("tile"))
    if at_test is not None:
        run = at_test(run)
    if views > 1:
        run = denoisers.SelfEnsemble(run, cfa, views=views, each=counted("view group"))
    device = next(model.parameters(), sample.noisy).device
    result: Tensor = run(sample.noisy.to(device), sample.variance.to(device))
    return result.cpu()


def counted(unit: str) -> Callable[[Sequence[Any]], Iterable[Any]]:
    """Goes through the parts of a frame, where there are several with progress: its tiles, or views of one shape."""
    return lambda parts: progress(parts, label="frame", unit=unit) if len(parts) > 1 else iter(parts)


def tested(method: Method, pair: Pair, noise: NoiseModel, cfa: CFA, seed: int) -> tuple[Score, Sample, Tensor]:
    """The scores of a frame, its test case and the method's result."""
    pair = pair.with_levels()
    sample = frozen_sample(pair, noise, cfa, seed)
    denoised = method(pair, sample)
    values = (*compared(denoised, sample.clean, cfa, pair), *compared(sample.noisy, sample.clean, cfa, pair))
    shot_var, read_var = frozen_levels(pair, noise, seed) or (None, None)
    return Score(pair.name, *values, shot_var, read_var, pair.levels_from_clean or None), sample, denoised


def score_method(
    method: Method, pairs: Sequence[Pair], noise: NoiseModel, cfa: CFA, seed: int, label: str
) -> Iterator[Score]:
    """The scores of every frame, one in memory at a time."""
    for pair in progress(pairs, label=label, unit="image"):
        yield tested(method, pair, noise, cfa, seed)[0]


def network_method(
    model: Denoiser, cfa: CFA, own: CFA | None = None, views: int = 1, at_test: Callable[[Run], Run] | None = None
) -> Method:
    """A network as something to score; arguments as in :func:`denoise`."""
    return lambda _, sample: denoise(model, sample, cfa, views, own, at_test)


def row_of(methods: Mapping[str, Method], pair: Pair, noise: NoiseModel, cfa: CFA, seed: int) -> Row:
    """Panels of a frame: noisy, denoised by each method, clean."""
    row = Row(pair, {}, {})
    for name, method in methods.items():
        score, sample, denoised = tested(method, pair, noise, cfa, seed)
        row.panels |= {} if "noisy" in row.panels else {"noisy": sample.noisy}
        row.panels[name] = denoised
        row.captions |= {"noisy": f"{score.psnr_noisy:.2f} dB", name: f"{score.psnr:.2f} dB"}
    row.panels["clean"] = sample.clean
    row.captions["clean"] = pair.name
    return row


def compared(packed: Tensor, clean: Tensor, cfa: CFA, pair: Pair) -> tuple[float, float, float, float]:
    """PSNR and SSIM on the mosaic and on sRGB of packed RAW ``(1, 4, h, w)`` against the clean one."""
    exposure = exposure_of(clean, pair)
    raw = [bayer.unpack(x, cfa) for x in (packed, clean)]
    srgb = [develop_packed(x, cfa, pair, exposure)[None] for x in (packed, clean)]
    return psnr(*raw).item(), ssim(*raw).item(), psnr(*srgb).item(), ssim(*srgb).item()


def require_classical(specs: Sequence[Spec]) -> None:
    """Check names, settings and libraries of classical denoisers."""
    for spec in specs:
        reason = FILTERS.make(spec).missing()
        if reason is not None:
            raise ValueError(f"classical: {name_and_settings(spec)[0]}: {reason}")


def installed_classical(specs: Sequence[Spec], shown: bool = True) -> list[Spec]:
    """The classical denoisers of a recipe, without BM3D where its wheel is missing, which is then printed if
    ``shown``.
    """
    bm3d = {"BM3D": FILTERS["BM3D"].missing()}
    kept = [spec for spec in specs if not bm3d.get(name_and_settings(spec)[0])]
    if shown and len(kept) < len(specs):
        print(f"classical: BM3D is left out: {bm3d['BM3D']}")
    require_classical(kept)
    return kept


def classical_method(spec: Spec, noise: NoiseModel, seed: int) -> Method:
    """A classical denoiser as something to score; shot noise is stabilised before and after."""
    denoiser = FILTERS.make(spec)

    def method(pair: Pair, sample: Sample) -> Tensor:
        levels = frozen_levels(pair, noise, seed)
        if levels is None:
            denoised: Tensor = denoiser(sample.noisy, sample.variance)
            return denoised
        return Stabilised(denoiser, anscombe)(sample.noisy, shot_var=levels[0], read_var=levels[1])

    return method


def frozen_levels(pair: Pair, noise: NoiseModel, seed: int) -> tuple[float, float] | None:
    """(shot_var, read_var) of what :func:`frozen_sample` gives; None if the noise is of another kind."""
    pair = pair.with_levels()
    if pair.noisy is not None and pair.shot_var is not None and pair.read_var is not None:
        return pair.shot_var, pair.read_var
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    return (params["shot_var"].item(), params["read_var"].item()) if "shot_var" in params else None


def label_of(spec: Spec) -> str:
    """A classical denoiser's name in tables."""
    name, settings = name_and_settings(spec)
    return " ".join([name, *(f"{key}={value}" for key, value in settings.items())])


def summary(scores: Iterable[Score]) -> dict[str, Any]:
    """Per image, mean, worst and best 25%; what does not apply is left out.

    ``levels_from_clean`` counts the images whose noise levels were measured against the clean frame; ``no_numbers``
    names scores that are none, such as the PSNR of two equal frames.
    """
    scores, stated = list(scores), ("name", "shot_var", "read_var", "levels_from_clean")
    images = [{key: value for key in stated if (value := getattr(score, key)) is not None} for score in scores]
    result: dict[str, Any] = {"images": images}
    if flagged := sum(bool(score.levels_from_clean) for score in scores):
        result["levels_from_clean"] = flagged
    wrong: list[str] = []
    for key in (*METRICS, *(f"{metric}_noisy" for metric in METRICS)):
        known = []
        for image, score in zip(images, scores, strict=True):
            value = getattr(score, key)
            if value is not None and math.isfinite(value):
                image[key] = value
                known.append(value)
            elif value is not None:
                wrong.append(f"{score.name}: {key} is {value}")
        if known:
            result[key] = sum(known) / len(known)
            result[f"{key}_worst25"], result[f"{key}_best25"] = worst_and_best_quarter(known)
    return result | ({"no_numbers": wrong} if wrong else {})


def require_numbers(summaries: Iterable[Mapping[str, Any]]) -> None:
    """Report scores that summaries omitted, once all else is printed and written."""
    faults = [fault for one in summaries for key in ("broken", "no_numbers") for fault in one.get(key, ())]
    if faults:
        more = f"; and {len(faults) - SHOWN_FAULTS} more" if len(faults) > SHOWN_FAULTS else ""
        raise ValueError(f"left out of the means: {'; '.join(faults[:SHOWN_FAULTS])}{more}")
