r"""What classical denoisers of packed RAW have in common; each is a file of its own beside this one.

Each is made for white Gaussian noise of one level, ``y = x + sigma n``, and is given ``y / sigma`` here, with
``sigma = sqrt(mean variance)`` of the picture. RAW noise depends on the signal, so wrap the denoiser in
:class:`denoisers.Stabilised` for shot noise; alone it works at the mean level.

Domain: packed RAW, any scale, not clipped; the work is done on the CPU.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from importlib import import_module
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

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
