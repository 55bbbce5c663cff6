"""Classical denoisers of packed RAW, and :class:`Stabilised`, which fits them to shot noise.

Each filter is made for white Gaussian noise of one level, ``y = x + sigma n``, and filters ``y / sigma`` here, with
``sigma = sqrt(mean variance)`` of the picture. RAW noise depends on the signal. Wrapped in :class:`Stabilised`, a
filter sees noise of one level everywhere; alone, it works at the mean level. The work is done on the CPU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from itertools import product
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from denoisers import anscombe
from denoisers.domains import fit_levels
from rawaug.bayer import noise_variance
from rawaug.errors import how_to_install
from rawaug.registry import Registry

FILTERS = Registry("classical filter", "rawaug.filters", "denoisers")
"""This maps names to filters, which are subclasses of :class:`Classical`."""

STRIP = 128
"""Non-local means filters so many rows at a time, in packed pixels."""

Planes = np.ndarray[Any, np.dtype[np.float32]]


class Classical(ABC):
    """Base of the filters: ``denoiser(noisy, variance) -> denoised``, ``(B, 4, h, w)``, picture by picture.

    Args:
        strength: multiplies the method's own default amount of smoothing.
    """

    smallest: ClassVar[int] = 2
    """The method takes no side shorter than this, in packed pixels."""
    needs: ClassVar[tuple[str, ...]] = ()
    """The method needs these libraries, which not every installation has."""
    extra: ClassVar[str] = "train"
    """This extra of rawaug installs them."""
    licence: ClassVar[str] = ""
    """This is a note on the licences of the libraries that the method needs."""

    @classmethod
    def missing(cls) -> str | None:
        """Say in a line which library is missing and how to install it; return None if none is missing."""
        for name in cls.needs:
            if find_spec(name) is None:
                return f"{name} is not installed; {cls.licence}{how_to_install(cls.extra)}"
        return None

    def __init__(self, strength: float = 1.0) -> None:
        if not strength > 0:
            raise ValueError(f"strength must be positive, got {strength}")
        self.strength = strength

    @abstractmethod
    def denoise(self, planes: Planes) -> Planes:
        """Estimate the picture ``(h, w, 4)`` beneath white noise of deviation 1; the result has the same shape."""

    def __call__(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, 4, h, w)`` by each picture's mean variance; a picture without noise is returned as it is.

        Raises:
            ValueError: if ``variance`` is missing, or ``noisy`` is not packed RAW or too small for the method.
            ImportError: if a library that the method needs is not installed.
        """
        name = type(self).__name__
        least = self.smallest
        if noisy.ndim != 4 or noisy.shape[1] != 4 or min(noisy.shape[-2:]) < least:
            raise ValueError(f"{name} takes packed RAW (B, 4, h >= {least}, w >= {least}), got {tuple(noisy.shape)}")
        if not noisy.is_floating_point():
            raise ValueError(f"{name} takes floating-point RAW, got {noisy.dtype}")
        if variance is None:
            raise ValueError(f"{name} needs the noise variance: pass it as the second argument")
        if not len(noisy):
            return noisy.clone()

        sigmas = variance.expand_as(noisy).float().mean((1, 2, 3)).sqrt().tolist()
        denoised = []
        for picture, sigma in zip(noisy, sigmas, strict=True):
            denoised.append(self._denoise_picture(picture, sigma))
        return torch.stack(denoised)

    def _denoise_picture(self, picture: Tensor, sigma: float) -> Tensor:
        """Denoise one picture ``(4, h, w)`` with white noise of a given deviation, in units of that deviation."""
        if sigma == 0:
            return picture

        planes = (picture.detach().permute(1, 2, 0).to("cpu", torch.float32) / sigma).numpy()
        clean = np.ascontiguousarray(self.denoise(planes), np.float32) * np.float32(sigma)
        return torch.from_numpy(clean).permute(2, 0, 1).to(picture)

    def library(self, name: str) -> Any:
        """Import the library ``name``, one of :attr:`needs` or a module of one; raise ImportError if it is missing."""
        reason = self.missing()
        if reason is not None:
            raise ImportError(reason)
        return import_module(name)


@FILTERS.register("NonLocalMeans")
class NonLocalMeans(Classical):
    """Non-local means (Buades et al., CVPR 2005; scikit-image, fast mode): patches of 5 x 5 within 6 pixels."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, 4)``; patches are compared over all four planes at once.

        Strips of rows are filtered side by side, by as many threads as PyTorch has, with the rows that they reach.
        """
        denoise_nl_means = self.library("skimage.restoration").denoise_nl_means
        settings = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "channel_axis": -1}
        reach = 8  # half of a patch beyond the distance

        def filter_strip(top: int) -> Planes:
            start = max(top - reach, 0)
            rows = planes[start : top + STRIP + reach]
            filtered = denoise_nl_means(rows, h=0.8 * self.strength, sigma=1.0, **settings)
            return filtered[top - start :][:STRIP]

        with ThreadPoolExecutor(torch.get_num_threads()) as pool:
            return np.concatenate(list(pool.map(filter_strip, range(0, len(planes), STRIP))))


@FILTERS.register("Wavelet")
class Wavelet(Classical):
    """Translation-invariant Haar shrinkage (Coifman and Donoho, 1995): hard threshold at 3 sigma, mean of 16 shifts."""

    needs = ("skimage", "pywt")

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, 4)``, each plane by itself."""
        denoise_wavelet = self.library("skimage.restoration").denoise_wavelet
        height, width, channels = planes.shape

        # VisuShrink cuts at sigma sqrt(2 log n). The factor is taken out, since it smooths photographs too much.
        sigma = 3 * self.strength / np.sqrt(2 * np.log(height * width))
        levels = min(4, min(height, width).bit_length() - 1)
        settings: dict[str, Any] = {
            "wavelet": "haar",
            "method": "VisuShrink",
            "mode": "hard",
            "rescale_sigma": False,
            "sigma": [sigma] * channels,
            "wavelet_levels": levels,
            "channel_axis": -1,
        }

        mean = np.zeros_like(planes)
        for shift in product(range(4), repeat=2):
            shrunk = denoise_wavelet(np.roll(planes, shift, (0, 1)), **settings)
            mean += np.roll(shrunk, np.negative(shift), (0, 1)) / 16
        return mean


@FILTERS.register("TotalVariation")
class TotalVariation(Classical):
    """Total variation (Chambolle, JMIV 2004; scikit-image), each plane by itself."""

    needs = ("skimage",)

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, 4)``, each plane by itself."""
        denoise_tv_chambolle = self.library("skimage.restoration").denoise_tv_chambolle
        return denoise_tv_chambolle(planes, weight=0.4 * self.strength, channel_axis=-1)


_OPPONENT = {
    4: 0.5 * np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], np.float32),
    3: np.array([[2, 2, 2], [6**0.5, 0, -(6**0.5)], [2**0.5, -(8**0.5), 2**0.5]], np.float32) / 12**0.5,
}
"""These turn R, Gr, Gb, B and R, G, B into luminance and differences; they are orthonormal: white noise stays white."""


def to_opponent(planes: Planes) -> Planes:
    """Turn colours ``(h, w, 4)`` or ``(h, w, 3)`` into luminance, which comes first, and differences."""
    return planes @ _OPPONENT[planes.shape[-1]].T


def from_opponent(planes: Planes) -> Planes:
    """Turn luminance and differences, of the shape of :func:`to_opponent`, back into colours."""
    return planes @ _OPPONENT[planes.shape[-1]]


@FILTERS.register("BM3D")
class BM3D(Classical):
    """BM3D (Dabov et al., TIP 2007), blocks matched on the mean of the planes; its wheel is non-commercial."""

    smallest = 16
    needs = ("bm3d",)
    extra = "bm3d"
    licence = "licensed for non-commercial use only; "

    def denoise(self, planes: Planes) -> Planes:
        """Filter ``(h, w, 4)``, or sRGB ``(h, w, 3)``, in luminance and differences of colour."""
        bm3d = self.library("bm3d")
        deviations = [self.strength] * planes.shape[-1]
        # Blocks are matched on the first channel, so that is the luminance, whose noise is lowest.
        cleaned = bm3d.bm3d(to_opponent(planes), sigma_psd=deviations)
        return from_opponent(cleaned)


class Stabilised:
    """A denoiser of white noise on RAW: ``inverse(denoiser(forward(noisy), 1))`` of :mod:`denoisers.anscombe`.

    Args:
        denoiser: one of the classes above, or any ``denoiser(noisy, variance)``.

    Example:
        >>> from denoisers import TotalVariation
        >>> denoiser = Stabilised(TotalVariation())
        >>> denoiser(torch.rand(1, 4, 16, 16), shot_var=1e-3, read_var=1e-5).shape
        torch.Size([1, 4, 16, 16])
    """

    def __init__(self, denoiser: Classical) -> None:
        self.denoiser = denoiser

    def __call__(
        self,
        noisy: Tensor,
        variance: Tensor | None = None,
        *,
        shot_var: float | Tensor | None = None,
        read_var: float | Tensor | None = None,
    ) -> Tensor:
        """Denoise ``(B, 4, h, w)`` by its noise map or by its levels.

        Without shot noise nothing is transformed.

        Args:
            noisy: packed RAW.
            variance: the map ``shot_var max(noisy, 0) + read_var``, of the shape of ``noisy``; not used where both
                levels are passed.
            shot_var, read_var: the levels, numbers or ``(B,)``.

        Raises:
            ValueError: if neither the map nor both levels are passed, or the map does not have this form.
        """
        if shot_var is None or read_var is None:
            shot_var, read_var = _fit_line(noisy, variance)
        shot_var = torch.as_tensor(shot_var).to(noisy).expand(len(noisy))
        read_var = torch.as_tensor(read_var).to(noisy).expand(len(noisy))

        if not (shot_var > 0).all():
            levels = (shot_var.reshape(-1, 1, 1, 1), read_var.reshape(-1, 1, 1, 1))
            return self.denoiser(noisy, noise_variance(noisy, *levels))

        stable = anscombe.forward(noisy, shot_var, read_var)
        denoised = self.denoiser(stable, torch.ones_like(stable))
        return anscombe.inverse(denoised, shot_var, read_var)


def _fit_line(noisy: Tensor, variance: Tensor | None) -> tuple[Tensor, Tensor]:
    """Fit the levels of a map, each ``(B,)``; raise ValueError if it is missing or not linear in the signal."""
    if variance is None:
        raise ValueError("give the variance map, or shot_var and read_var")

    shot_var, read_var = fit_levels(noisy.double(), variance.double())
    line = noise_variance(noisy, shot_var, read_var)
    if not torch.allclose(line, variance.double(), rtol=1e-2, atol=1e-12):
        raise ValueError("the variance map is not shot_var max(noisy, 0) + read_var; pass shot_var and read_var")
    return shot_var.flatten(), read_var.flatten()
