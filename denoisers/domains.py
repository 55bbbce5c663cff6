r"""The domain in which a network meets noise of variance ``s y + r`` (s = ``shot_var``, r = ``read_var``).

==========  ===============================================  ====================================================
name        what the network sees                            noise there
==========  ===============================================  ====================================================
linear      y                                                as it comes; a noise map is the other input
ksigma      :math:`u = y / s + r / s^2`, scaled to ISO 1600  variance u: one camera at one ISO, whatever it was
anscombe    :math:`z = 2 \sqrt{u + 3/8}`                     variance 1 everywhere
==========  ===============================================  ====================================================

The network gives the transformed *clean* signal, so the algebraic inverse has no bias. Below ``u = 0`` the root goes on
as its tangent. Photons are counted with s of at least the domain's ``least_shot``; a noise map then holds the noise's
deviation relative to that. Sources: Wang et al., ECCV 2020 (k-sigma; its anchor is ISO 1600 of a Reno-10x with white at
959); Starck, Murtagh and Bijaoui 1998 (generalised Anscombe transform).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.bayer import noise_variance

_LEAST_RATIO = 1e-3
"""Least shot_var as a multiple of sqrt(read_var): keeps r / s^2 within what float32 resolves."""


def fit_levels(noisy: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    """shot_var and read_var ``(B, 1, 1, 1)`` of a noise map ``(B, C, h, w)``, by least squares; neither is negative.

    What ``noisy`` has beyond C channels, such as planes of colours, does not count.
    """
    light, axes = noisy[:, : variance.shape[1]].clamp_min(0.0), (1, 2, 3)
    mean, level = light.mean(axes, keepdim=True), variance.mean(axes, keepdim=True)
    spread = (light - mean).square().mean(axes, keepdim=True)
    slope = ((light - mean) * (variance - level)).mean(axes, keepdim=True) / spread.clamp_min(1e-20)
    shot = slope.clamp_min(0.0)
    return shot, (level - shot * mean).clamp_min(0.0)


class Domain(ABC):
    """A transform of RAW ``(B, C, h, w)``, and back; levels are ``(B, 1, 1, 1)``."""

    least_shot: ClassVar[float]

    def forward(self, y: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """RAW to what the network sees."""
        shot = self.bounded(shot, read)
        return self.encode(y / shot + read / shot.square())

    def inverse(self, z: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """What the network gives back to RAW."""
        shot = self.bounded(shot, read)
        return shot * (self.decode(z) - read / shot.square())

    def bounded(self, shot: Tensor, read: Tensor) -> Tensor:
        """The shot_var that photons are counted with."""
        return torch.maximum(shot.clamp_min(self.least_shot), _LEAST_RATIO * read.sqrt())

    def relative_deviation(self, y: Tensor, variance: Tensor, shot: Tensor, read: Tensor) -> Tensor:
        """The noise's deviation over what the transform takes it for: below 1 where shot_var is below its bound."""
        expected = noise_variance(y, self.bounded(shot, read), read)
        return (variance / expected.clamp_min(1e-20)).sqrt().clamp_max(1.0)

    @abstractmethod
    def encode(self, u: Tensor) -> Tensor:
        """Of a signal whose noise has the variance u."""

    @abstractmethod
    def decode(self, z: Tensor) -> Tensor:
        """The inverse of :meth:`encode`."""


class KSigma(Domain):
    """PMRID's: noise as that of ISO 1600, in PMRID's units. White grows with 1 / s, so its bound is a high one."""

    least_shot = 6e-4
    shot = 5.995267e-4 * 1600 + 8.68861e-3
    read = 7.11772e-7 * 1600**2 + 6.514934e-4 * 1600 + 0.11492713
    scale = 256.0 / 959.0

    def encode(self, u: Tensor) -> Tensor:
        """Linear in u."""
        return (u * self.shot - self.read / self.shot) * self.scale

    def decode(self, z: Tensor) -> Tensor:
        """Linear in z."""
        return (z / self.scale + self.read / self.shot) / self.shot


class Anscombe(Domain):
    """The generalised Anscombe transform: noise of deviation 1, white at 13 (ISO 25,600) to 400 (ISO 100)."""

    least_shot = 1e-5
    offset = 0.375

    def encode(self, u: Tensor) -> Tensor:
        """The root of u + 3/8, below u = 0 its tangent."""
        root = 2.0 * (u.clamp_min(0.0) + self.offset).sqrt()
        return root + u.clamp_max(0.0) / math.sqrt(self.offset)

    def decode(self, z: Tensor) -> Tensor:
        """The square, below the root's value at 0 the tangent's inverse."""
        least = 2.0 * math.sqrt(self.offset)
        square = (z.clamp_min(least) / 2.0).square() - self.offset
        return square + (z - least).clamp_max(0.0) * math.sqrt(self.offset)


DOMAINS = MappingProxyType({"ksigma": KSigma(), "anscombe": Anscombe()})
"""Name to transform; ``linear`` is none."""
