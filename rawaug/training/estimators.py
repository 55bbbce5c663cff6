r"""What a denoiser learns from noisy frames alone: pairs of input and target made of one noisy RAW ``y = x + n``.

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
bias, mostly at edges. What the sensor clipped at black (as in SIDD's published frames) or at white is lost to every
estimator. Targets are noisy, so the loss has to be l2: its minimum is the mean of the targets, that of l1 their median.

Domain: packed RAW, black 0, white 1. Inputs are clipped at white as frames are, targets are not.
Sources: Conde et al., AAAI 2022, "Unsupervised experiments" (noisier); Moran et al., "Noisier2Noise", CVPR 2020 (its
correction); Lehtinen et al., ICML 2018 (noise2noise); Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021 (r2r);
Huang et al., "Neighbor2Neighbor", CVPR 2021.

A sample is compared with its target by a norm, which may weigh light and shade.

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

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from denoisers.domains import DOMAINS, fit_levels
from denoisers.network import Denoiser
from rawaug.bayer import noise_variance
from rawaug.data.pairs import Sample
from rawaug.registry import Registry

ESTIMATORS = Registry("estimator", "rawaug.estimators", "rawaug.training")
"""The estimators by name: subclasses of :class:`Supervised`, which say what a training step learns from."""

LOSSES = Registry("loss", "rawaug.losses", "rawaug.training")
"""The losses by name: classes whose instances are called as ``loss(denoised, target) -> scalar``."""

Criterion = Callable[[Tensor, Tensor], Tensor]
"""``criterion(denoised, target)``: two batches ``(B, 4, h, w)`` to a scalar."""

LEAST_ERROR = 1.0 / 255.0
"""The unit of ``relative`` for pictures with hardly any noise: one step of an 8-bit file."""

LOSSES.register("l1")(nn.L1Loss)
LOSSES.register("l2")(nn.MSELoss)


@LOSSES.register("rms")
class RootMeanSquare(nn.Module):
    """The mean over pictures of ``sqrt(mean (a - b)^2 + epsilon^2)``.

    Hard pictures do not outweigh the rest, as they do in l2. With ``weigh: relative`` it is the share of the noise that
    is left.
    """

    def __init__(self, epsilon: float = 1e-2) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Compare two batches ``(B, C, H, W)``: a scalar."""
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


# -- what is learned from what ----------------------------------------------------------------------------------------


@ESTIMATORS.register("supervised")
class Supervised:
    """Training with clean targets: ``loss = criterion(model(noisy, variance), clean)``. Base of all estimators.

    Attributes:
        sees_clean: whether it needs clean frames; a recipe cannot mix estimators that do with others.
        revision: a number that grows whenever the same frames give other samples, so that weights are trained anew.
        weighings: those of :data:`WEIGHINGS` that it can be trained with.
    """

    sees_clean: ClassVar[bool] = True
    revision: ClassVar[int] = 0
    weighings: ClassVar[Collection[str]] = WEIGHINGS

    def loss(self, model: Any, sample: Any, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """The loss of a batch, a scalar.

        Args:
            model: maps noisy RAW and its variance, both ``(B, 4, h, w)``, to denoised RAW.
            sample: the batch.
            criterion: the distance of denoised RAW from the target.
            progress: the share of the training that is over, from 0 to 1.
        """
        return criterion(model(sample.noisy, sample.variance), sample.clean)

    def require(self, model: Denoiser) -> None:
        """Raise ValueError if it cannot train this network."""

    def correct_network(self, model: Denoiser) -> Denoiser:
        """The denoiser that a trained network becomes: by default the network itself."""
        return model


class NoisyCrop(NamedTuple):
    """A packed crop of one scene, as far as it is known.

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
        """The variance of the noise at a signal of any shape, in that shape."""
        return noise_variance(signal, self.shot_var, self.read_var)

    @property
    def deviation(self) -> Tensor:
        """The standard deviation of a shot's noise, ``(4, h, w)``."""
        return self.variance(self.signal).sqrt()


class SelfSupervised(Supervised, ABC):
    """Training with noisy targets: ``apply(crop, sample(shape, generator))`` makes a sample of noisy frames.

    Only weighings whose factors do not depend on the noisy target remain: the others would move its mean.
    """

    shots: ClassVar[int] = 1
    adds_noise: ClassVar[bool] = False
    sees_clean = False
    revision = 1  # since weights are chosen on r2r pairs
    weighings: ClassVar[Collection[str]] = ("linear", "normalised")

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """All that is random for a packed crop of ``shape``, ``(4, h, w)``: by default white noise of variance 1."""
        return torch.randn(shape, generator=generator)

    @abstractmethod
    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Any:
        """The training sample of a crop, of images ``(4, h, w)``; the crop has ``shots`` shots or more. Pure."""


class _AddsNoise(SelfSupervised):
    """Estimators whose input is ``y + alpha m``."""

    adds_noise = True

    def __init__(self, alpha: float = 0.5) -> None:
        if not alpha > 0:
            raise ValueError(f"alpha must be positive, got {alpha}")
        self.alpha = alpha

    def recorrupt(self, crop: NoisyCrop, drawn: Tensor) -> tuple[Tensor, Tensor]:
        """``y + alpha m`` clipped at white, and the variance of all its noise, both ``(4, h, w)``."""
        noisier = (crop.shots[0] + self.alpha * crop.deviation * drawn).clamp(max=1.0)
        return noisier, (1.0 + self.alpha**2) * crop.variance(noisier)


@ESTIMATORS.register("noisier")
class Noisier(_AddsNoise):
    """The input is made noisier; the noisy frame is the target.

    Args:
        alpha: standard deviation of the extra noise in units of that of the noise.
        correct: whether the trained network is extrapolated to the clean signal. As the network is ``z + R(z)``, the
            corrected one is ``z + (1 + 1/alpha^2) R(z)``: its last convolution times a constant.
    """

    def __init__(self, alpha: float = 1.0, correct: bool = False) -> None:
        super().__init__(alpha)
        self.correct = correct

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """Noisier RAW, the frame as it was shot, and the variance, each ``(4, h, w)``."""
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
        """A copy of the network whose last convolution is multiplied, if ``correct`` is set."""
        if not self.correct:
            return model
        model = copy.deepcopy(model)
        last = [layer for layer in model.modules() if isinstance(layer, nn.Conv2d)][-1]
        with torch.no_grad():
            for parameter in last.parameters():
                parameter.mul_(1.0 + self.alpha**-2)
        return model


@ESTIMATORS.register("r2r")
class R2R(_AddsNoise):
    """Input and target are made of the frame with the same noise, whose covariance cancels: ``(y + a m, y - m / a)``.

    Args:
        alpha: a above. If it is small, the input is little noisier than the frame, but the target much; if it is 1,
            both have twice the variance.
    """

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """Noisier RAW, a target with the opposite noise, and the variance, each ``(4, h, w)``."""
        noisier, variance = self.recorrupt(crop, drawn)
        return Sample(noisier, crop.shots[0] - crop.deviation * drawn / self.alpha, variance)


@ESTIMATORS.register("noise2noise")
class Noise2Noise(SelfSupervised):
    """Two shots of one scene with independent noise, one as input and one as target."""

    shots = 2

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """The number of the shot that is the input, 0 or 1, a scalar."""
        return torch.randint(2, (), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> Sample:
        """One shot, the other, and the variance, each ``(4, h, w)``."""
        noisy, target = crop.shots[drawn], crop.shots[1 - drawn]
        return Sample(noisy, target, crop.variance(noisy))


class NeighborSample(NamedTuple):
    """Noisy RAW and its variance ``(4, h, w)``, and for each 2 x 2 cell the pair of neighbours, ``(1, h/2, w/2)``."""

    noisy: Tensor
    variance: Tensor
    choice: Tensor


NEIGHBOURS = ((0, 1), (1, 0), (2, 3), (3, 2), (0, 2), (2, 0), (1, 3), (3, 1))
"""Ordered pairs of horizontal or vertical neighbours among the pixels 0 1 / 2 3 of a cell."""


@ESTIMATORS.register("neighbor2neighbor")
class Neighbor2Neighbor(SelfSupervised):
    """Two neighbours of every 2 x 2 cell of each packed plane are input and target.

    ``loss = c(f(g1 y), g2 y) + gamma c(f(g1 y) - g2 y, g1 f(y) - g2 f(y))``: the second term takes off what the
    neighbours' own difference, as the network sees it, adds to the first; gradients do not pass through f(y). An
    untrained network takes noise for that difference, so the term comes in as training goes on.

    Args:
        gamma: weight of the second term at the end; it grows in proportion to the steps. Published: 2 for synthetic
            noise, 16 for the RAW of SIDD; the larger it is, the smoother the result.
    """

    weighings = ("linear",)  # two pixels of different noise are compared

    def __init__(self, gamma: float = 2.0) -> None:
        if gamma < 0:
            raise ValueError(f"gamma must be at least 0, got {gamma}")
        self.gamma = gamma

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """The choice of every cell, ``(1, h/2, w/2)``; the planes share it, so that their colours belong together."""
        return torch.randint(len(NEIGHBOURS), (1, shape[-2] // 2, shape[-1] // 2), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> NeighborSample:
        """The shot ``(4, h, w)`` with the choice of its neighbours."""
        return NeighborSample(crop.shots[0], crop.variance(crop.shots[0]), drawn)

    def loss(self, model: Any, sample: NeighborSample, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """The scalar above; ``model``, ``sample``, ``criterion`` and ``progress`` as in :meth:`Supervised.loss`."""
        (first, second), (variance, _) = (neighbours(x, sample.choice) for x in (sample.noisy, sample.variance))
        with torch.no_grad():
            denoised_first, denoised_second = neighbours(model(sample.noisy, sample.variance), sample.choice)
        denoised = model(first, variance)
        difference = criterion(denoised - second, denoised_first - denoised_second)
        return criterion(denoised, second) + progress * self.gamma * difference


def neighbours(image: Tensor, choice: Tensor) -> tuple[Tensor, Tensor]:
    """The two pictures ``(B, 4, h/2, w/2)`` that ``choice`` ``(B, 1, h/2, w/2)`` picks from ``(B, 4, h, w)``."""
    height, width = (side // 2 * 2 for side in image.shape[-2:])
    image = image[..., :height, :width]
    cells = torch.stack([image[..., i::2, j::2] for i in (0, 1) for j in (0, 1)])
    table = torch.tensor(NEIGHBOURS, device=choice.device)
    first, second = (table[choice, k][None].expand(1, *cells.shape[1:]) for k in (0, 1))
    return cells.gather(0, first)[0], cells.gather(0, second)[0]
