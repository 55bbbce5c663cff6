r"""A denoised frame that is never estimated to be worse than its input.

.. math:: g = y + w (f(y) - y), \qquad w = \rho \frac{\sum_i \sigma_i^2 (1 - \partial f_i / \partial y_i)}
          {\sum_i (f_i(y) - y_i)^2}, \quad 0 \le w \le 1

w is where the estimated squared error of g (:mod:`rawaug.denoising.risk`) is least. A denoiser that removes nothing but
noise has w = 1; one that removes texture as well removes more energy than noise explains, and w falls. The ratio is
taken over the frame, from a sample of it, and again over small places: where what was removed is more than ten times
what noise explains, as at a light that was taken for a defect, the place has its own w.

Stated levels may be wrong, and then w would be. :math:`\rho` is the variance of the noise in units of the stated one,
from places that are flat; texture that is as fine and as even as noise passes for it, and then w is too high. Single
defective pixels are mended first, for they are no texture.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional as F

from denoisers.defects import mend_planes
from denoisers.domains import DOMAINS
from rawaug.bayer import noise_variance
from rawaug.denoising.base import Noisy
from rawaug.denoising.risk import Probe, probe_denoiser

SAMPLE = 4, 128
"""The frame is probed at as many places down and across, of this side in cells: a megapixel of the mosaic."""

TRUSTED = 0.92
"""A denoiser with a larger w is trusted with all of the frame: the estimate is not more precise than that."""

EXCESS = 10.0
"""A place has its own w if the energy that was removed is more than this many times what noise explains."""

MOST_DEFECTS = 1e-3
"""More single pixels than this share are no defects but texture."""

FLAT_CONTRAST = 0.25
"""A flat place has less contrast than this share of the noise's variance after denoising."""

_PLACE = 4
_FLAT = 8
_LEAST_FLAT = 10


@torch.no_grad()
def guard_result(denoise: Callable[[Noisy], Tensor], noisy: Noisy, denoised: Tensor) -> tuple[Tensor, float]:
    """Blend a denoised frame with its input where it is estimated to be worse.

    Args:
        denoise: the denoiser, which is called twice on a sample of the frame.
        noisy: packed RAW ``(1, 4, h, w)`` with the levels of its noise.
        denoised: its result, ``(1, 4, h, w)``.

    Returns:
        The blend, and the mean of w over the frame.

    Raises:
        ValueError: if the levels of the noise are not known.
    """
    if noisy.levels is None:
        raise ValueError("guard: needs the levels of the noise")
    share, expected = _compute_share(denoise, noisy)

    # Where more was removed than noise can explain, the place is nearly as its input.
    mended = _mend(noisy, denoised)
    variance = noise_variance(denoised, *noisy.levels).clamp_min(1e-12)
    removed = ((denoised - mended).square() / variance).mean(1, keepdim=True)
    energy = F.avg_pool2d(removed, _PLACE, ceil_mode=True, count_include_pad=False)
    of_place = (expected / energy.clamp_min(1e-6)).clamp(max=share)
    shares = of_place.where(energy > EXCESS * expected, torch.tensor(share))
    shares = F.interpolate(shares, size=removed.shape[-2:], mode="bilinear")
    return mended + shares * (denoised - mended), float(shares.mean())


def _compute_share(denoise: Callable[[Noisy], Tensor], noisy: Noisy) -> tuple[float, float]:
    """Compute w of the frame, and the energy that noise explains per value, in units of the stated variance."""
    assert noisy.levels is not None
    removed = explained = count = flat_removed = flat_explained = 0.0
    for patch in _sample(noisy.image):
        part = Noisy.of(patch, noisy.levels, noisy.cfa)
        probe = probe_denoiser(denoise, part)
        mended = _mend(part, probe.denoised)
        energy = (probe.denoised - mended).square() / probe.variance
        is_whole = (probe.denoised < 1.0 - 4.0 * probe.variance.sqrt()) & (mended == patch)
        count += float(is_whole.sum())
        removed += float((energy * is_whole).sum())
        explained += float(((1.0 - probe.kept) * is_whole).sum())

        is_flat = _flat_places(probe)
        flat_removed += float(_pool(energy)[is_flat].sum())
        flat_explained += float(_pool(1.0 - probe.kept)[is_flat].sum())

    scale = 1.0
    if flat_explained >= _LEAST_FLAT:
        scale = flat_removed / flat_explained
    share = min(1.0, max(0.0, scale * explained / max(removed, 1e-12)))
    if share > TRUSTED:
        share = 1.0
    return share, scale * min(1.0, max(0.05, explained / max(count, 1.0)))


def _sample(image: Tensor) -> list[Tensor]:
    """Cut patches out of a frame, evenly spaced; a small frame is one patch."""
    number, side = SAMPLE
    height, width = image.shape[-2:]
    if height * width <= (number * side) ** 2:
        return [image]

    patches = []
    for i in range(number):
        for j in range(number):
            top = i * max(0, height - side) // (number - 1)
            left = j * max(0, width - side) // (number - 1)
            patches.append(image[..., top : top + side, left : left + side])
    return patches


def _flat_places(probe: Probe) -> Tensor:
    """Mark the tenth of all places with the least contrast, unless it is more than a quarter of the noise."""
    mean = F.avg_pool2d(probe.denoised, _FLAT)
    contrast = F.avg_pool2d(probe.denoised.square(), _FLAT) - mean.square()
    contrast = (contrast / F.avg_pool2d(probe.variance, _FLAT)).mean(1, keepdim=True)
    return (contrast <= torch.quantile(contrast, 0.1)) & (contrast < FLAT_CONTRAST)


def _pool(values: Tensor) -> Tensor:
    return F.avg_pool2d(values.mean(1, keepdim=True), _FLAT)


def _mend(noisy: Noisy, denoised: Tensor) -> Tensor:
    """Replace single defective pixels that the denoiser takes for defects, too, unless there are too many of them."""
    assert noisy.levels is not None
    levels = [torch.full((1, 1, 1, 1), level) for level in noisy.levels]
    domain = DOMAINS["anscombe"]
    signal = domain.forward(noisy.image, *levels)
    mended = mend_planes(signal)
    is_defect = mended != signal
    if float(is_defect.float().mean()) > MOST_DEFECTS:
        return noisy.image

    replacement = domain.inverse(mended, *levels)
    is_defect &= (denoised - replacement).abs() < (denoised - noisy.image).abs()
    return torch.where(is_defect, replacement, noisy.image)
