r"""The domain in which a network meets noise of variance ``s y + r`` (s = ``shot_var``, r = ``read_var``).

==========  ===============================================  ====================================================
name        what the network sees                            noise there
==========  ===============================================  ====================================================
linear      y                                                as it comes; a noise map is the other input
ksigma      :math:`u = y / s + r / s^2`, scaled to ISO 1600  variance u: one camera at one ISO, whatever it was
anscombe    :math:`z = 2 \sqrt{u + 3/8}`                     variance 1 everywhere
==========  ===============================================  ====================================================

The network returns the transformed *clean* signal, so the algebraic inverse has no bias. Below ``u = 0`` the root is
continued by its tangent. Photons are counted with an s of at least the domain's ``least_shot``; a noise map then holds
the noise's deviation relative to that. Sources: Wang et al., ECCV 2020 (k-sigma; its anchor is ISO 1600 of a Reno-10x
with white at 959); Starck, Murtagh and Bijaoui 1998 (generalised Anscombe transform).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from types import MappingProxyType
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.bayer import noise_variance

Levels = tuple[Tensor, Tensor]
"""These are shot_var and read_var, ``(B, 1, 1, 1)``, or ``(B, 1, H, W)`` if each pixel has its own."""

_LEAST_RATIO = 1e-3
"""shot_var is at least this multiple of sqrt(read_var), which keeps r / s^2 within what float32 resolves."""

_PICTURE = (1, 2, 3)
"""These are the axes of a picture in a batch ``(B, C, h, w)``."""


def fit_levels(noisy: Tensor, variance: Tensor) -> Levels:
    """Fit shot_var and read_var, each ``(B, 1, 1, 1)``, to a noise map ``(B, C, h, w)`` by least squares.

    Neither is negative. Channels that ``noisy`` has beyond the map's C, such as planes of colours, are ignored.
    """
    if torch.onnx.is_in_onnx_export() and noisy.dtype is torch.float32:
        # ONNX Runtime adds up one value after the other. In float32, the sum over a megapixel is wrong by a thousandth.
        shot_var, read_var = fit_levels(noisy.double(), variance.double())
        return shot_var.float(), read_var.float()

    light = noisy[:, : variance.shape[1]].clamp_min(0.0)
    mean_light = light.mean(_PICTURE, keepdim=True)
    mean_variance = variance.mean(_PICTURE, keepdim=True)

    spread = (light - mean_light).square().mean(_PICTURE, keepdim=True)
    covariance = ((light - mean_light) * (variance - mean_variance)).mean(_PICTURE, keepdim=True)
    slope = covariance / spread.clamp_min(1e-20)

    shot_var = slope.clamp_min(0.0)
    read_var = (mean_variance - shot_var * mean_light).clamp_min(0.0)
    return shot_var, read_var


class Domain(ABC):
    """A transform of RAW ``(B, C, h, w)`` with shot_var and read_var ``(B, 1, 1, 1)``, and its inverse."""

    least_shot: ClassVar[float]

    def forward(self, y: Tensor, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """Transform RAW ``(B, C, h, w)`` to the signal that the network sees."""
        shot_var = self.bound(shot_var, read_var)
        return self.encode(y / shot_var + read_var / shot_var.square())

    def inverse(self, z: Tensor, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """Transform a network's clean signal ``(B, C, h, w)`` back to RAW."""
        shot_var = self.bound(shot_var, read_var)
        return shot_var * (self.decode(z) - read_var / shot_var.square())

    def bound(self, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """Raise shot_var ``(B, 1, 1, 1)``, by which photons are counted, to at least :attr:`least_shot`."""
        return torch.maximum(shot_var.clamp_min(self.least_shot), _LEAST_RATIO * read_var.sqrt())

    def relative_deviation(self, y: Tensor, variance: Tensor, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """Divide the noise's deviation by the one that the transform assumes.

        The quotient has the shape of ``y``. It is 1, or below 1 where shot_var is below its bound.

        Args:
            y: RAW ``(B, C, h, w)``.
            variance: the noise variance of each value, of the same shape.
            shot_var, read_var: the levels ``(B, 1, 1, 1)``.
        """
        expected = noise_variance(y, self.bound(shot_var, read_var), read_var)
        return (variance / expected.clamp_min(1e-20)).sqrt().clamp_max(1.0)

    @abstractmethod
    def encode(self, u: Tensor) -> Tensor:
        """Transform a count u, ``(B, C, h, w)``, whose noise has the variance u."""

    @abstractmethod
    def decode(self, z: Tensor) -> Tensor:
        """Transform a signal ``(B, C, h, w)`` back to counts, the inverse of :meth:`encode`."""


class KSigma(Domain):
    """PMRID's domain, where every noise becomes that of ISO 1600. White grows with 1 / s, so ``least_shot`` is high."""

    least_shot = 6e-4
    gain = 5.995267e-4 * 1600 + 8.68861e-3
    """One digital number of light adds this variance at ISO 1600: it is the paper's k."""
    floor = 7.11772e-7 * 1600**2 + 6.514934e-4 * 1600 + 0.11492713
    """Black has this variance at ISO 1600, in digital numbers: it is the paper's sigma squared."""
    scale = 256.0 / 959.0

    def encode(self, u: Tensor) -> Tensor:
        """Scale and shift counts ``(B, C, h, w)`` to PMRID's units."""
        return (u * self.gain - self.floor / self.gain) * self.scale

    def decode(self, z: Tensor) -> Tensor:
        """Scale and shift PMRID's units ``(B, C, h, w)`` to counts."""
        return (z / self.scale + self.floor / self.gain) / self.gain


class Anscombe(Domain):
    """The generalised Anscombe transform; noise has deviation 1, and white is at 13 (ISO 25,600) to 400 (ISO 100)."""

    least_shot = 1e-5
    offset = 0.375

    def encode(self, u: Tensor) -> Tensor:
        """Take the root of u + 3/8 for counts u, ``(B, C, h, w)``; below u = 0 follow its tangent."""
        root = 2.0 * (u.clamp_min(0.0) + self.offset).sqrt()
        tangent = u.clamp_max(0.0) / math.sqrt(self.offset)
        return root + tangent

    def decode(self, z: Tensor) -> Tensor:
        """Square a signal ``(B, C, h, w)``; below the root's value at 0 invert the tangent."""
        least = 2.0 * math.sqrt(self.offset)
        square = (z.clamp_min(least) / 2.0).square() - self.offset
        tangent = (z - least).clamp_max(0.0) * math.sqrt(self.offset)
        return square + tangent


DOMAINS = MappingProxyType({"ksigma": KSigma(), "anscombe": Anscombe()})
"""This maps names to transforms; ``linear`` needs none."""
