r"""PSNR and SSIM on RAW, with data range 1.

``PSNR = -10 log10(mean((a - b)^2))``.

SSIM is that of Wang et al. (IEEE TIP 2004): Gaussian window of 11 x 11, sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1,
population covariances, no padding (the mean is over windows that lie inside), channels averaged. Libraries differ by up
to 0.01 in these choices; this one equals ``skimage.metrics.structural_similarity(gaussian_weights=True, sigma=1.5,
use_sample_covariance=False, data_range=1)``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

WINDOW = 11
"""SSIM's window has this side in pixels."""

PATCH = 256
"""An ISP's PSNR_r is averaged over mosaic patches of this side."""


def _as_floats(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Convert both to float32, or to float64 if one is; half precision would lose squares below 6e-8, from 72 dB on."""
    if a.shape != b.shape:
        raise ValueError(f"images differ in shape: {tuple(a.shape)} and {tuple(b.shape)}")
    if not (a.is_floating_point() and b.is_floating_point()):
        raise ValueError(f"images must be floating point with data range 1, got {a.dtype} and {b.dtype}")
    if a.ndim < 2 or 0 in a.shape[1:]:
        raise ValueError(f"images must be a batch (B, ...) of one or more values each, got {tuple(a.shape)}")

    dtype = torch.float64 if torch.float64 in (a.dtype, b.dtype) else torch.float32
    return a.to(dtype), b.to(dtype)


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """Compute the PSNR in dB of each picture of a batch, ``(B, ...)`` to ``(B,)``; it is infinite for equal ones."""
    a, b = _as_floats(a, b)
    return -10.0 * ((a - b) ** 2).flatten(1).mean(1).log10()


def patch_psnr(a: Tensor, b: Tensor) -> Tensor:
    """Compute PSNR_r ``(B,)``, the mean PSNR over patches of 256 x 256 that cover ``(B, 1, H, W)``.

    Patches that do not fit exactly overlap. A picture shorter than a patch is one patch.
    """
    a, b = _as_floats(a, b)
    error = (a - b) ** 2
    values = []
    for y in patch_starts(error.shape[-2]):
        for x in patch_starts(error.shape[-1]):
            patch = error[..., y : y + PATCH, x : x + PATCH]
            values.append(-10.0 * patch.flatten(1).mean(1).log10())
    return torch.stack(values).mean(0)


def patch_starts(length: int) -> list[int]:
    """Spread as few patches as cover ``length`` sites evenly; each starts at an even site."""
    count = math.ceil(length / PATCH)
    spare = max(length - PATCH, 0)
    return [spare * k // max(count - 1, 1) // 2 * 2 for k in range(count)]


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Compute the SSIM ``(B,)`` of pictures ``(B, C, H, W)``, no side of which may be shorter than the window."""
    a, b = _as_floats(a, b)
    if a.ndim != 4 or min(a.shape[-2:]) < WINDOW:
        raise ValueError(f"SSIM needs (B, C, H, W) with sides of at least {WINDOW}, got {tuple(a.shape)}")
    from kornia.metrics import ssim as ssim_map

    return ssim_map(a, b, WINDOW, max_val=1.0, eps=0.0, padding="valid").flatten(1).mean(1)


def worst_and_best_quarter(values: list[float]) -> tuple[float, float]:
    """Average the lowest and the highest 25 % of the values, at least one value each."""
    ordered = sorted(values)
    count = max(1, round(len(ordered) / 4))
    worst, best = ordered[:count], ordered[-count:]
    return sum(worst) / count, sum(best) / count
