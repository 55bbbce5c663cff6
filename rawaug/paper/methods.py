"""The methods of the reconstruction table, on equal terms: fitted to the same pairs, scored on the same patches.

A family is fitted once and may fill several rows: the dictionary ISP is scored blind, with the as-shot white balance,
and with 64 RAW samples. Networks that can hide RAW in a picture have a row for RAW that comes back from their own
rendering. A shipped ISP, or the file of one, is not fitted; a frame that it was fitted to before is marked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.evaluation.psnr_r import block_psnr, draw_windows, psnr_r, windows_psnr
from rawaug.files import find_weights
from rawaug.isp.config import ISPParams
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import cycle_error
from rawaug.isp.fit.samples import block_averages, sample_pixels
from rawaug.isp.functional import as_float, coordinates_or_full
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import PATCH, psnr
from rawaug.paper.balanced import balanced_psnr
from rawaug.paper.baselines import BASELINES, CycleISP, Training, fit_baseline
from rawaug.paper.baselines.base import BaselineISP, CropTrainedISP
from rawaug.paper.baselines.invisp import JPEG_QUALITY, CompressedISP
from rawaug.paper.baselines.jpeg import jpeg
from rawaug.seeding import keyed_generator

FAMILIES = ("dictionary", "dictionary-encoders", *BASELINES)
ROWS = {"as-shot": "as-shot gains", "samples": "64 RAW samples", "own": "own rendering"}
SAMPLES = 64
PIXELS = 8192
"""Number of pixels of a frame on which the forward pass is scored."""
Method = BaselineISP | DictionaryISP


class Fitted(NamedTuple):
    """A method after its fit, the time that it took, and the number of parameters of its reverse pass."""

    model: Method
    seconds: float
    parameters: int


def is_method(family: str) -> bool:
    """Tell whether this is a family to fit, the name of a shipped ISP, or an ISP's file."""
    if family in FAMILIES:
        return True
    try:
        find_weights(family)
    except FileNotFoundError:
        return False
    return True


def learns_by_descent(family: str) -> bool:
    """Tell whether a family trains on crops: it then has a budget and needs pairs registered pixel by pixel."""
    return family in BASELINES and issubclass(BASELINES[family], CropTrainedISP)


def fit_family(
    family: str,
    pairs: Sequence[Pair],
    config: FitConfig,
    training: Training,
    sizes: Mapping[str, Any] | None = None,
) -> Fitted:
    """Fit a family to pairs of one CFA.

    Args:
        family: one of :data:`FAMILIES`, or an ISP to take as it is, by a shipped one's name or a file.
        pairs: the frames to fit.
        config: settings of the dictionary ISP's fit.
        training: budget and crops of the networks; its seed is used by every family.
        sizes: settings of the baseline's class, such as the width of a network; None for the published ones.

    Raises:
        ValueError: if the ISP's CFA is not that of the frames, or the class has no such setting.
    """
    start = time.perf_counter()
    cfa = CFA(pairs[0].cfa)
    model: Method

    if family.startswith("dictionary"):
        encoders: Any = "on" if family == "dictionary-encoders" else "off"
        model = fit_isp(pairs, replace(config, seed=training.seed, encoders=encoders))
    elif family in BASELINES:
        settings = dict(sizes or {})
        if learns_by_descent(family):
            settings["seed"] = training.seed
        baseline = BASELINES.make({"name": family, "settings": settings}, cfa=cfa.value)
        model = fit_baseline(baseline, pairs, training)
    else:
        model = DictionaryISP.from_pretrained(family)
        if model.cfa != cfa:
            raise ValueError(f"{family}: makes {model.cfa.value} RAW, but the frames are {cfa.value}")
        return Fitted(model, 0.0, reverse_parameters(model))

    return Fitted(model, time.perf_counter() - start, reverse_parameters(model))


def end_to_end(info: Mapping[str, Any]) -> dict[str, Any]:
    """Give the steps and the curve of an ISP's end-to-end training from its fit's record; empty without a curve.

    The curve has the squared error on held-out frames, as the curves of networks have their losses.
    """
    if "curve" not in info.get("joint", {}):
        return {}

    curve = []
    for decibels in info["joint"]["curve"]:
        curve.append(10.0 ** (-decibels / 10.0))
    return {"steps": info["joint"]["steps"], "curve": curve}


def reverse_parameters(model: Method) -> int:
    """Count the parameters of the reverse pass."""
    counted = getattr(model, "reverse_network", model)
    total = 0
    for name, parameter in counted.named_parameters():
        forward_alone = name.startswith("forward_") or ".forward_" in name
        if not forward_alone:
            total += parameter.numel()
    return total


# -- RAW from sRGB ----------------------------------------------------------------------------------------------------


def score_rows(fitted: Fitted, pair: Pair, patches: int | None, balanced: bool = False) -> dict[str, Any]:
    """Score a method on a frame.

    Args:
        fitted: the method.
        pair: the frame. One that is not registered is compared as averages over blocks, and has only PSNR_r.
        patches: number of random patches; None scores all.
        balanced: whether InvISP's figure (:mod:`rawaug.paper.balanced`) is also measured, on the whole frame.

    Returns:
        ``rows``, the PSNR_r in dB of every row that the family fills; ``balanced``, InvISP's figure of each, or empty;
        ``mpix_s``, the speed of the reverse pass; ``forward``, as :func:`forward_psnr` measures it; ``known``, whether
        the method is an ISP that was fitted to this very frame before.
    """
    pair.require_rendered()
    model = fitted.model
    seen_before = isinstance(model, DictionaryISP) and pair.name in model.info.get("frames", ())
    if not pair.registered:
        rows = _block_rows(model, pair)
        return {"rows": rows, "balanced": {}, "mpix_s": None, "forward": None, "known": seen_before}

    makers = {}
    for row, setting in settings(model, pair).items():
        makers[row] = raw_maker(model, setting)

    start = time.perf_counter()
    rows = {row: windows_psnr(make, pair, patches) for row, make in makers.items()}
    seconds = time.perf_counter() - start

    height, width = pair.clean.mosaic.shape[-2:]
    area = min(PATCH, height) * min(PATCH, width)
    pixels = len(makers) * len(draw_windows(pair, patches)) * area

    rendered = own_rendering(model, pair)
    if rendered is not None:
        makers["own"] = raw_maker(model, pair.clean.white_balance)
        rows["own"] = windows_psnr(makers["own"], rendered, patches)

    figures = {}
    if balanced:
        for row, make in makers.items():
            figures[row] = balanced_psnr(make, pair)
        if rendered is not None:
            figures["own"] = balanced_psnr(makers["own"], rendered)

    return {
        "rows": rows,
        "balanced": figures,
        "mpix_s": pixels / seconds / 1e6,
        "forward": forward_psnr(model, pair),
        "known": seen_before,
    }


def raw_maker(model: Method, setting: Any) -> Callable[[Tensor, Tensor], Tensor]:
    """Make the function that turns a patch into RAW under a setting.

    It maps an sRGB patch ``(1, 3, h, w)`` and its coordinates in the frame to a mosaic ``(1, 1, h, w)``.
    """
    if isinstance(model, DictionaryISP):
        return lambda patch, coordinates: model.reverse(patch, setting, coordinates=coordinates).raw
    return lambda patch, coordinates: model.reverse(patch, setting)


def settings(model: Method, pair: Pair) -> dict[str, Any]:
    """Make the camera setting of each row; a method that does not use gains has one row."""
    if isinstance(model, DictionaryISP):
        return dictionary_params(model, pair)

    rows: dict[str, Any] = {"blind": None}
    if pair.balance_known:
        as_shot = model.as_shot_setting(pair.clean.white_balance)
        if as_shot is not None:
            rows["as-shot"] = as_shot
    return rows


@torch.no_grad()
def own_rendering(model: Method, pair: Pair) -> Pair | None:
    """Replace the picture of a pair by the method's own rendering of the RAW, stored as a JPEG of quality 90.

    InvISP's published figures are for this case. None is returned for methods that do not hide RAW in their pictures.
    """
    if not isinstance(model, CompressedISP):
        return None
    picture = model(pair.clean.mosaic[None], model.as_shot_setting(pair.clean.white_balance))
    compressed = (255.0 * jpeg(picture, JPEG_QUALITY)[0]).round().to(torch.uint8)
    return replace(pair, srgb=compressed)


def _block_rows(model: Method, pair: Pair) -> dict[str, float]:
    if isinstance(model, DictionaryISP):
        rows = {"blind": psnr_r(model, pair)}
        if pair.balance_known:
            rows["as-shot"] = psnr_r(model, pair, white_balance=True)
        return rows

    srgb, raw, clipped, _ = block_averages(pair.srgb, pair.clean.mosaic, pair.cfa)
    with torch.no_grad():
        colour = model.unprocess(srgb[None])[0]
    return {"blind": block_psnr(colour, raw, clipped)}


@torch.no_grad()
def dictionary_params(isp: DictionaryISP, pair: Pair) -> dict[str, ISPParams]:
    """Make the camera settings of the dictionary's rows for a frame."""
    blind = isp.choose(pair.srgb[None])
    rows = {"blind": blind}
    if pair.balance_known:
        rows["as-shot"] = isp.with_white_balance(blind, pair.clean.white_balance)

    generator = keyed_generator("raw samples", pair.name)
    height, width = pair.clean.mosaic.shape[-2:]
    row = torch.randint(height, (SAMPLES,), generator=generator)
    column = torch.randint(width, (SAMPLES,), generator=generator)

    readings = torch.stack([row.float(), column.float(), pair.clean.mosaic[0, row, column]], dim=1)[None]
    x = as_float(pair.srgb[None])
    rows["samples"] = isp.with_raw_samples(blind, x, readings, coordinates_or_full(x, None))
    return rows


# -- sRGB from RAW, and the cycle -------------------------------------------------------------------------------------


@torch.no_grad()
def forward_psnr(model: Method, pair: Pair) -> float | None:
    """Measure PSNR in dB from RAW to sRGB, pixel by pixel, under the setting that the method finds in the RAW.

    CycleISP is given the picture itself for its colours, as published. None is returned for methods that do not render,
    and if the dictionary's frame does not state its colours.
    """
    if isinstance(model, DictionaryISP):
        if not pair.clean.color_known:
            return None
        part = sample_pixels([pair], PIXELS, seed=0).pixels
        error = cycle_error(model, part, model.forward(pair.clean.mosaic[None]).params, {}, FitConfig())
        return float(-10.0 * error.log10())

    if not can_render(model):
        return None
    srgb = as_float(pair.srgb[None])
    setting = model.as_shot_setting(pair.clean.white_balance)
    if isinstance(model, CycleISP):
        setting = srgb
    return psnr(model(pair.clean.mosaic[None], setting), srgb).item()


def can_render(model: BaselineISP) -> bool:
    """Tell whether a baseline, as it was trained, renders RAW."""
    return model.renders and getattr(model, "both", True)


@torch.no_grad()
def cycle_psnr(fitted: Fitted, pictures: Sequence[Tensor]) -> dict[str, float]:
    """Measure the mean PSNR in dB of a method from sRGB to RAW and back, over uint8 pictures ``(3, H, W)``.

    ``cycle`` is the paper's: the way back finds its own setting in the RAW, by its own encoders. The dictionary ISP has
    two more: ``cycle_same_setting`` gives the way back the setting of the way to RAW, and ``cycle_without_mosaic`` also
    leaves out the mosaic. A method that does not render has none.
    """
    model = fitted.model
    scores: dict[str, list[float]] = {}

    for picture in pictures:
        x = as_float(picture[None])
        for cycle, returned in _cycles(model, x).items():
            scores.setdefault(cycle, []).append(psnr(returned, x).item())

    return {cycle: fmean(values) for cycle, values in scores.items()}


def _cycles(model: Method, x: Tensor) -> dict[str, Tensor]:
    """Compute, for each way, the pictures ``(B, 3, H, W)`` that come back from ``x``, of the same shape."""
    if not isinstance(model, DictionaryISP):
        if not can_render(model):
            return {}
        return {"cycle": model.cycle(x)}

    there = model.reverse(x)
    raw = there.raw.clamp(0.0, 1.0)
    return {
        "cycle": model.forward(raw).srgb,
        "cycle_same_setting": model.forward(raw, there.params).srgb,
        "cycle_without_mosaic": cycle_without_mosaic(model, x),
    }


def cycle_without_mosaic(isp: DictionaryISP, srgb: Tensor) -> Tensor:
    """Convert sRGB ``(B, 3, H, W)`` to x5 and back under one setting, which shows what the stages alone lose."""
    params = isp.choose(srgb)
    return isp.stages.forward(isp.stages.reverse(srgb, params), params).clamp(0.0, 1.0)


def mosaic_only_psnr(pictures: Sequence[Tensor], cfa: CFA | str = "RGGB") -> float:
    """Measure mean PSNR in dB of pictures ``(3, H, W)`` after mosaic and bilinear interpolation, a cycle's ceiling."""
    scores = []
    for picture in pictures:
        x = as_float(picture[None])
        returned = bayer.demosaic(bayer.mosaic(x, cfa), cfa).clamp(0.0, 1.0)
        scores.append(psnr(returned, x).item())
    return fmean(scores)
