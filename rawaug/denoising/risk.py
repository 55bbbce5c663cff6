r"""The squared error of a denoised image, estimated without a clean one (Stein's unbiased risk).

.. math:: \operatorname{E} |f(y) - x|^2 = \operatorname{E} \Big[ |f(y) - y|^2 - \sum_i \sigma_i^2
          + 2 \sum_i \sigma_i^2 \frac{\partial f_i}{\partial y_i} \Big], \qquad \sigma_i^2 = s x_i + r

for Gaussian noise of a known law (Stein, Annals of Statistics 9, 1981; for signal-dependent noise Luisier, Blu and
Unser, IEEE TIP 20, 2011). The derivatives are those of one more pass, on y + e with e of random signs (Ramani, Blu and
Unser, IEEE TIP 17, 2008), and the denoiser is told the levels of the noise in it as well. The second term is the sum of
s y + r, whose mean is right; the third takes the variance from f(y), since the noise of y would be correlated with the
derivative.

No unbiased estimate is better than this one, and its deviation is that of the noise's energy, :math:`\sqrt{2 \sum_i
\sigma_i^4}`: a denoiser that leaves a hundredth of the noise is known within a tenth of a decibel from some 40 million
values on. What it does to noise that is drawn anew on its own result d = f(y) can be measured without that deviation
(the parametric bootstrap; Efron, JASA 99, 2004). Its error there is too small by what d lacks of the texture of x; the
kept noise, which is measured on both, tells most of it:

.. math:: c = \overline{(f(d + n^*) - d)^2} \; \frac{\overline{\sigma^2 f'(y)}}{\overline{\sigma^2 f'(d + n^*)}}

The error m is then read from both: the unbiased estimate is normal around m, and the density of the logarithm
of m / c falls off exponentially on both sides of a tenth (:data:`MISSED`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.bayer import noise_variance
from rawaug.denoising.denoiser import Levels, Noisy

PROBE = 0.1
"""Size of the change e in standard deviations of the noise: small for f, large for float32."""

MISSED, ABOVE, BELOW = 0.1, 0.16, 0.06
"""Mode of the logarithm of m / c, and its scales above and below that: with these the estimates of ``rawaug-best`` on
the frames of ``real:validation`` and ``demo:validation`` were nearest to the truth."""

_STEPS = 2000


class Probe(NamedTuple):
    """What a pass and one more for each change say of a denoiser; tensors have the shape of the image.

    Attributes:
        denoised: f(y).
        variance: s f(y) + r, the variance of the noise by the denoised image.
        change: e, of random signs and :data:`PROBE` deviations, for each change ``(K, C, H, W)``.
        response: f(y + e) - f(y), ``(K, C, H, W)``.
    """

    denoised: Tensor
    variance: Tensor
    change: Tensor
    response: Tensor

    @property
    def kept(self) -> Tensor:
        """The share of each value's own noise that is kept, an unbiased and very noisy estimate of df_i / dy_i."""
        return (self.response / self.change).mean(0, keepdim=True)


def probe_denoiser(denoise: Callable[[Noisy], Tensor], noisy: Noisy, seed: int = 0, count: int = 1) -> Probe:
    """Denoise an image ``(1, C, H, W)`` and the same image with ``count`` small changes.

    Raises:
        ValueError: if the levels of the noise are not known.
    """
    if noisy.levels is None:
        raise ValueError("the error of a denoiser can be estimated only where the levels of the noise are known")

    denoised = denoise(noisy)
    variance = noise_variance(denoised, *noisy.levels).clamp_min(1e-12)
    generator = torch.Generator().manual_seed(seed)
    changes, responses = [], []
    for _ in range(count):
        signs = 2.0 * torch.randint(2, noisy.image.shape, generator=generator) - 1.0
        change = PROBE * variance.sqrt() * signs
        changed = Noisy.of(noisy.image + change, noisy.levels, noisy.cfa)
        changes.append(change)
        responses.append(denoise(changed) - denoised)
    return Probe(denoised, variance, torch.cat(changes), torch.cat(responses))


def estimate_risk(probe: Probe, image: Tensor, levels: Levels) -> Tensor:
    """Estimate the squared error of each value; single ones are very noisy and may be negative, means are right.

    Args:
        probe: see :func:`probe_denoiser`.
        image: the noisy image, ``(1, C, H, W)``.
        levels: (shot_var, read_var) of its noise.
    """
    shot_var, read_var = levels
    return (probe.denoised - image).square() - (shot_var * image + read_var) + 2.0 * probe.variance * probe.kept


def bootstrap_error(
    denoise: Callable[[Noisy], Tensor], probe: Probe, noisy: Noisy, is_counted: Tensor, seed: int = 0
) -> float:
    """Measure c, the mean squared error with noise that is drawn on the denoised image, in two more passes.

    Args:
        denoise: the denoiser.
        probe: what it made of the noisy image.
        noisy: the noisy image ``(1, C, H, W)`` with its levels.
        is_counted: which values count.
        seed: seed of the drawn noise.
    """
    assert noisy.levels is not None
    generator = torch.Generator().manual_seed(seed + 1)
    noise = probe.variance.sqrt() * torch.randn(noisy.image.shape, generator=generator)
    drawn = Noisy.of((probe.denoised + noise).clamp(max=1.0), noisy.levels, noisy.cfa)
    again = probe_denoiser(denoise, drawn, seed)

    error = float((again.denoised - probe.denoised).square()[is_counted].mean())
    kept = float((probe.variance * probe.kept)[is_counted].mean())
    kept_again = float((again.variance * again.kept)[is_counted].mean())
    if min(kept, kept_again) <= 0.0:
        return error
    return error * kept / kept_again


def combine_estimates(risk: float, deviation: float, bootstrapped: float) -> tuple[float, float, float]:
    """Read the mean squared error from its unbiased estimate and from c: the median and the ends of the 95% interval.

    Args:
        risk: the mean of :func:`estimate_risk`, which may be negative.
        deviation: its standard deviation.
        bootstrapped: see :func:`bootstrap_error`.

    Example:
        >>> combine_estimates(0.9, 0.01, 1.0)[0] < 0.95 < combine_estimates(0.9, 0.5, 1.0)[0] < 1.2
        True
    """
    logarithm = torch.linspace(-1.5, 4.0, _STEPS, dtype=torch.float64)
    error = bootstrapped * logarithm.exp()
    missed = logarithm - MISSED
    weight = torch.where(missed > 0.0, -missed / ABOVE, missed / BELOW)
    weight -= 0.5 * ((risk - error) / deviation).square()

    share = weight.softmax(0).cumsum(0)
    ends = torch.searchsorted(share, torch.tensor([0.5, 0.025, 0.975], dtype=torch.float64)).clamp(max=_STEPS - 1)
    median, low, high = error[ends].tolist()
    return median, low, high
