r"""The methods of the reconstruction table, on equal terms: fitted to the same pairs, scored on the same patches.

A family is fitted once and may fill several rows: the dictionary ISP blind, with the as-shot white balance, with 64 RAW
samples, and with the best setting that can be found (oracle). A shipped ISP, or the file of one, is not fitted.

The oracle is the setting of an ISP that comes closest to a frame's RAW,

.. math:: \min_{w, v, g} \; \log \bigl( \| y - f^{-1}(x; w, v, g) \|^2 / P + \epsilon \bigr)

over the weights of the atoms and, for an ISP of published cameras, the gains. Descent starts where alternating least
squares end (:mod:`rawaug.isp.staged`), with all P pixels for readings; of a fitted ISP, whose gains stay within
the hull of its own, from the middle of the hulls. The settings of rows that know less are compared as well.

InvISP's figure on MIT-Adobe FiveK is the PSNR of demosaiced, white-balanced and gamma-compressed RAW,

.. math:: z(y) = \left(\frac{w}{\max w} \, \mathrm{demosaic}(y)\right)^{1/2.2}, \qquad
    \mathrm{PSNR} = -10 \log_{10} \mathrm{mean} (z(\hat y) - z(y))^2

with the as-shot white balance w, bilinear interpolation and :math:`\hat y` within [0, 1]: the mean over a frame's 3 x 3
equal pieces, which begin at even sites here. Source: Xing et al., CVPR 2021, and the authors' published scripts.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.camera.psnr_r import block_psnr, psnr_r, windows_of, windows_psnr
from rawaug.data.pairs import Pair
from rawaug.files import find_weights, write_json
from rawaug.isp import staged
from rawaug.isp.config import ISPParams
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.samples import PixelSamples, block_averages, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import as_float, coordinates_or_full, frame_coordinates
from rawaug.metrics import PATCH, psnr
from rawaug.paper.baselines import BASELINES, Training, fit_baseline
from rawaug.paper.baselines.base import BaselineISP, CropTrainedISP
from rawaug.seeding import keyed_generator

FAMILIES = ("dictionary", "dictionary-encoders", *BASELINES)
ROWS = {"as-shot": "as-shot gains", "samples": "64 RAW samples", "oracle": "oracle weights"}
SAMPLES = 64


Method = BaselineISP | DictionaryISP


class Fitted(NamedTuple):
    model: Method
    seconds: float
    parameters: int


def resumed(path: Path, key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The figures that an earlier run wrote to ``path`` under the same key, else measured and written."""
    figures: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
    if figures.get("key") != key:
        figures = {"key": key, **measure()}
        write_json(figures, path)
    return figures


def is_method(family: str) -> bool:
    """Whether this is a family to fit, the name of a shipped ISP, or the file of one."""
    if family in FAMILIES:
        return True
    try:
        find_weights(family)
    except FileNotFoundError:
        return False
    return True


def learns_by_descent(family: str) -> bool:
    """Whether a family trains on crops: it has a budget, and needs pairs that are registered pixel by pixel."""
    return family in BASELINES and issubclass(BASELINES[family], CropTrainedISP)


def fit_family(family: str, pairs: Sequence[Pair], config: FitConfig, training: Training) -> Fitted:
    """Fit a family to pairs of one CFA, with the seed of ``training``."""
    start = time.perf_counter()
    if family not in FAMILIES:
        isp = DictionaryISP.from_pretrained(family)
        if isp.cfa != CFA(pairs[0].cfa):
            raise ValueError(f"{family}: makes {isp.cfa.value} RAW, but the frames are {CFA(pairs[0].cfa).value}")
        return Fitted(isp, 0.0, reverse_parameters(isp))
    if family.startswith("dictionary"):
        config = replace(config, seed=training.seed, encoders="on" if family == "dictionary-encoders" else "off")
        isp = fit_isp(pairs, config)
        return Fitted(isp, time.perf_counter() - start, reverse_parameters(isp))
    method = BASELINES[family]
    start_of: dict[str, Any] = {"seed": training.seed} if issubclass(method, CropTrainedISP) else {}
    model = fit_baseline(method(cfa=pairs[0].cfa, **start_of), pairs, training)
    return Fitted(model, time.perf_counter() - start, reverse_parameters(model))


def reverse_parameters(model: Method) -> int:
    """Number of parameters of the reverse pass."""
    network = model.reverse_network if isinstance(model, BaselineISP) else model
    named = network.named_parameters()
    return sum(p.numel() for name, p in named if not name.startswith("forward_") and ".forward_" not in name)


def score_rows(fitted: Fitted, pair: Pair, patches: int | None) -> dict[str, Any]:
    """PSNR_r of every row that the family fills, and the Mpix/s of the reverse pass; over blocks if unregistered."""
    pair.require_rendered()
    model = fitted.model
    if not pair.registered:
        return {"rows": _block_rows(model, pair), "mpix_s": None}
    makers = _makers(model, pair)
    start = time.perf_counter()
    rows = {row: windows_psnr(make, pair, patches) for row, make in makers.items()}
    if "oracle" in rows:  # chosen by the error on some pixels of the frame, which is not the mean of the patches' PSNR
        rows["oracle"] = max(rows.values())
    area = min(PATCH, pair.raw.shape[-2]) * min(PATCH, pair.raw.shape[-1])
    pixels = len(makers) * len(windows_of(pair, patches)) * area
    return {"rows": rows, "mpix_s": pixels / (time.perf_counter() - start) / 1e6}


def balanced_rows(fitted: Fitted, pair: Pair) -> dict[str, float]:
    """InvISP's PSNR (:func:`balanced_psnr`) of every row that the family fills."""
    return {row: balanced_psnr(make, pair) for row, make in _makers(fitted.model, pair).items()}


def _makers(model: Method, pair: Pair) -> dict[str, Callable[[Tensor, Tensor], Tensor]]:
    """Row to the function from an sRGB patch and its place in the frame to a mosaic."""

    def maker(given: Any) -> Callable[[Tensor, Tensor], Tensor]:
        if isinstance(model, DictionaryISP):
            return lambda patch, place: model.reverse(patch, given, coordinates=place).raw
        return lambda patch, place: model.reverse(patch, given)

    return {row: maker(given) for row, given in settings(model, pair).items()}


def settings(model: Method, pair: Pair) -> dict[str, Any]:
    """Row to the camera setting that it is made with; a method that has no use for gains has one row."""
    if isinstance(model, DictionaryISP):
        return dictionary_params(model, pair)
    balanced = model.balanced(pair.white_balance) if pair.balance_known else None
    return {"blind": None} | ({} if balanced is None else {"as-shot": balanced})


def _block_rows(model: Method, pair: Pair) -> dict[str, float]:
    if isinstance(model, DictionaryISP):
        rows = {"blind": psnr_r(model, pair)}
        return rows | ({"as-shot": psnr_r(model, pair, white_balance=True)} if pair.balance_known else {})
    blocks = block_averages(pair.srgb, pair.raw, pair.cfa)
    with torch.no_grad():
        made = model.unprocess(blocks.srgb[None])[0]
    return {"blind": block_psnr(made, blocks.raw, blocks.clipped)}


def dictionary_params(isp: DictionaryISP, pair: Pair) -> dict[str, ISPParams]:
    """The camera settings of the dictionary's rows for a frame."""
    with torch.no_grad():
        blind = isp.choose(pair.srgb[None])
        as_shot = staged.with_white_balance(isp, blind, pair.white_balance, None)
        known = {
            "blind": blind,
            **({"as-shot": as_shot} if pair.balance_known else {}),
            "samples": _from_samples(isp, pair, blind),
        }
        return known | {"oracle": oracle(isp, pair, list(known.values()))}


def _from_samples(isp: DictionaryISP, pair: Pair, blind: ISPParams) -> ISPParams:
    generator = keyed_generator("raw samples", pair.name)
    rows, columns = (torch.randint(side, (SAMPLES,), generator=generator) for side in pair.raw.shape[-2:])
    readings = torch.stack([rows.float(), columns.float(), pair.raw[0, rows, columns]], dim=1)[None]
    x = as_float(pair.srgb[None])
    return staged.with_raw_samples(isp, x, blind, readings, coordinates_or_full(x, None))


@torch.no_grad()
def cycle_psnr(fitted: Fitted, pictures: Sequence[Tensor]) -> dict[str, float]:
    """Mean PSNR of sRGB -> RAW -> sRGB over pictures ``(3, H, W)`` uint8; empty for a method without a way back."""
    model, shown = fitted.model, [as_float(picture[None]) for picture in pictures]
    if not isinstance(model, DictionaryISP):
        return {"cycle": fmean(psnr(model.cycle(x), x).item() for x in shown)} if model.bidirectional else {}
    made = (model.reverse(x) for x in shown)
    cycled = [model.forward(result.raw.clamp(0.0, 1.0), result.params).srgb for result in made]
    ways = {"cycle": cycled, "cycle_without_mosaic": [cycled_without_mosaic(model, x) for x in shown]}
    return {way: fmean(psnr(a, b).item() for a, b in zip(found, shown, strict=True)) for way, found in ways.items()}


def cycled_without_mosaic(isp: DictionaryISP, srgb: Tensor) -> Tensor:
    """sRGB to x5 and back: what the stages alone lose."""
    params = isp.choose(srgb)
    return isp.forward_pixels(isp.reverse_pixels(srgb, params), params).clamp(0.0, 1.0)


def mosaic_only_psnr(pictures: Sequence[Tensor], cfa: CFA | str = "RGGB") -> float:
    """What the mosaic and bilinear interpolation alone leave: the ceiling of a cycle."""
    values = [as_float(p[None]) for p in pictures]
    return fmean(psnr(bayer.demosaic(bayer.mosaic(x, cfa), cfa).clamp(0.0, 1.0), x).item() for x in values)


GAMMA = 2.2
PARTS = 3


@torch.no_grad()
def balanced_psnr(make: Callable[[Tensor, Tensor], Tensor], pair: Pair) -> float:
    """Mean over the pieces; ``make`` maps sRGB ``(1, 3, h, w)`` and its place in the frame to RAW ``(1, 1, h, w)``."""
    if not pair.registered:
        raise ValueError(f"{pair.name}: is not registered pixel by pixel, so it has no balanced PSNR")
    height, width = pair.raw.shape[-2:]
    edges = ([k * side // PARTS // 2 * 2 for k in range(PARTS)] + [side] for side in (height, width))
    values = []
    for (top, bottom), (left, right) in product(*map(pairwise, edges)):
        piece = (None, slice(None), slice(top, bottom), slice(left, right))
        place = frame_coordinates(bottom - top, right - left, (top, left), (height, width))
        made = make(pair.srgb[piece], place).clamp(0.0, 1.0)
        values.append(psnr(_seen(made, pair), _seen(pair.raw[piece], pair)).item())
    return fmean(values)


def _seen(raw: Tensor, pair: Pair) -> Tensor:
    """z of a mosaic ``(1, 1, h, w)``: ``(1, 3, h, w)``."""
    gains = torch.tensor(pair.white_balance)
    balanced = bayer.demosaic(raw, pair.cfa) * (gains / gains.max()).reshape(3, 1, 1)
    return balanced.clamp_min(0.0) ** (1.0 / GAMMA)


PIXELS = 16384
STEPS = 300
RATE = 0.1
LOG_RATE = 0.01
"""Of log gains, which start near their end."""
EPS = 1e-9
FLOOR = 1e-3
"""Added to weights before their logarithm, or an atom that starts at 0 stays there."""


@torch.no_grad()
def oracle(isp: DictionaryISP, pair: Pair, others: Sequence[ISPParams]) -> ISPParams:
    """The best setting for the frame among what descent finds and the ``others``, one or more."""
    pixels = sample_pixels([pair], PIXELS, seed=0).pixels
    start = None
    if isp.config.cameras:
        own, value = pixels.site[:, :, 0], pixels.target.sum(dim=(1, 2))
        start = staged.with_readings(isp, pixels.srgb, pixels.coordinates, own, value, others[0])
    found = [*others, _descended(isp, pixels, start)]
    return min(found, key=lambda setting: squared_error(isp, pixels, setting).item())


def squared_error(isp: DictionaryISP, pixels: PixelSamples, setting: ISPParams) -> Tensor:
    """Mean over the readings that are not clipped: a few that are would outweigh all others. Held to [0, 1]."""
    made = isp.reverse_pixels(pixels.srgb, setting, pixels.coordinates).clamp(0.0, 1.0)
    return ((made - pixels.target) ** 2 * pixels.known).sum() / pixels.known.sum()


@torch.enable_grad()
def _descended(isp: DictionaryISP, pixels: PixelSamples, start: ISPParams | None) -> ISPParams:
    """From ``start``, with free gains; or from uniform weights of all atoms, those of the gains among them."""
    config = isp.config
    if start is None:
        logits = [torch.zeros(1, n) for n in (config.colour_atoms, config.gain_atoms, config.tone_atoms) if n]
        log_gains = torch.zeros(0)
    else:
        logits = [(weights + FLOOR).log() for weights in (start.colour_weights, start.tone_weights) if weights.shape[1]]
        log_gains = start.gains.log()
    logits, log_gains = [value.clone().requires_grad_() for value in logits], log_gains.clone().requires_grad_()

    def setting() -> ISPParams:
        weights = [value.softmax(dim=1) for value in logits]
        if start is None:
            return isp.params_from_weights(*weights)
        tones = weights[1] if len(weights) > 1 else start.tone_weights
        return ISPParams(weights[0], start.gain_weights[:, :0], isp.colour.combine(weights[0]), log_gains.exp(), tones)

    optimiser = torch.optim.Adam([{"params": logits, "lr": RATE}, {"params": [log_gains], "lr": LOG_RATE}])
    best, least = setting(), torch.inf
    for _ in range(STEPS):
        tried = setting()
        error = squared_error(isp, pixels, tried)
        if error.item() < least:
            best, least = tried, error.item()
        optimiser.zero_grad()
        (error + EPS).log().backward()
        optimiser.step()
    return ISPParams(*(value.detach() for value in best))
