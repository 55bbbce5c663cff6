"""Input made noisier, the noisy frame as target (Moran et al., CVPR 2020; Conde et al., AAAI 2022)."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from denoisers.network import Denoiser
from rawaug.data.sample import Sample
from rawaug.registry import ESTIMATORS
from rawaug.training.estimators.self_supervised import NoisyCrop, SelfSupervised, positive, recorrupted


@ESTIMATORS.register("noisier")
class Noisier(SelfSupervised):
    """Input made noisier, the noisy frame as target.

    Args:
        alpha: standard deviation of the extra noise over that of the noise.
        correct: extrapolate the trained network to the clean signal. As the network is ``z + R(z)``, the corrected one
            is ``z + (1 + 1/alpha^2) R(z)``: its last convolution times a constant.
    """

    adds_noise = True

    def __init__(self, alpha: float = 1.0, correct: bool = False) -> None:
        self.alpha, self.correct = positive(alpha), correct

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """See :meth:`SelfSupervised.apply`."""
        noisier, variance = recorrupted(crop, self.alpha, drawn)
        return Sample(noisier, crop.shots[0], variance)

    def corrected(self, model: Denoiser) -> Denoiser:
        """See :meth:`Supervised.corrected`."""
        if not self.correct:
            return model
        model = copy.deepcopy(model)
        last = [layer for layer in model.modules() if isinstance(layer, nn.Conv2d)][-1]
        with torch.no_grad():
            for parameter in last.parameters():
                parameter.mul_(1.0 + self.alpha**-2)
        return model
