r"""Noise as denoisers of developed pictures are usually trained with it, drawn on sRGB, to compare camera noise with.

.. math:: x_{noisy} = \mathrm{JPEG}_q(x + M n + (P(\lambda x) / \lambda - x))

with white normals n, a matrix M that mixes the colours, photon counts P, and a clip to [0, 1] after each step. As
elsewhere ``sample`` draws the parameters, a row a picture, and a pure ``apply`` uses them. The ranges are those of
Zhang et al., "Designing a Practical Degradation Model for Deep Blind Image Super-Resolution", ICCV 2021, in the code
of KAIR and BSRGAN, without its blurs and its resizing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from rawaug.data.pairs import Sample
from rawaug.isp.stages import as_float
from rawaug.noise.levels import uniform
from rawaug.noise.models import Params, draw_normals, draw_seeds, per_picture, poisson
from rawaug.plugin.dataset import crop_size, draw_patch
from rawaug.plugin.targets import compress_jpeg
from rawaug.registry import SRGB_NOISE, require_between
from rawaug.seeding import keyed_generator

_LUMA = torch.tensor([0.299, 0.587, 0.114], device="cpu")


class SrgbNoise(Protocol):
    """A model of :data:`rawaug.registry.SRGB_NOISE`."""

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Parameters of ``batch`` pictures."""
        ...

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Noisy sRGB of sRGB ``(B, 3, H, W)``, both float32 in [0, 1]."""
        ...


@SRGB_NOISE.register("Gaussian")
class WhiteNoise:
    """White Gaussian noise of a standard deviation drawn uniformly between the limits ``sigma``, in units of 1/255."""

    def __init__(self, sigma: tuple[float, float] = (0.0, 50.0)) -> None:
        _require_limits("sigma", sigma, 0, 255)
        self.sigma = sigma

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        low, high = self.sigma
        return {"sigma": (low + (high - low) * uniform(generator, batch)) / 255, "seed": draw_seeds(batch, generator)}

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        normals = draw_normals(srgb, _generators(params))
        return (srgb + per_picture(params["sigma"], srgb) * normals).clamp_(0.0, 1.0)


@SRGB_NOISE.register("BSRGAN")
class BsrganNoise:
    """Gaussian noise (white, grey, or correlated between the colours: 2, 2 and 1 of 5), some Poisson noise, JPEG.

    Args:
        sigma: limits of the standard deviation, whole numbers in units of 1/255; correlated noise has the upper one.
        poisson: share of pictures with Poisson noise, of 100 to 10,000 photons at white, half of it grey.
        jpeg: limits of the quality.
    """

    def __init__(
        self, sigma: tuple[int, int] = (2, 25), poisson: float = 0.1, jpeg: tuple[int, int] = (30, 95)
    ) -> None:
        _require_limits("sigma", sigma, 0, 255)
        _require_limits("jpeg", jpeg, 1, 100)
        require_between("poisson", poisson, 0.0, 1.0)
        self.sigma, self.poisson, self.jpeg = sigma, poisson, jpeg

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """``mixing`` ``(B, 3, 3)``; ``photons`` at white, 0 for none, ``grey``, ``quality`` and ``seed``, ``(B,)``."""
        kind, (low, high) = uniform(generator, batch, 1, 1), self.sigma
        sigma = torch.randint(low, high + 1, (batch, 1, 1), generator=generator) / 255
        first = torch.tensor([1.0, 0.0, 0.0]).expand(3, 3)  # the same normal in all colours
        independent = torch.where(kind < 0.4, sigma * torch.eye(3), sigma * first)
        correlated = high / 255 * _mixing(uniform(generator, batch, 3, 3), uniform(generator, batch, 3))
        photons, drawn, grey = uniform(generator, 3, batch)
        return {
            "mixing": torch.where(kind < 0.8, independent, correlated),
            "photons": torch.where(drawn < self.poisson, 10.0 ** (2.0 + 2.0 * photons), 0.0),
            "grey": grey < 0.5,
            "quality": torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator),
            "seed": draw_seeds(batch, generator),
        }

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        generators = _generators(params)
        mixed = torch.einsum("bij,bjhw->bihw", params["mixing"].to(srgb), draw_normals(srgb, generators))
        noisy = (srgb + mixed).clamp_(0.0, 1.0)
        for picture, photons, grey, generator in zip(noisy, params["photons"], params["grey"], generators, strict=True):
            if photons:
                light = torch.einsum("c,chw->hw", _LUMA.to(picture), picture)[None] if grey else picture
                normals = draw_normals(light[None], [generator])[0]
                picture += poisson(light * photons, normals) / photons - light
        return compress_jpeg(noisy.clamp_(0.0, 1.0), params["quality"])


def _mixing(basis: Tensor, scales: Tensor) -> Tensor:
    """A root M of the covariance ``|U^T D U|``, U of orthonormal columns that span ``basis`` and D of ``scales``."""
    u = torch.linalg.svd(basis).U
    values, vectors = torch.linalg.eigh((u.mT * scales[:, None] @ u).abs())
    return vectors * values.clamp_min(0.0).sqrt()[:, None]


def _generators(params: Params) -> list[torch.Generator]:
    return [keyed_generator(seed, "srgb noise") for seed in params["seed"].tolist()]


def _require_limits(key: str, limits: tuple[float, float], least: int, most: int) -> None:
    if not (len(limits) == 2 and least <= limits[0] <= limits[1] <= most and all(map(math.isfinite, limits))):
        raise ValueError(f"{key} must be (lowest, highest) within {least} to {most}, got {limits}")


class NoisyPictures:
    """Training samples of a model of noise on sRGB: a crop of a picture, placed as in :class:`rawaug.RawPairs`."""

    def __init__(self, pictures: Sequence[Any], noise: SrgbNoise, crop: int, zoom: float = 1.0) -> None:
        self.pictures, self.noise, self.crop, self.zoom = pictures, noise, crop_size(crop), zoom

    def draw(self, generator: torch.Generator) -> Sample:
        drawn = self.pictures[int(torch.randint(len(self.pictures), (), generator=generator))]
        clean = as_float(draw_patch(drawn, self.crop, True, generator, self.zoom)[0])[None]
        noisy = self.noise.apply(clean, self.noise.sample(1, generator))
        return Sample(noisy[0], clean[0], torch.zeros_like(clean[0]))
