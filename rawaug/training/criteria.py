r"""The distance between a denoised and a clean RAW: a norm, and its weighting of light and shade.

==============  ====================================================================================================
``weigh``       what is compared
==============  ====================================================================================================
linear          the RAW itself: shadows, whose errors are small, hardly count
normalised      the RAW in units of the noise's deviation at each pixel, which is that of the network's input
stabilised      :math:`2 \sqrt{y / s + r / s^2 + 3/8}`, where noise has deviation 1 in shadow and light alike
mixed           the mean of both, the linear one divided by the noise's mean deviation in the picture
relative        the picture in units of its own error before denoising; needs no variance: for developed pictures
==============  ====================================================================================================

with s = ``shot_var`` and r = ``read_var`` of the picture. An sRGB curve weighs errors much like ``stabilised``, both
being near a square root. The minimum of l1 is the median, which a curve does not move; that of l2 is the mean, and in
the stabilised domain it is not the mean of the RAW. So where targets are noisy, with l2, only ``linear`` and
``normalised`` are unbiased: their factors do not depend on the target.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from denoisers.domains import DOMAINS, fit_levels
from rawaug.data.pairs import Sample
from rawaug.registry import LOSSES

Criterion = Callable[[Tensor, Tensor], Tensor]
"""``criterion(denoised, target)``: two batches ``(B, 4, h, w)`` to a scalar."""

LEAST_ERROR = 1.0 / 255.0
"""The unit of ``relative`` for pictures with hardly any noise: one step of an 8-bit file."""

LOSSES.register("l1")(nn.L1Loss)
LOSSES.register("l2")(nn.MSELoss)


@LOSSES.register("rms")
class RootMeanSquare(nn.Module):
    """The mean over pictures of ``sqrt(mean (a - b)^2 + epsilon^2)``: l2 in which hard pictures do not outweigh the
    rest; what it is least for is the same. With ``weigh: relative`` it is the share of the noise that is left.
    """

    def __init__(self, epsilon: float = 1e-2) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        return ((a - b).square().flatten(1).mean(1) + self.epsilon**2).sqrt().mean()


def _normalised(loss: Criterion, sample: Sample) -> Criterion:
    deviation = sample.variance.sqrt().clamp_min(1e-6)
    return lambda denoised, clean: loss(denoised / deviation, clean / deviation)


def _stabilised(loss: Criterion, sample: Sample) -> Criterion:
    levels, root = fit_levels(sample.noisy, sample.variance), DOMAINS["anscombe"]
    return lambda denoised, clean: loss(*(root.forward(y, *levels) for y in (denoised, clean)))


def _mixed(loss: Criterion, sample: Sample) -> Criterion:
    in_root = _stabilised(loss, sample)
    deviation = sample.variance.sqrt().mean((1, 2, 3), keepdim=True).clamp_min(1e-12)
    return lambda denoised, clean: 0.5 * (in_root(denoised, clean) + loss(denoised / deviation, clean / deviation))


def _relative(loss: Criterion, sample: Sample) -> Criterion:
    """``loss`` in units of the picture's root mean square error, so that weak noise counts as much as strong noise."""
    error = (sample.noisy - sample.clean).square().mean((1, 2, 3), keepdim=True).sqrt().clamp_min(LEAST_ERROR)
    return lambda denoised, clean: loss(denoised / error, clean / error)


WEIGHINGS: dict[str, Callable[[Criterion, Sample], Criterion]] = {
    "linear": lambda loss, sample: loss,
    "normalised": _normalised,
    "stabilised": _stabilised,
    "mixed": _mixed,
    "relative": _relative,
}


def weigh_loss(loss: Criterion, weigh: str, sample: Sample) -> Criterion:
    """The loss with light and shade weighed as ``weigh`` says for the noise of a batch ``(B, 4, h, w)``."""
    return WEIGHINGS[weigh](loss, sample)
