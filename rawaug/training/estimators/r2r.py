"""Recorrupted twice, with noise that cancels in the covariance (Pang et al., CVPR 2021)."""

from __future__ import annotations

from torch import Tensor

from rawaug.data.sample import Sample
from rawaug.registry import ESTIMATORS
from rawaug.training.estimators.self_supervised import SelfSupervised, positive, recorrupted, variance_of


@ESTIMATORS.register("r2r")
class R2R(SelfSupervised):
    """Recorrupted twice, with noise that cancels in the covariance: ``(y + a m, y - m / a)``.

    Args:
        alpha: small: the input is little noisier than the frame, the target much; 1: both have twice the variance.
    """

    def __init__(self, alpha: float = 0.5) -> None:
        self.alpha = positive(alpha)

    def apply(self, shots: Tensor, shot_var: float, read_var: float, drawn: Tensor) -> Sample:
        """See :meth:`SelfSupervised.apply`."""
        noisy = shots[0]
        noisier, variance = recorrupted(noisy, shot_var, read_var, self.alpha, drawn)
        target = noisy - variance_of(noisy, shot_var, read_var).sqrt() * drawn / self.alpha
        return Sample(noisier, target, variance)
