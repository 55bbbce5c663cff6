r"""A denoised frame that is never estimated to be worse than its input.

.. math:: g = y + \sum_k w_k (f_k(y) - y), \qquad w = \arg\min_{w_k \ge 0,\; \sum w_k \le 1} \; w^T G w
          - 2 \rho\, b^T w

.. math:: G_{kl} = \sum_i \frac{(f_{k,i} - y_i)(f_{l,i} - y_i)}{\sigma_i^2}, \qquad
          b_k = \sum_i \Big(1 - \frac{\partial f_{k,i}}{\partial y_i}\Big)

Here the estimated squared error of g (:mod:`rawaug.denoising.risk`), in units of the noise's variance, is least. A
denoiser that removes nothing but noise has :math:`w = \rho b / G = 1` and is left as it is; one that removes texture as
well removes more energy than noise explains, and is blended with its input and with non-local means, which spare weak
texture. The sums are over a sample of the frame. Where more than ten times what noise explains was removed, as at a
light that was taken for a defect, the place has its own, smaller share.

Stated levels may be wrong, and then w would be. :math:`\rho` is the variance of the noise in units of the stated one,
from places that are flat; texture that is as fine and as even as noise passes for it, and then w is too high. Single
defective pixels are mended first, for they are no texture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from denoisers.defects import AROUND, mend_planes
from denoisers.domains import DOMAINS
from rawaug.bayer import noise_variance
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.denoising.risk import Probe, probe_denoiser

SECOND = "NonLocalMeans"
"""The filter with which a denoiser that removes texture is blended."""

SAMPLE = 3, 128
"""The frame is probed at as many places down and across, of this side in cells: 0.6 megapixels of the mosaic."""

TRUSTED = 0.92
"""A denoiser with a larger w is left as it is: the estimate is not more precise than that."""

EXCESS = 10.0
"""A place has its own share if the energy that was removed is more than this many times what noise explains."""

MOST_DEFECTS = 1e-3
"""More single pixels than this share are no defects but texture."""

FLAT_CONTRAST = 0.25
"""A flat place has less contrast than this share of the noise's variance after denoising."""

STRIP = 256
"""A frame is mended so many rows of cells at a time."""

_STEPS = 40
"""Weights are multiples of one part in as many."""
_NOTHING = 1e-3
"""A denoiser that removes less than this part of the noise's energy is left as it is."""
_PLACE = 4
_FLAT = 8
_LEAST_FLAT = 10


@dataclass(frozen=True)
class Guarded:
    """A denoiser whose results are guarded, to be scored beside it."""

    denoiser: RawDenoiser

    @property
    def name(self) -> str:
        """Its name in tables."""
        return f"{self.denoiser.name}, guarded"

    @property
    def takes(self) -> str:
        """The kind of image that it takes."""
        return self.denoiser.takes

    def __call__(self, noisy: Noisy) -> Tensor:
        """Denoise packed RAW ``(1, 4, h, w)`` with known levels, and guard the result."""
        return guard_result(self.denoiser, noisy, self.denoiser(noisy), self.denoiser.strength)[0]


@torch.no_grad()
def guard_result(
    denoise: Callable[[Noisy], Tensor], noisy: Noisy, denoised: Tensor, strength: float = 1.0
) -> tuple[Tensor, float]:
    """Blend a denoised frame with its input, and with non-local means, where it is estimated to be worse.

    Args:
        denoise: the denoiser, which is called twice on a sample of the frame.
        noisy: packed RAW ``(1, 4, h, w)`` with the levels of its noise.
        denoised: its result, ``(1, 4, h, w)``.
        strength: what share of the noise it removes.

    Returns:
        The blend, and the mean share of the denoiser in it.

    Raises:
        ValueError: if the levels of the noise are not known.
    """
    if noisy.levels is None:
        raise ValueError("guard: needs the levels of the noise")
    second = RawDenoiser.of(SECOND, strength=strength)
    first_weight, second_weight, explained = _choose_blend(denoise, second, noisy)

    mended = _mend(noisy, denoised)
    change = first_weight * (denoised - mended)
    if second_weight > 0.0:
        change += second_weight * (second(noisy) - mended)

    # Where more was removed than noise can explain, the place is nearly as its input.
    variance = noise_variance(denoised, *noisy.levels).clamp_min(1e-12)
    removed = (change.square() / variance).mean(1, keepdim=True)
    energy = F.avg_pool2d(removed, _PLACE, ceil_mode=True, count_include_pad=False)
    share = (explained / energy.clamp_min(1e-6)).clamp(max=1.0)
    share = share.where(energy > EXCESS * explained, torch.tensor(1.0))
    share = F.interpolate(share, size=removed.shape[-2:], mode="bilinear")
    return mended + share * change, first_weight * float(share.mean())


def _choose_blend(
    denoise: Callable[[Noisy], Tensor], second: Callable[[Noisy], Tensor], noisy: Noisy
) -> tuple[float, float, float]:
    """Choose the weights for a frame; the filter is run only if the denoiser cannot be trusted alone.

    Returns:
        The weights of the denoiser and of the filter, and the energy per value that noise explains.
    """
    parts = []
    count = flat_removed = flat_explained = 0.0
    product = torch.zeros(2, 2)
    explained = torch.zeros(2)

    for patch in _sample(noisy.image):
        assert noisy.levels is not None
        part = Noisy.of(patch, noisy.levels, noisy.cfa)
        probe = probe_denoiser(denoise, part)
        mended = _mend(part, probe.denoised)
        removed = probe.denoised - mended
        is_whole = (probe.denoised < 1.0 - 4.0 * probe.variance.sqrt()) & (mended == patch)
        weight = is_whole / probe.variance
        parts.append((part, mended, removed, weight, is_whole))

        count += float(is_whole.sum())
        product[0, 0] += (removed.square() * weight).sum()
        explained[0] += ((1.0 - probe.kept) * is_whole).sum()

        is_flat = _flat_places(probe)
        flat_removed += float(_pool(removed.square() / probe.variance)[is_flat].sum())
        flat_explained += float(_pool(1.0 - probe.kept)[is_flat].sum())

    scale = 1.0
    if flat_explained >= _LEAST_FLAT:
        scale = flat_removed / flat_explained
    expected = scale * min(1.0, max(0.05, float(explained[0]) / max(count, 1.0)))
    is_trusted = scale * explained[0] > TRUSTED * product[0, 0]
    if is_trusted or product[0, 0] < _NOTHING * count:
        return 1.0, 0.0, expected

    for part, mended, removed, weight, is_whole in parts:
        probe = probe_denoiser(second, part)
        removed_by_second = probe.denoised - mended
        product[0, 1] += (removed * removed_by_second * weight).sum()
        product[1, 1] += (removed_by_second.square() * weight).sum()
        explained[1] += ((1.0 - probe.kept) * is_whole).sum()
    product[1, 0] = product[0, 1]

    steps = torch.cartesian_prod(torch.arange(_STEPS + 1), torch.arange(_STEPS + 1))
    weights = steps[steps.sum(1) <= _STEPS] / _STEPS
    risk = ((weights @ product) * weights).sum(1) - 2.0 * scale * (weights @ explained)
    first, filtered = weights[risk.argmin()].tolist()
    return first, filtered, expected


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
    mended = _mend_strips(signal)
    is_defect = mended != signal
    if float(is_defect.float().mean()) > MOST_DEFECTS:
        return noisy.image

    # The few values that change, ``(1, 1, 1, N)``.
    value = noisy.image[is_defect]
    replacement = domain.inverse(mended[is_defect].reshape(1, 1, 1, -1), *levels).flatten()
    result = denoised[is_defect]
    is_agreed = (result - replacement).abs() < (result - value).abs()
    image = noisy.image.clone()
    image[is_defect] = torch.where(is_agreed, replacement, value)
    return image


def _mend_strips(signal: Tensor) -> Tensor:
    """Mend planes ``(1, 4, h, w)`` by strips, to the same bits as at once, which takes a gigabyte for 12 megapixels."""
    margin = AROUND // 2 + 2
    strips = []
    for top in range(0, signal.shape[2], STRIP):
        start = max(top - margin, 0)
        mended = mend_planes(signal[:, :, start : top + STRIP + margin])
        strips.append(mended[:, :, top - start :][:, :, :STRIP])
    return torch.cat(strips, dim=2)
