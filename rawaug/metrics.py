r"""PSNR and SSIM on RAW, data range 1.

``PSNR = -10 log10(mean((a - b)^2))``.

SSIM is that of Wang et al. (IEEE TIP 2004): Gaussian window of 11 x 11, sigma 1.5, K1 = 0.01, K2 = 0.03, data range 1,
population covariances, no padding (the mean is over windows that lie inside), channels averaged. Libraries differ by up
to 0.01 in these choices; this one equals ``skimage.metrics.structural_similarity(gaussian_weights=True, sigma=1.5,
use_sample_covariance=False, data_range=1)``.
"""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

WINDOW = 11
PATCH = 256
"""Side of the mosaic patches over which an ISP's PSNR_r is averaged."""


def _require_same_shape(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape:
        raise ValueError(f"images differ in shape: {tuple(a.shape)} and {tuple(b.shape)}")


def psnr(a: Tensor, b: Tensor) -> Tensor:
    """PSNR in dB of each picture of a batch: ``(B, ...)`` to ``(B,)``."""
    _require_same_shape(a, b)
    return -10.0 * ((a - b) ** 2).flatten(1).mean(1).log10()


def patch_psnr(a: Tensor, b: Tensor, patch: int = PATCH) -> Tensor:
    """PSNR_r: the mean over non-overlapping ``patch`` x ``patch`` pieces of ``(B, 1, H, W)``, ``(B,)``.

    Whole patches from the top left; the remainder at the right and the bottom is left out. A side shorter than a patch
    is the patch's side.
    """
    _require_same_shape(a, b)
    size = (min(patch, a.shape[-2]), min(patch, a.shape[-1]))
    error = F.avg_pool2d((a - b) ** 2, size)
    return (-10.0 * error.log10()).flatten(1).mean(1)


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """SSIM of each picture of a batch: ``(B, C, H, W)`` to ``(B,)``.

    Raises:
        ValueError: if a side is shorter than the window.
    """
    _require_same_shape(a, b)
    if min(a.shape[-2:]) < WINDOW:
        raise ValueError(f"SSIM needs sides of at least {WINDOW}, got {a.shape[-2]} x {a.shape[-1]}")
    from kornia.metrics import ssim as ssim_map

    return ssim_map(a, b, WINDOW, max_val=1.0, padding="valid").flatten(1).mean(1)


def worst_and_best_quarter(values: list[float]) -> tuple[float, float]:
    """Means of the lowest and of the highest 25% (at least one value each)."""
    ordered = sorted(values)
    count = max(1, round(len(ordered) / 4))
    return sum(ordered[:count]) / count, sum(ordered[-count:]) / count
