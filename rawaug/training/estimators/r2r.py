"""Recorrupted twice, with noise that cancels in the covariance (Pang et al., CVPR 2021)."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from denoisers.recorrupted import Recorrupted
from rawaug.data.sample import Sample
from rawaug.registry import ESTIMATORS
from rawaug.training.estimators.self_supervised import NoisyCrop, SelfSupervised, positive, recorrupted


@ESTIMATORS.register("r2r")
class R2R(SelfSupervised):
    """Recorrupted twice, with noise that cancels in the covariance: ``(y + a m, y - m / a)``.

    Args:
        alpha: small: the input is little noisier than the frame, the target much; 1: both have twice the variance.
        average: at a test, denoise this many recorrupted copies of a frame and average them, as published, and
            denoise it once before to know its noise; 0 denoises the frame itself.
    """

    adds_noise = True

    def __init__(self, alpha: float = 0.5, average: int = 0) -> None:
        if average < 0:
            raise ValueError(f"average must be at least 0, got {average}")
        self.alpha, self.average = positive(alpha), average

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """See :meth:`SelfSupervised.apply`."""
        noisier, variance = recorrupted(crop, self.alpha, drawn)
        return Sample(noisier, crop.shots[0] - crop.deviation * drawn / self.alpha, variance)

    def at_test(self, run: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """See :meth:`Supervised.at_test`."""
        return Recorrupted(run, self.alpha, self.average) if self.average else run
