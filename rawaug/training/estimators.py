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

``m`` is drawn with the noise's own variance at x, ``shot_var x + read_var``. Of pictures x is known; of real frames
there is a first estimate (:mod:`rawaug.training.noisy_frames`), and what that errs by is left as a bias, most of it
at edges. What the sensor clipped at black (as SIDD's published frames are) or at white is lost to every estimator.

Targets are noisy, so the loss has to be l2: its minimum is the mean of the targets, that of l1 their median.

Domain: packed RAW, black 0, white 1. Inputs are clipped at white as frames are, targets are not.
Sources: Conde et al., AAAI 2022, "Unsupervised experiments" (noisier); Moran et al., "Noisier2Noise", CVPR 2020 (its
correction); Lehtinen et al., ICML 2018 (noise2noise); Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021 (r2r);
Huang et al., "Neighbor2Neighbor", CVPR 2021.
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from denoisers.inference import Recorrupted
from denoisers.network import Denoiser
from rawaug.data.pairs import Sample
from rawaug.registry import ESTIMATORS
from rawaug.training.criteria import Criterion


@ESTIMATORS.register("supervised")
class Supervised:
    """Clean targets: samples come ready, ``loss = criterion(model(noisy, variance), clean)``.

    ``sees_clean`` says whether it needs clean frames: in a recipe such estimators and others do not mix. ``revision``
    counts the changes of what it makes of the same frames: weights of another one are trained anew.
    """

    sees_clean: ClassVar[bool] = True
    revision: ClassVar[int] = 0

    def loss(self, model: Any, sample: Any, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """Of a batch, a scalar; ``progress`` is the share of the training that is over."""
        return criterion(model(sample.noisy, sample.variance), sample.clean)

    def corrected(self, model: Denoiser) -> Denoiser:
        """The denoiser to use in place of the trained one; itself, or a new network."""
        return model

    def at_test(self, run: Callable[..., Tensor]) -> Callable[..., Tensor]:
        """What to call at a test in place of ``run(noisy, variance)``; itself, or something around it."""
        return run


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


class NeighborSample(NamedTuple):
    """A noisy frame and, for each 2 x 2 cell of a plane, which two neighbours make the pair.

    Args:
        noisy, variance: packed ``(4, h, w)``, in a batch ``(B, 4, h, w)``.
        choice: ``(1, h/2, w/2)`` from 0 to 7, see :data:`NEIGHBOURS`.
    """

    noisy: Tensor
    variance: Tensor
    choice: Tensor


NEIGHBOURS = ((0, 1), (1, 0), (2, 3), (3, 2), (0, 2), (2, 0), (1, 3), (3, 1))
"""Ordered pairs of horizontal or vertical neighbours among the pixels 0 1 / 2 3 of a cell."""


@ESTIMATORS.register("neighbor2neighbor")
class Neighbor2Neighbor(SelfSupervised):
    """Two neighbours of every 2 x 2 cell of each packed plane, one as input and one as target.

    ``loss = c(f(g1 y), g2 y) + gamma c(f(g1 y) - g2 y, g1 f(y) - g2 f(y))``: the second term takes off what the
    neighbours' own difference, as the network sees it, adds to the first; gradients do not pass through f(y). An
    untrained network takes noise for that difference, so the term comes in as training goes on.

    Args:
        gamma: its weight at the end; it grows in proportion to the steps. Published: 2 for synthetic noise, 16 for the
            RAW of SIDD; the larger it is, the smoother the result.
    """

    def __init__(self, gamma: float = 2.0) -> None:
        if gamma < 0:
            raise ValueError(f"gamma must be at least 0, got {gamma}")
        self.gamma = gamma

    def sample(self, shape: torch.Size, generator: torch.Generator) -> Tensor:
        """The choice of every cell; the planes share it, so that their colours belong together."""
        return torch.randint(len(NEIGHBOURS), (1, shape[-2] // 2, shape[-1] // 2), generator=generator)

    def apply(self, crop: NoisyCrop, drawn: Tensor) -> NeighborSample:
        """See :meth:`SelfSupervised.apply`."""
        noisy = crop.shots[0]
        return NeighborSample(noisy, variance_of(noisy, crop.shot_var, crop.read_var), drawn)

    def loss(self, model: Any, sample: NeighborSample, criterion: Criterion, progress: float = 1.0) -> Tensor:
        """See :meth:`Supervised.loss`."""
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
