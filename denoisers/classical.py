r"""What classical denoisers of packed RAW have in common; each is a file of its own beside this one.

Each is made for white Gaussian noise of one level, ``y = x + sigma n``, and is given ``y / sigma`` here, with
``sigma = sqrt(mean variance)`` of the picture. RAW noise depends on the signal, so wrap the denoiser in
:class:`denoisers.Stabilised` for shot noise; alone it works at the mean level.

Domain: packed RAW, any scale, not clipped; the work is done on the CPU.

Non-local means: the mean of pixels weighed by how alike their patches are (Buades et al., CVPR 2005).

Translation-invariant wavelet shrinkage: thresholded transforms, averaged over shifts (Coifman and Donoho, 1995).

Total variation: the ``x`` of least ``|x - y|^2 / 2 + w TV(x)`` (Chambolle, JMIV 2004).

BM3D: alike blocks stacked and shrunk together in a 3-D transform (Dabov et al., TIP 2007).

Shot noise made white, denoised, and made RAW again: ``T^-1(f(T y))`` (Makitalo and Foi, TIP 2013).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from rawaug.registry import FILTERS

Planes = np.ndarray[Any, np.dtype[np.float32]]


class Classical(ABC):
    """Base: ``denoiser(noisy, variance) -> denoised``, ``(B, 4, h, w)``, picture by picture.

    Args:
        strength: multiplies the method's own default amount of smoothing.
    """

    smallest: ClassVar[int] = 2
    """The shortest side, in packed pixels, that the method takes."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Libraries that not every installation has."""
    advice: ClassVar[str] = "run: pip install 'rawaug[train]'"
    """What to do where one of them is missing."""

    @classmethod
    def missing(cls) -> str | None:
        """The line that says what is not installed; None where everything is."""
        name = next((name for name in cls.needs if find_spec(name) is None), None)
        return name and f"{name} is not installed; {cls.advice}"

    def __init__(self, strength: float = 1.0) -> None:
        if not strength > 0:
            raise ValueError(f"strength must be positive, got {strength}")
        self.strength = strength

    @abstractmethod
    def denoise(self, planes: Planes) -> Planes:
        """``(h, w, 4)`` with white noise of deviation 1 to the estimate without it, same shape."""

    def __call__(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)``; a picture without noise is returned as it is.

        Args:
            noisy: packed RAW.
            variance: the noise variance, shape of ``noisy`` or broadcast to it; its mean over each picture is used.

        Raises:
            ValueError: if ``variance`` is missing, or the shape is not that of packed RAW or too small for the method.
        """
        name, least = type(self).__name__, self.smallest
        if noisy.ndim != 4 or noisy.shape[1] != 4 or min(noisy.shape[-2:]) < least:
            raise ValueError(f"{name} takes packed RAW (B, 4, h >= {least}, w >= {least}), got {tuple(noisy.shape)}")
        if not noisy.is_floating_point():
            raise ValueError(f"{name} takes floating-point RAW, got {noisy.dtype}")
        if variance is None:
            raise ValueError(f"{name} needs the noise variance: pass it as the second argument")
        if not len(noisy):
            return noisy.clone()
        sigmas = variance.expand_as(noisy).float().mean((1, 2, 3)).sqrt().tolist()
        return torch.stack([self._one(image, sigma) for image, sigma in zip(noisy, sigmas, strict=True)])

    def _one(self, image: Tensor, sigma: float) -> Tensor:
        if sigma == 0:
            return image
        planes = image.detach().permute(1, 2, 0).to("cpu", torch.float32).numpy() / np.float32(sigma)
        clean = np.ascontiguousarray(self.denoise(planes), np.float32) * np.float32(sigma)
        return torch.from_numpy(clean).permute(2, 0, 1).to(image)

    def library(self, name: str) -> Any:
        """The library ``name``, one of :attr:`needs` or a module of one.

        Raises:
            ImportError: in one line if something is not installed.
        """
        if (reason := self.missing()) is not None:
            raise ImportError(reason)
        return import_module(name)


@FILTERS.register("NonLocalMeans")
class NonLocalMeans(Classical):
    """Non-local means (scikit-image, fast mode): patches of 5 x 5 over all four planes, sought 6 pixels around."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_nl_means = self.library("skimage.restoration").denoise_nl_means
        settings = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "channel_axis": -1}
        return denoise_nl_means(planes, h=0.8 * self.strength, sigma=1.0, **settings)


@FILTERS.register("Wavelet")
class Wavelet(Classical):
    """Translation-invariant Haar shrinkage (scikit-image, PyWavelets): hard threshold at 3 sigma, mean of 16 shifts."""

    needs = ("skimage", "pywt")

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_wavelet = self.library("skimage.restoration").denoise_wavelet
        height, width, channels = planes.shape
        # VisuShrink cuts at sigma sqrt(2 log n); the factor is taken out, since on photographs it smooths too much.
        sigma = 3 * self.strength / np.sqrt(2 * np.log(height * width))
        settings = {
            "sigma": [sigma] * channels,
            "wavelet": "haar",
            "method": "VisuShrink",
            "mode": "hard",
            "wavelet_levels": min(4, min(height, width).bit_length() - 1),
            "rescale_sigma": False,
            "channel_axis": -1,
        }
        mean = np.zeros_like(planes)
        for shift in product(range(4), repeat=2):
            shrunk = denoise_wavelet(np.roll(planes, shift, (0, 1)), **settings)
            mean += np.roll(shrunk, np.negative(shift), (0, 1)) / 16
        return mean


@FILTERS.register("TotalVariation")
class TotalVariation(Classical):
    """Total variation (scikit-image, Chambolle's projection), each plane by itself."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`."""
        denoise_tv_chambolle = self.library("skimage.restoration").denoise_tv_chambolle
        return denoise_tv_chambolle(planes, weight=0.4 * self.strength, channel_axis=-1)


_HADAMARD = 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], np.float32)
"""R, Gr, Gb, B to luminance and three differences; orthonormal (white noise stays white), its own inverse."""


@FILTERS.register("BM3D")
class BM3D(Classical):
    """BM3D (the ``bm3d`` wheel of its authors), blocks matched on the mean of the four planes.

    The wheel is for non-commercial use only and therefore no requirement of this package: ``pip install bm3d``.
    """

    smallest = 16
    needs = ("bm3d",)
    advice = "licensed for non-commercial use only; run: pip install 'rawaug[bm3d]'"

    def denoise(self, planes: Planes) -> Planes:
        """See :meth:`Classical.denoise`.

        Raises:
            ImportError: if the wheel is not installed.
        """
        bm3d = self.library("bm3d")
        # Blocks are matched on the first channel: let that be the luminance, whose noise is lowest.
        return bm3d.bm3d(planes @ _HADAMARD, sigma_psd=[self.strength] * 4) @ _HADAMARD


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
