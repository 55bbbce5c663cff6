"""The methods of the reconstruction table, on one footing: fitted on the same pairs, asked for the same patches.

A family is fitted once and may fill several rows: the dictionary ISP blind, with the as-shot white balance, with 64 RAW
samples, and with the best weights there are (oracle), which tells what the dictionaries could do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pair import Pair
from rawaug.evaluation.psnr_r import block_psnr, psnr_r, windows_of, windows_psnr
from rawaug.isp import conditioning
from rawaug.isp.baselines import BASELINES, ReverseISP, fit_baseline
from rawaug.isp.baselines.base import CropTrainedISP
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.samples import block_averages, sample_pixels
from rawaug.isp.model import DictionaryISP
from rawaug.isp.setting import ISPParams
from rawaug.isp.stages import as_float
from rawaug.metrics import PATCH, psnr
from rawaug.seeding import keyed_generator

FAMILIES = ("dictionary", "dictionary-encoders", *BASELINES)
ROWS = {"as-shot": "as-shot gains", "samples": "64 RAW samples", "oracle": "oracle weights"}
SAMPLES = 64
ORACLE_STEPS = 300

Maker = Callable[[Tensor, Tensor], Tensor]
"""An sRGB patch and its place in the frame to a mosaic."""


class Fitted(NamedTuple):
    """A fitted family.

    Args:
        model: what was fitted.
        seconds: that it took, reading not counted.
        parameters: of its reverse pass.
    """

    model: DictionaryISP | ReverseISP
    seconds: float
    parameters: int


def learns_by_descent(family: str) -> bool:
    """Whether a family trains on crops: it has a budget, and needs pairs that are registered pixel by pixel."""
    return family in BASELINES and issubclass(BASELINES[family], CropTrainedISP)


def fit_family(
    family: str, pairs: Sequence[Pair], config: FitConfig, budget: tuple[float, int, int], seed: int
) -> Fitted:
    """Fit a family to pairs of one CFA; methods that learn by descent have a budget of (seconds, crop, batch)."""
    start = time.perf_counter()
    if family.startswith("dictionary"):
        isp = fit_isp(pairs, replace(config, seed=seed, encoders="on" if family == "dictionary-encoders" else "off"))
        return Fitted(isp, time.perf_counter() - start, _in_use(isp))
    method = BASELINES[family]
    start_of: dict[str, Any] = {"seed": seed} if issubclass(method, CropTrainedISP) else {}
    model = method(cfa=pairs[0].cfa, **start_of)
    seconds, crop, batch = budget
    fit_baseline(model, pairs, seconds, crop=crop, batch=batch, seed=seed)
    return Fitted(model, time.perf_counter() - start, model.reverse_parameters)


def _in_use(isp: DictionaryISP) -> int:
    """Parameters that the reverse pass uses: encoders count where they look at the picture."""
    parts = {name: p for name, p in isp.named_parameters() if not name.startswith("forward_networks")}
    if not isp.encoders_in_use:
        parts = {name: p for name, p in parts.items() if "_encoder.layers" not in name}
    return sum(p.numel() for p in parts.values())


def score_rows(fitted: Fitted, pair: Pair, patches: int | None) -> dict[str, Any]:
    """PSNR_r of every row that the family fills, and the Mpix/s of the reverse pass.

    An unregistered pair is scored over blocks, by methods that do not learn by descent.
    """
    model = fitted.model
    if not pair.registered:
        return {"rows": _block_rows(model, pair), "mpix_s": None}
    if isinstance(model, DictionaryISP):
        makers = {row: _dictionary(model, params) for row, params in dictionary_params(model, pair).items()}
    else:
        makers = {"blind": _baseline(model)}
    start = time.perf_counter()
    rows = {row: windows_psnr(make, pair, patches) for row, make in makers.items()}
    area = min(PATCH, pair.raw.shape[-2]) * min(PATCH, pair.raw.shape[-1])
    pixels = len(makers) * len(windows_of(pair, patches)) * area
    return {"rows": rows, "mpix_s": pixels / (time.perf_counter() - start) / 1e6}


@torch.no_grad()
def _block_rows(model: DictionaryISP | ReverseISP, pair: Pair) -> dict[str, float]:
    if isinstance(model, DictionaryISP):
        return {"blind": psnr_r(model, pair), "as-shot": psnr_r(model, pair, white_balance=True)}
    blocks = block_averages(pair.srgb, pair.raw, pair.cfa)
    return {"blind": block_psnr(model.unprocess(blocks.srgb[None])[0], blocks.raw, blocks.clipped)}


def _dictionary(isp: DictionaryISP, params: ISPParams) -> Maker:
    return lambda patch, place: isp.reverse(patch, params, place=place).raw


def _baseline(model: ReverseISP) -> Maker:
    return lambda patch, place: model.reverse(patch)


def dictionary_params(isp: DictionaryISP, pair: Pair) -> dict[str, ISPParams]:
    """The camera settings of the dictionary's rows for a frame."""
    with torch.no_grad():
        blind = isp.choose(pair.srgb[None])
        return {
            "blind": blind,
            "as-shot": conditioning.with_white_balance(isp, blind, pair.white_balance, None),
            "samples": _from_samples(isp, pair, blind),
            "oracle": _oracle(isp, pair),
        }


def _from_samples(isp: DictionaryISP, pair: Pair, blind: ISPParams) -> ISPParams:
    height, width = pair.raw.shape[-2:]
    generator = keyed_generator("raw samples", pair.name)
    rows, columns = (torch.randint(side, (SAMPLES,), generator=generator) for side in (height, width))
    readings = torch.stack([rows.float(), columns.float(), pair.raw[0, rows, columns]], dim=1)[None]
    x = as_float(pair.srgb[None])
    return conditioning.with_raw_samples(isp, x, blind, readings, isp.place(x))


@torch.enable_grad()
def _oracle(isp: DictionaryISP, pair: Pair) -> ISPParams:
    """The weights that come closest to the frame's RAW, by descent on its logarithmic error."""
    pixels, _ = sample_pixels([pair], 16384, seed=0)
    logits = [torch.zeros(1, n, requires_grad=True) for n in (isp.config.colour_atoms, isp.config.gain_atoms)]
    optimiser = torch.optim.Adam(logits, lr=0.1)
    for _ in range(ORACLE_STEPS):
        params = isp.params_from_weights(*(value.softmax(1) for value in logits))
        error = (isp.reverse_pixels(pixels.srgb, params, pixels.place) - pixels.target) ** 2 * pixels.known
        optimiser.zero_grad()
        (error.mean() + 1e-9).log().backward()
        optimiser.step()
    with torch.no_grad():
        return isp.params_from_weights(*(value.softmax(1) for value in logits))


@torch.no_grad()
def cycle_psnr(fitted: Fitted, pictures: Sequence[Tensor]) -> dict[str, float]:
    """Mean PSNR of sRGB -> RAW -> sRGB over pictures ``(3, H, W)`` uint8; empty for a method without a way back.

    ``cycle`` goes through the mosaic; ``cycle_without_mosaic``, of the dictionary ISP, tells what its stages lose.
    """
    model, through, without = fitted.model, [], []
    if isinstance(model, ReverseISP) and not model.bidirectional:
        return {}
    for picture in pictures:
        x = as_float(picture[None])
        if isinstance(model, DictionaryISP):
            result = model.reverse(x)
            back = model.forward(result.raw.clamp(0.0, 1.0), result.params).srgb
            linear = model.reverse_pixels(x, result.params)
            without.append(psnr(model.forward_pixels(linear, result.params).clamp(0.0, 1.0), x).item())
        else:
            back = model.cycle(x)
        through.append(psnr(back, x).item())
    result_ = {"cycle": sum(through) / len(through)}
    return result_ | ({"cycle_without_mosaic": sum(without) / len(without)} if without else {})


def mosaic_only_psnr(pictures: Sequence[Tensor], cfa: CFA | str = "RGGB") -> float:
    """What the mosaic and bilinear interpolation alone leave of sRGB pictures: the ceiling of a cycle through them."""
    values = [as_float(p[None]) for p in pictures]
    scores = [psnr(bayer.demosaic(bayer.mosaic(x, cfa), cfa).clamp(0.0, 1.0), x).item() for x in values]
    return sum(scores) / len(scores)
