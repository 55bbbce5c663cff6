"""PSNR_r of an ISP, which measures how well it reconstructs RAW frames from their sRGB."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.data.pairs import Pair
from rawaug.isp.config import ISPParams
from rawaug.isp.fit.samples import block_averages
from rawaug.isp.functional import as_float, frame_coordinates
from rawaug.isp.fusion import Tone
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import PATCH, patch_psnr, patch_starts
from rawaug.seeding import keyed_generator


@torch.no_grad()
def psnr_r(
    isp: DictionaryISP,
    pair: Pair,
    white_balance: bool = False,
    patches: int | None = None,
    tone: Tone | None = None,
) -> float:
    """Measure PSNR_r of one frame; for an unregistered pair, that of block averages.

    Args:
        isp: the ISP that reconstructs the RAW.
        pair: the frame.
        white_balance: whether the ISP is given the frame's as-shot gains.
        patches: number of patches to score in a registered frame, all by default.
        tone: the tone curve that the ISP is given, as in :meth:`DictionaryISP.reverse`.

    Raises:
        ValueError: if the picture is not in the camera's colours, like SIDD's blocks without their sRGB files.
    """
    pair.require_rendered()
    as_shot = None
    if white_balance:
        as_shot = pair.clean.white_balance

    def choose(srgb: Tensor) -> ISPParams:
        params = isp.with_white_balance(isp.choose(srgb), as_shot)
        return isp.with_tone(params, tone)

    if pair.registered:
        params = choose(pair.srgb[None])

        def reverse(patch: Tensor, place: Tensor) -> Tensor:
            return bayer.mosaic(isp.stages.reverse(as_float(patch), params, place), pair.cfa)

        return windows_psnr(reverse, pair, patches)

    srgb, raw, clipped, coordinates = block_averages(pair.srgb, pair.clean.mosaic, pair.cfa)
    params = choose(srgb[None])
    estimate = isp.stages.reverse(srgb[None], params, coordinates)[0]
    return block_psnr(estimate, raw, clipped)


def block_psnr(estimate: Tensor, raw: Tensor, clipped: Tensor) -> float:
    """Compute the PSNR between block averages ``(3, h, w)``, without blocks that have a clipped reading ``(h, w)``."""
    error = (estimate.clamp(0.0, 1.0) - raw) ** 2
    return -10.0 * error[:, ~clipped].mean().log10().item()


def draw_windows(pair: Pair, count: int | None) -> list[tuple[int, int]]:
    """Choose corners of ``count`` random patches of a frame, keyed by its name; None for patches that cover it."""
    height, width = pair.clean.mosaic.shape[-2:]
    every = list(product(patch_starts(height), patch_starts(width)))
    if count is None or count >= len(every):
        return every

    order = torch.randperm(len(every), generator=keyed_generator("windows", pair.name)).tolist()
    return [every[k] for k in sorted(order[:count])]


@torch.no_grad()
def windows_psnr(make: Callable[[Tensor, Tensor], Tensor], pair: Pair, count: int | None) -> float:
    """Average the PSNR over windows; ``make`` maps an sRGB patch ``(1, 3, h, w)`` and its place in the frame to RAW."""
    height, width = pair.clean.mosaic.shape[-2:]
    values = []
    for corner in draw_windows(pair, count):
        y, x = corner
        window = (None, slice(None), slice(y, y + PATCH), slice(x, x + PATCH))
        coordinates = frame_coordinates(min(PATCH, height), min(PATCH, width), corner, (height, width))
        values.append(patch_psnr(make(pair.srgb[window], coordinates).clamp(0.0, 1.0), pair.clean.mosaic[window]))

    return torch.cat(values).mean().item()
