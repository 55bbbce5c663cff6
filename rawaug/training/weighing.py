r"""Weighing of light and shade in a loss: the form in which a norm compares denoised RAW and its target.

==============  ====================================================================================================
``weigh``       what is compared
==============  ====================================================================================================
linear          the RAW itself: shadows, whose errors are small, hardly count
normalised      the RAW in units of the noise's deviation at each pixel, which is that of the network's input
stabilised      :math:`2 \sqrt{y / s + r / s^2 + 3/8}`, where noise has deviation 1 in shadow and light alike
mixed           the mean of both, the linear one divided by the noise's mean deviation in the picture
relative        the picture in units of its own error before denoising; needs no variance: for developed pictures
==============  ====================================================================================================

with s = ``shot_var`` and r = ``read_var`` of the picture. An sRGB curve weighs errors much like ``stabilised``, as both
are near a square root. The minimum of l1 is the median, which a curve does not move. That of l2 is the mean, which in
the stabilised domain is not the mean of the RAW. With noisy targets and l2, only ``linear`` and ``normalised`` are
therefore unbiased: their factors do not depend on the target.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from denoisers.domains import DOMAINS, fit_levels
from rawaug.data.pairs import Sample
from rawaug.training.losses import Criterion

LEAST_ERROR = 1.0 / 255.0
"""This is the unit of ``relative`` for pictures with hardly any noise: one step of an 8-bit file."""

_PICTURE = (1, 2, 3)
"""These are the axes of a picture in a batch ``(B, C, h, w)``."""


def weigh_loss(loss: Criterion, weigh: str, sample: Sample) -> Criterion:
    """Weigh light and shade in a loss as ``weigh`` says, for the noise of a batch ``(B, 4, h, w)``."""
    return WEIGHINGS[weigh](loss, sample)


def _linear(loss: Criterion, sample: Sample) -> Criterion:
    return loss


def _normalised(loss: Criterion, sample: Sample) -> Criterion:
    deviation = sample.variance.sqrt().clamp_min(1e-6)
    return _in_units(loss, deviation)


def _stabilised(loss: Criterion, sample: Sample) -> Criterion:
    levels = fit_levels(sample.noisy, sample.variance)
    transform = DOMAINS["anscombe"].forward

    def criterion(denoised: Tensor, clean: Tensor) -> Tensor:
        return loss(transform(denoised, *levels), transform(clean, *levels))

    return criterion


def _mixed(loss: Criterion, sample: Sample) -> Criterion:
    deviation = sample.variance.sqrt().mean(_PICTURE, keepdim=True).clamp_min(1e-12)
    stabilised = _stabilised(loss, sample)
    linear = _in_units(loss, deviation)

    def criterion(denoised: Tensor, clean: Tensor) -> Tensor:
        return 0.5 * (stabilised(denoised, clean) + linear(denoised, clean))

    return criterion


def _relative(loss: Criterion, sample: Sample) -> Criterion:
    """Weigh by the picture's root mean square error, so that weak noise counts as much as strong noise."""
    mean_square = (sample.noisy - sample.clean).square().mean(_PICTURE, keepdim=True)
    return _in_units(loss, mean_square.sqrt().clamp_min(LEAST_ERROR))


def _in_units(loss: Criterion, unit: Tensor) -> Criterion:
    """Divide both pictures by a unit before the loss."""

    def criterion(denoised: Tensor, clean: Tensor) -> Tensor:
        return loss(denoised / unit, clean / unit)

    return criterion


WEIGHINGS: dict[str, Callable[[Criterion, Sample], Criterion]] = {
    "linear": _linear,
    "normalised": _normalised,
    "stabilised": _stabilised,
    "mixed": _mixed,
    "relative": _relative,
}
"""This maps names to weighings: functions of a loss and a batch that return the weighed loss."""
