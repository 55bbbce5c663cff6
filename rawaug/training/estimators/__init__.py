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
there is a first estimate (:mod:`rawaug.training.pilot`), and what that errs by is left as a bias, most of it at edges.
What the sensor clipped at black (as SIDD's published frames are) or at white is lost to every estimator.

Targets are noisy, so the loss has to be l2: its minimum is the mean of the targets, that of l1 their median.

Domain: packed RAW, black 0, white 1. Inputs are clipped at white as frames are, targets are not.
Sources: Conde et al., AAAI 2022, "Unsupervised experiments" (noisier); Moran et al., "Noisier2Noise", CVPR 2020 (its
correction); Lehtinen et al., ICML 2018 (noise2noise); Pang et al., "Recorrupted-to-Recorrupted", CVPR 2021 (r2r);
Huang et al., "Neighbor2Neighbor", CVPR 2021.
"""

from rawaug.training.estimators.neighbor2neighbor import NEIGHBOURS, Neighbor2Neighbor, NeighborSample, neighbours
from rawaug.training.estimators.noise2noise import Noise2Noise
from rawaug.training.estimators.noisier import Noisier
from rawaug.training.estimators.r2r import R2R
from rawaug.training.estimators.self_supervised import NoisyCrop, SelfSupervised, variance_of
from rawaug.training.estimators.supervised import Supervised

__all__ = [
    "NEIGHBOURS",
    "R2R",
    "Neighbor2Neighbor",
    "NeighborSample",
    "Noise2Noise",
    "Noisier",
    "NoisyCrop",
    "SelfSupervised",
    "Supervised",
    "neighbours",
    "variance_of",
]
