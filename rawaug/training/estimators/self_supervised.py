"""What estimators that know noisy frames alone have in common, and noise put on top of noise."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from rawaug.training.estimators.supervised import Supervised


def variance_of(noisy: Tensor, shot_var: float, read_var: float) -> Tensor:
    """The noise map of a frame, computed from the noisy signal clipped at black as in every test; its shape."""
    return read_var + shot_var * noisy.clamp_min(0.0)


def drawing_variance(noisy: Tensor, shot_var: float, read_var: float) -> Tensor:
    """The variance with which noise is put on top of ``noisy``: ``shot_var y + read_var``, at least 0.

    The signal is not clipped at black first: of the noisy values around a dark ``x`` half lie below it, and the mean
    of the variance must be that at ``x``. It is as long as ``y`` rarely falls below ``-read_var / shot_var``.
    """
    return (shot_var * noisy + read_var).clamp_min(0.0)


class SelfSupervised(Supervised, ABC):
    """Base: ``apply(shots, levels, sample(shape, generator))`` makes a training sample of noisy frames.

    ``shots`` is how many noisy frames of one scene it needs.
    """

    shots = 1
    sees_clean = False

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """All that is random, for a packed crop of ``shape`` (4, h, w): white noise of variance 1."""
        return torch.randn(shape, generator=generator)

    @abstractmethod
    def apply(self, shots: Tensor, shot_var: float, read_var: float, drawn: Tensor) -> Any:
        """The training sample of packed noisy crops ``(K, 4, h, w)``, K >= ``shots``; pure."""


def recorrupted(noisy: Tensor, shot_var: float, read_var: float, alpha: float, drawn: Tensor) -> tuple[Tensor, Tensor]:
    """``y + alpha m``, clipped at white, and the variance map of all its noise."""
    noisier = (noisy + alpha * drawing_variance(noisy, shot_var, read_var).sqrt() * drawn).clamp(max=1.0)
    return noisier, (1.0 + alpha**2) * variance_of(noisier, shot_var, read_var)


def positive(alpha: float) -> float:
    """``alpha``, or an error."""
    if not alpha > 0:
        raise ValueError(f"alpha must be positive, got {alpha}")
    return alpha
