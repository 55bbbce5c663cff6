"""Two shots of one scene with independent noise (Lehtinen et al., ICML 2018)."""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.data.sample import Sample
from rawaug.registry import ESTIMATORS
from rawaug.training.estimators.self_supervised import NoisyCrop, SelfSupervised, variance_of


@ESTIMATORS.register("noise2noise")
class Noise2Noise(SelfSupervised):
    """Two shots of one scene with independent noise, one as input and one as target."""

    shots = 2

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """Which of the two is the input: 0 or 1."""
        return torch.randint(2, (), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """See :meth:`SelfSupervised.apply`."""
        noisy, target = crop.shots[drawn], crop.shots[1 - drawn]
        return Sample(noisy, target, variance_of(noisy, crop.shot_var, crop.read_var))
