r"""The squared error of a denoised image, estimated without a clean one (Stein's unbiased risk).

.. math:: \operatorname{E} |f(y) - x|^2 = \operatorname{E} \Big[ |f(y) - y|^2 - \sum_i \sigma_i^2
          + 2 \sum_i \sigma_i^2 \frac{\partial f_i}{\partial y_i} \Big], \qquad \sigma_i^2 = s x_i + r

for Gaussian noise of a known law (Stein, Annals of Statistics 9, 1981; for signal-dependent noise Luisier, Blu and
Unser, IEEE TIP 20, 2011). The derivatives are those of one more pass, on y + e with e of random signs (Ramani, Blu and
Unser, IEEE TIP 17, 2008), and the denoiser is told the levels of the noise in it as well. The second term is the sum of
s y + r, whose mean is right; the third takes the variance from f(y), since the noise of y would be correlated with the
derivative.
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


class Probe(NamedTuple):
    """What two passes say of a denoiser; every tensor has the shape of the image.

    Attributes:
        denoised: f(y).
        variance: s f(y) + r, the variance of the noise by the denoised image.
        change: e, of random signs and :data:`PROBE` deviations.
        response: f(y + e) - f(y).
    """

    denoised: Tensor
    variance: Tensor
    change: Tensor
    response: Tensor

    @property
    def kept(self) -> Tensor:
        """The share of each value's own noise that is kept, an unbiased and very noisy estimate of df_i / dy_i."""
        return self.response / self.change


def probe_denoiser(denoise: Callable[[Noisy], Tensor], noisy: Noisy, seed: int = 0) -> Probe:
    """Denoise an image ``(1, C, H, W)`` and the same image with a small change.

    Raises:
        ValueError: if the levels of the noise are not known.
    """
    if noisy.levels is None:
        raise ValueError("the error of a denoiser can be estimated only where the levels of the noise are known")

    denoised = denoise(noisy)
    variance = noise_variance(denoised, *noisy.levels).clamp_min(1e-12)
    generator = torch.Generator().manual_seed(seed)
    signs = 2.0 * torch.randint(2, noisy.image.shape, generator=generator) - 1.0
    change = PROBE * variance.sqrt() * signs

    changed = Noisy.of(noisy.image + change, noisy.levels, noisy.cfa)
    return Probe(denoised, variance, change, denoise(changed) - denoised)


def estimate_risk(probe: Probe, image: Tensor, levels: Levels) -> Tensor:
    """Estimate the squared error of each value; single ones are very noisy and may be negative, means are right.

    Args:
        probe: see :func:`probe_denoiser`.
        image: the noisy image, ``(1, C, H, W)``.
        levels: (shot_var, read_var) of its noise.
    """
    shot_var, read_var = levels
    return (probe.denoised - image).square() - (shot_var * image + read_var) + 2.0 * probe.variance * probe.kept
