r"""Estimators, which train on noisy frames alone: input and target are both made of one noisy RAW ``y = x + n``.

=================  ========================  ====================  =====================================================
estimator          input                     target                what ``l2`` training converges to
=================  ========================  ====================  =====================================================
noisier            ``z = y + a m``           ``y``                 E[y | z], biased: 1/(1 + a^2) of the noise stays
noisier, correct   the same                  the same              ((1 + a^2) E[y | z] - z) / a^2 = E[x | z], unbiased
noise2noise        ``y``                     another shot ``y'``   E[x | y], unbiased; needs two shots of a scene
r2r                ``y + a m``               ``y - m / a``         E[x | input], unbiased
neighbor2neighbor  one pixel of each cell    its neighbour         E[neighbour | input]: biased where neighbours differ
=================  ========================  ====================  =====================================================

``m`` is drawn with the noise's own variance at x, ``shot_var x + read_var``. For pictures x is known; for real frames
it is estimated (:func:`rawaug.training.noisy_frames.signal_estimate`), and the error of that estimate remains as a
bias, mostly at edges. Whatever the sensor clipped at black (as in SIDD's published frames) or at white is lost to every
estimator. Targets are noisy, so the loss has to be l2: its minimum is the mean of the targets, whereas that of l1 is
their median.

Domain: packed RAW, black 0, white 1. Inputs are clipped at white as frames are; targets are not. Sources: Conde et al.,
AAAI 2022, "Unsupervised experiments" (noisier); Moran et al., "Noisier2Noise", CVPR 2020 (its correction); Lehtinen et
al., ICML 2018 (noise2noise); Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021 (r2r); Huang et al.,
"Neighbor2Neighbor", CVPR 2021.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Collection
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from denoisers.network import Denoiser
from rawaug.bayer import noise_variance
from rawaug.data.pairs import Sample
from rawaug.registry import Registry
from rawaug.training.losses import Criterion
from rawaug.training.weighing import WEIGHINGS

ESTIMATORS = Registry("estimator", "rawaug.estimators", "rawaug.training")
"""This maps names to estimators, subclasses of :class:`Supervised` that say what a training step learns from."""


@ESTIMATORS.register("supervised")
class Supervised:
    """Training with clean targets, ``loss = criterion(model(noisy, variance), clean)``, and the base of all estimators.

    Attributes:
        sees_clean: whether it needs clean frames; a recipe cannot mix estimators that do with others.
        revision: a number that grows whenever the same frames give other samples, so that weights are trained anew.
        weighings: the entries of :data:`WEIGHINGS` that it can be trained with.
    """

    sees_clean: ClassVar[bool] = True
    revision: ClassVar[int] = 0
    weighings: ClassVar[Collection[str]] = WEIGHINGS

    def loss(self, model: Any, sample: Any, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """Compute the loss of a batch, a scalar.

        Args:
            model: maps noisy RAW and its variance, both ``(B, 4, h, w)``, to denoised RAW.
            sample: the batch.
            criterion: the distance of denoised RAW from the target.
            progress: the share of the training that is over, from 0 to 1.
        """
        denoised = model(sample.noisy, sample.variance)
        return criterion(denoised, sample.clean)

    def require(self, model: Denoiser) -> None:
        """Raise ValueError if it cannot train this network."""

    def correct_network(self, model: Denoiser) -> Denoiser:
        """Return the denoiser that a trained network becomes: by default the network itself."""
        return model


class NoisyCrop(NamedTuple):
    """A packed crop of one scene: its shots, its signal or an estimate of it, and the levels of its noise.

    Attributes:
        shots: noisy RAW ``(N, 4, h, w)``, the same scene in each.
        signal: the scene without noise, or an estimate of it, ``(4, h, w)``.
        shot_var: slope of the noise's variance over the signal.
        read_var: its variance at black.
    """

    shots: Tensor
    signal: Tensor
    shot_var: float
    read_var: float

    def variance(self, signal: Tensor) -> Tensor:
        """Compute the variance of the noise at a signal of any shape, in that shape."""
        return noise_variance(signal, self.shot_var, self.read_var)

    @property
    def deviation(self) -> Tensor:
        """The standard deviation of a shot's noise, ``(4, h, w)``."""
        return self.variance(self.signal).sqrt()


class SelfSupervised(Supervised, ABC):
    """Training with noisy targets: ``apply(crop, sample(shape, generator))`` makes a sample of noisy frames.

    Only weighings whose factors do not depend on the noisy target remain, since the others would move its mean.
    """

    shots: ClassVar[int] = 1
    adds_noise: ClassVar[bool] = False
    sees_clean = False
    revision = 1  # since weights began to be chosen on r2r pairs
    weighings: ClassVar[Collection[str]] = ("linear", "normalised")

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """Draw all that is random for a packed crop of a shape ``(4, h, w)``: by default white noise of variance 1."""
        return torch.randn(shape, generator=generator)

    @abstractmethod
    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Any:
        """Make the training sample of a crop, of images ``(4, h, w)``, from nothing but the arguments.

        Args:
            crop: a crop of ``shots`` shots or more.
            drawn: what :meth:`sample` drew for it.
        """


class _AddsNoise(SelfSupervised):
    """Estimators whose input is ``y + alpha m``."""

    adds_noise = True

    def __init__(self, alpha: float = 0.5) -> None:
        if not alpha > 0:
            raise ValueError(f"alpha must be positive, got {alpha}")

        self.alpha = alpha

    def recorrupt(self, crop: NoisyCrop, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Make ``y + alpha m``, clipped at white, and the variance of all its noise, both ``(4, h, w)``."""
        noisier = crop.shots[0] + self.alpha * crop.deviation * normals
        noisier = noisier.clamp(max=1.0)
        variance = (1.0 + self.alpha**2) * crop.variance(noisier)
        return noisier, variance


@ESTIMATORS.register("noisier")
class Noisier(_AddsNoise):
    """The input is made noisier; the noisy frame is the target.

    Args:
        alpha: standard deviation of the extra noise in units of the noise's own.
        correct: whether the trained network is extrapolated to the clean signal. As the network is ``z + R(z)``, the
            corrected one is ``z + (1 + 1/alpha^2) R(z)``, which is its last convolution times a constant.
    """

    def __init__(self, alpha: float = 1.0, correct: bool = False) -> None:
        super().__init__(alpha)
        self.correct = correct

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """Make noisier RAW, the frame as it was shot, and the variance, each ``(4, h, w)``."""
        noisier, variance = self.recorrupt(crop, drawn)
        return Sample(noisier, crop.shots[0], variance)

    def require(self, model: Denoiser) -> None:
        """Raise ValueError if the result is to be corrected, but the network does not add to the RAW."""
        if self.correct and model.domain not in ("linear", "ksigma"):
            raise ValueError(
                f"estimator: noisier with correct extrapolates the RAW, which a network in the domain {model.domain} "
                "does not add to; use r2r, or a network in the domain linear or ksigma"
            )

    def correct_network(self, model: Denoiser) -> Denoiser:
        """Return a copy of the network whose last convolution is multiplied, if ``correct`` is set."""
        if not self.correct:
            return model

        model = copy.deepcopy(model)
        convolutions = [layer for layer in model.modules() if isinstance(layer, nn.Conv2d)]
        with torch.no_grad():
            for parameter in convolutions[-1].parameters():
                parameter.mul_(1.0 + self.alpha**-2)
        return model


@ESTIMATORS.register("r2r")
class R2R(_AddsNoise):
    """Input and target are made of the frame with the same noise, whose covariance cancels: ``(y + a m, y - m / a)``.

    Args:
        alpha: a above. If it is small, the input is only a little noisier than the frame, but the target is much
            noisier; if it is 1, both have twice the variance.
    """

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """Make noisier RAW, a target with the opposite noise, and the variance, each ``(4, h, w)``."""
        noisier, variance = self.recorrupt(crop, drawn)
        target = crop.shots[0] - crop.deviation * drawn / self.alpha
        return Sample(noisier, target, variance)


@ESTIMATORS.register("noise2noise")
class Noise2Noise(SelfSupervised):
    """Two shots of one scene with independent noise, one as input and one as target."""

    shots = 2

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """Draw the number of the shot that is the input, 0 or 1, a scalar."""
        return torch.randint(2, (), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """Return one shot, the other, and the variance, each ``(4, h, w)``."""
        noisy = crop.shots[drawn]
        target = crop.shots[1 - drawn]
        return Sample(noisy, target, crop.variance(noisy))
