"""Shot noise made white, denoised, and made RAW again: ``T^-1(f(T y))`` (Makitalo and Foi, TIP 2013)."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from denoisers.classical import Classical


class Transform(Protocol):
    """A variance-stabilising transform: after ``forward`` the noise has variance 1; ``inverse`` is free of bias."""

    def forward(self, y: Tensor, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """``(B, 4, h, w)`` RAW with var(y) = shot_var y + read_var, both ``(B,)``, to unit variance."""

    def inverse(self, z: Tensor, shot_var: Tensor, read_var: Tensor) -> Tensor:
        """The estimate in the transform's domain back to RAW."""


class Stabilised:
    """A denoiser of white noise on RAW with shot noise: ``inverse(denoiser(forward(noisy), 1))``.

    Args:
        denoiser: one of the classes above, or any ``denoiser(noisy, variance)``.
        transform: what :class:`Transform` says, e.g. the module ``rawaug.noise.anscombe``: the generalised Anscombe
            transform with its exact unbiased inverse.

    Example:
        >>> class Scale:
        ...     def forward(self, y, shot_var, read_var):
        ...         return y / read_var.sqrt().reshape(-1, 1, 1, 1)
        ...     def inverse(self, z, shot_var, read_var):
        ...         return z * read_var.sqrt().reshape(-1, 1, 1, 1)
        >>> from denoisers import TotalVariation
        >>> denoiser = Stabilised(TotalVariation(), Scale())
        >>> denoiser(torch.rand(1, 4, 16, 16), torch.full((1, 4, 16, 16), 1e-4)).shape
        torch.Size([1, 4, 16, 16])
    """

    def __init__(self, denoiser: Classical, transform: Transform) -> None:
        self.denoiser = denoiser
        self.transform = transform

    def __call__(
        self,
        noisy: Tensor,
        variance: Tensor | None = None,
        *,
        shot_var: Tensor | None = None,
        read_var: Tensor | None = None,
    ) -> Tensor:
        """Denoise ``(B, 4, h, w)``.

        Args:
            noisy: packed RAW.
            variance: its map shot_var max(noisy, 0) + read_var, from which the two are derived if not given.
            shot_var, read_var: ``(B,)``.

        Raises:
            ValueError: if neither is given, the map is no such line, or the two are not one number a picture.
        """
        if shot_var is None or read_var is None:
            shot_var, read_var = _levels(noisy, variance)
        for name, value in (("shot_var", shot_var), ("read_var", read_var)):
            if value.shape != noisy.shape[:1]:
                raise ValueError(f"{name} must have shape ({len(noisy)},), one per picture, got {tuple(value.shape)}")
        stable = self.transform.forward(noisy, shot_var, read_var)
        return self.transform.inverse(self.denoiser(stable, torch.ones_like(stable)), shot_var, read_var)


def _levels(noisy: Tensor, variance: Tensor | None) -> tuple[Tensor, Tensor]:
    """The line through a variance map, shot_var and read_var ``(B,)``, by least squares."""
    if variance is None:
        raise ValueError("give the variance map, or shot_var and read_var")
    light, variance = noisy.clamp(min=0).double().flatten(1), variance.double().flatten(1)
    mean, level = light.mean(1, keepdim=True), variance.mean(1, keepdim=True)
    spread = ((light - mean) ** 2).sum(1)
    slope = ((light - mean) * (variance - level)).sum(1) / spread.clamp(min=1e-30)
    shot_var, read_var = slope.clamp(min=0), (level[:, 0] - slope * mean[:, 0]).clamp(min=0)
    expected = shot_var[:, None] * light + read_var[:, None]
    if not torch.allclose(expected, variance, rtol=1e-2, atol=1e-12):
        raise ValueError("the variance map is not shot_var max(noisy, 0) + read_var; pass shot_var and read_var")
    return shot_var.to(noisy), read_var.to(noisy)
