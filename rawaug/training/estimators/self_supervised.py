"""What estimators that know noisy frames alone have in common, and noise put on top of noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from rawaug.training.estimators.supervised import Supervised


def variance_of(noisy: Tensor, shot_var: float, read_var: float) -> Tensor:
    """``read_var + shot_var max(y, 0)``: the noise map of a frame, as in every test; its shape."""
    return read_var + shot_var * noisy.clamp_min(0.0)


class NoisyCrop(NamedTuple):
    """What is known of one scene.

    Args:
        shots: packed noisy crops of it ``(K, 4, h, w)``.
        signal: it without noise ``(4, h, w)``, known or estimated: the noise's variance is that at ``signal``. For an
            estimator whose ``adds_noise`` is False it is not estimated, and the first shot stands in its place.
        shot_var, read_var: the levels of the noise.
    """

    shots: Tensor
    signal: Tensor
    shot_var: float
    read_var: float

    @property
    def deviation(self) -> Tensor:
        """Standard deviation of the noise of a shot, ``(4, h, w)``."""
        return variance_of(self.signal, self.shot_var, self.read_var).sqrt()


class SelfSupervised(Supervised, ABC):
    """Base: ``apply(crop, sample(shape, generator))`` makes a training sample of noisy frames.

    ``shots`` is how many noisy frames of one scene it needs; ``adds_noise`` says that it uses a crop's ``signal``,
    which of a real frame has to be estimated.
    """

    shots = 1
    adds_noise: ClassVar[bool] = False
    sees_clean = False
    revision = 1  # weights are chosen on r2r pairs, whatever the estimator

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """All that is random, for a packed crop of ``shape`` (4, h, w): white noise of variance 1."""
        return torch.randn(shape, generator=generator)

    @abstractmethod
    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Any:
        """The training sample of a crop with at least ``shots`` shots; pure."""


def recorrupted(crop: NoisyCrop, alpha: float, drawn: Tensor) -> tuple[Tensor, Tensor]:
    """``y + alpha m``, clipped at white, and the variance map of all its noise."""
    noisier = (crop.shots[0] + alpha * crop.deviation * drawn).clamp(max=1.0)
    return noisier, (1.0 + alpha**2) * variance_of(noisier, crop.shot_var, crop.read_var)


def positive(alpha: float) -> float:
    """``alpha``, or an error."""
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, got {alpha}")
    return alpha
