"""PSNR and SSIM of an ISP or a denoiser, image by image.

An ISP's PSNR_r is the mean over non-overlapping 256 x 256 mosaic patches of reconstruction against RAW. A denoiser's
PSNR_d and SSIM are taken on the whole mosaic, on frozen noise: the captured one, or one keyed by (seed, name).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor
from tqdm.auto import tqdm

import denoisers
from denoisers.network import Denoiser
from rawaug import bayer
from rawaug._version import __version__
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.pairs import Pair
from rawaug.experiment.stream import Sample, aligned
from rawaug.isp.model import DictionaryISP, find_weights
from rawaug.isp.samples import block_averages
from rawaug.metrics import patch_psnr, psnr, ssim, worst_and_best_quarter
from rawaug.noise import NoiseModel, noise_model
from rawaug.seeding import keyed_generator

TILE = 256
"""Side in packed pixels of the pieces in which large frames are denoised."""


@dataclass(frozen=True)
class Score:
    """Of one image."""

    name: str
    psnr: float
    ssim: float | None = None
    psnr_noisy: float | None = None
    ssim_noisy: float | None = None


def read_header(path: str | Path) -> dict[str, str]:
    """The metadata of a weights file.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a rawaug weights file.
    """
    path = find_weights(path)
    try:
        with safe_open(str(path), framework="pt") as file:
            header = dict(file.metadata() or {})
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error}); fit or train it again") from error
    if header.get("format") != "rawaug":
        raise ValueError(f"{path}: a safetensors file, but not rawaug's; give one written by rawaug fit or rawaug run")
    return header


def frozen_sample(pair: Pair, noise: NoiseModel, cfa: CFA, seed: int) -> Sample:
    """The frame as a test case ``(1, 4, h, w)``: its own captured noise, or noise keyed by (seed, name)."""
    clean = bayer.pack(aligned(pair.raw, pair.cfa, cfa)[None], cfa)
    if pair.noisy is not None and pair.shot_var is not None and pair.read_var is not None:
        noisy = bayer.pack(aligned(pair.noisy, pair.cfa, cfa)[None], cfa)
        return Sample(noisy, clean, pair.read_var + pair.shot_var * noisy.clamp_min(0.0))
    params = noise.sample(1, keyed_generator(seed, "test noise", pair.name))
    noisy = noise.apply(clean, params)
    return Sample(noisy, clean, noise.variance(noisy, params))


@torch.no_grad()
def denoise(model: Denoiser, sample: Sample, cfa: CFA, self_ensemble: bool) -> Tensor:
    """Packed RAW ``(1, 4, h, w)`` denoised, in tiles where it is large, as the mean of eight views on request."""
    run: Any = model
    if max(sample.noisy.shape[-2:]) > TILE + 64:
        run = partial(denoisers.tiled, model, tile=TILE, overlap=32)
    if self_ensemble:
        run = denoisers.SelfEnsemble(run, cfa, views=8)
    denoised: Tensor = run(sample.noisy, sample.variance)
    return denoised


def score_denoiser(
    model: Denoiser, pairs: Sequence[Pair], noise: NoiseModel, cfa: CFA, seed: int, self_ensemble: bool, label: str
) -> Iterator[tuple[Score, Pair, Sample, Tensor]]:
    """Scores of every frame, with what was compared; one frame in memory at a time."""
    for pair in tqdm(pairs, desc=label, unit="image", leave=False):
        sample = frozen_sample(pair, noise, cfa, seed)
        denoised = denoise(model, sample, cfa, self_ensemble)
        clean, noisy, restored = (bayer.unpack(x, cfa) for x in (sample.clean, sample.noisy, denoised))
        values = (psnr(restored, clean), ssim(restored, clean), psnr(noisy, clean), ssim(noisy, clean))
        yield Score(pair.name, *(value.item() for value in values)), pair, sample, denoised


@torch.no_grad()
def score_isp(isp: DictionaryISP, pair: Pair, white_balance: bool = False) -> Score:
    """PSNR_r of one frame; of an unregistered pair at the resolution of block averages."""
    given = pair.white_balance if white_balance else None
    if pair.registered:
        raw = isp_mosaic(isp, pair, given)
        return Score(pair.name, patch_psnr(raw, pair.raw[None]).item())
    low_srgb, low_raw, clipped = block_averages(pair.srgb, pair.raw, pair.cfa)
    params = isp.condition(isp.choose(low_srgb[None]), given, None)
    error = (isp.reverse_pixels(low_srgb[None], params)[0] - low_raw) ** 2
    return Score(pair.name, -10.0 * error[:, ~clipped].mean().log10().item())


def isp_mosaic(isp: DictionaryISP, pair: Pair, white_balance: tuple[float, ...] | None = None) -> Tensor:
    """The reconstructed mosaic ``(1, 1, H, W)`` in the pattern of the pair, strip by strip to bound memory."""
    from rawaug.isp.stages import place_in_frame

    params = isp.condition(isp.choose(pair.srgb[None]), white_balance, None)
    height, width = pair.raw.shape[-2:]
    strips = []
    for top in range(0, height, 256):
        strip = pair.srgb[None, :, top : top + 256].float() / 255.0
        place = place_in_frame(strip.shape[-2], width, (top, 0), (height, width))
        strips.append(bayer.mosaic(isp.reverse_pixels(strip, params, place), pair.cfa))
    return torch.cat(strips, dim=-2)


def evaluate(
    weights: str | Path, data: str, self_ensemble: bool = False, noise: str | None = None, seed: int = 0
) -> dict[str, Any]:
    """Evaluate a file of weights; the result is the JSON object that ``rawaug evaluate --json`` writes.

    Args:
        weights: an ISP's or a denoiser's; the file says which.
        data: a folder of RAW files, or ``kind:path``.
        self_ensemble: average a denoiser over eight views.
        noise: preset for frames without a noisy capture; by default the one that the denoiser was trained with.
        seed: of that noise.
    """
    weights = find_weights(weights)
    kind = read_header(weights)["kind"]
    result: dict[str, Any] = {"kind": kind, "data": data}
    pairs = open_pairs(data, split="test")
    if kind == "isp":
        isp = DictionaryISP.from_pretrained(weights)
        scores = [score_isp(isp, pair) for pair in tqdm(pairs, desc="evaluate", unit="image", leave=False)]
    else:
        model, info = denoisers.load(weights)
        levels = noise_model(noise or info.get("noise", "cycleisp_sidd"))
        cfa = CFA(info.get("cfa", "RGGB"))
        scored = score_denoiser(model, pairs, levels, cfa, seed, self_ensemble, "evaluate")
        scores = [score for score, *_ in scored]
        result |= {"self_ensemble": self_ensemble, "seed": seed}
    digest = hashlib.sha256(weights.read_bytes()).hexdigest()
    return {**result, **summary(scores), "weights_sha256": digest, "version": __version__}


def summary(scores: Sequence[Score]) -> dict[str, Any]:
    """Per image and mean; what does not apply is left out."""
    values = [score.psnr for score in scores]
    worst, best = worst_and_best_quarter(values)
    images = [{k: v for k, v in vars(s).items() if v is not None and not k.endswith("noisy")} for s in scores]
    result: dict[str, Any] = {"images": images, "psnr": sum(values) / len(values)}
    result |= {"psnr_worst25": worst, "psnr_best25": best}
    for key in ("ssim", "psnr_noisy", "ssim_noisy"):
        known = [getattr(s, key) for s in scores if getattr(s, key) is not None]
        if known:
            result[key] = sum(known) / len(known)
    return result


def write_json(result: dict[str, Any], path: str | Path) -> None:
    """Write a result, making its folder."""
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(json.dumps(result, indent=1) + "\n")
