r"""Noise as denoisers of developed pictures are usually trained with it, drawn on sRGB, to compare camera noise with.

.. math:: x_{noisy} = \mathrm{JPEG}_q(x + M n + (P(\lambda x) / \lambda - x))

with white normals n, a matrix M that mixes the colours, photon counts P, and a clip to [0, 1] after each step. As
elsewhere ``sample`` draws the parameters, a row a picture, and a pure ``apply`` uses them. The ranges are those of
Zhang et al., "Designing a Practical Degradation Model for Deep Blind Image Super-Resolution", ICCV 2021, in the code
of KAIR and BSRGAN, without its blurs and its resizing. Coloured noise is white noise that a blur has spread over
neighbours, as denoisers and enlargers before this one leave it.

:class:`SrgbSamples` mixes such noise into a camera's, and tells a network how strong the noise of a pair is, see there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from rawaug.data.pairs import Sample
from rawaug.isp.stages import as_float
from rawaug.noise.levels import uniform
from rawaug.noise.models import Params, draw_normals, draw_seeds, per_picture, poisson
from rawaug.plugin.crops import crop_size, draw_patch
from rawaug.plugin.finishing import blur
from rawaug.plugin.targets import compress_jpeg
from rawaug.registry import Spec, check_settings, require_between, split_spec, suggest
from rawaug.seeding import keyed_generator
from rawaug.training.stream import PictureCrops

_LUMA = torch.tensor([0.299, 0.587, 0.114], device="cpu")


class SrgbNoise(Protocol):
    """A model of noise on sRGB; :func:`noise_on_srgb` makes one by its name."""

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Parameters of ``batch`` pictures."""
        ...

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Noisy sRGB of sRGB ``(B, 3, H, W)``, both float32 in [0, 1]."""
        ...


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


class ColouredNoise:
    """Gaussian noise, white or blurred and partly the same in all colours, then JPEG in half of the pictures.

    Args:
        sigma: largest standard deviation, in units of 1/255; drawn as its share to the power 1.5, so that weak noise is
            common.
        coloured: share of pictures whose noise is blurred, by a deviation within ``blur`` in pixels.
        blur: lowest and highest deviation of that blur.
        jpeg: limits of the quality.
    """

    def __init__(
        self,
        sigma: float = 30.0,
        coloured: float = 0.6,
        blur: tuple[float, float] = (0.3, 1.5),
        jpeg: tuple[int, int] = (75, 99),
    ) -> None:
        _require_limits("jpeg", jpeg, 1, 100)
        require_between("sigma", sigma, 0.0, 255.0)
        require_between("coloured", coloured, 0.0, 1.0)
        self.sigma, self.coloured, self.blur, self.jpeg = sigma, coloured, blur, jpeg

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """``sigma``, ``blur``, ``grey`` (share of what is the same in all colours), ``quality`` (0 for none), ``seed``
        and ``chroma_420``, all ``(B,)``.
        """
        strength, blurs, blur, grey, compressed, chroma = uniform(generator, 6, batch)
        low, high = self.blur
        quality = torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator)
        return {
            "sigma": strength**1.5 * self.sigma / 255,
            "blur": torch.where(blurs < self.coloured, low + (high - low) * blur, 0.0),
            "grey": torch.where(blurs < self.coloured, grey, 0.0),
            "quality": torch.where(compressed < 0.5, quality, 0),
            "seed": draw_seeds(batch, generator),
            "chroma_420": chroma < 0.5,
        }

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        noise = blur(draw_normals(srgb, _generators(params)), params["blur"])
        noise = noise.lerp(noise.mean(1, keepdim=True), per_picture(params["grey"], srgb))
        noise = noise / noise.square().mean((1, 2, 3), keepdim=True).sqrt()
        noisy = (srgb + per_picture(params["sigma"], srgb) * noise).clamp_(0.0, 1.0)
        if (stored := params["quality"] > 0).any():
            noisy[stored] = compress_jpeg(noisy[stored], params["quality"][stored], params["chroma_420"][stored])
        return noisy


MODELS: dict[str, type[SrgbNoise]] = {"BSRGAN": BsrganNoise, "Coloured": ColouredNoise, "Gaussian": WhiteNoise}
"""The models by the names that recipes use."""


def noise_on_srgb(spec: Spec) -> SrgbNoise:
    """Make a model of noise on sRGB from its name, or from ``{"name": ..., "settings": {...}}``.

    Raises:
        ValueError: if there is no such name or setting.

    Example:
        >>> noise_on_srgb({"name": "Gaussian", "settings": {"sigma": [0, 25]}}).sigma
        (0, 25)
    """
    name, settings = split_spec(spec)
    if name not in MODELS:
        raise ValueError(f"noise on sRGB {name!r} is unknown; use one of {', '.join(MODELS)}{suggest(name, MODELS)}")
    model = MODELS[name]
    return model(**check_settings(f"noise on sRGB {name}", model, settings))


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


@dataclass
class Told:
    """What a network that reads a level of noise is told of it in training; the rest of the pairs are told a wrong one.

    Args:
        unknown: share of the pairs that are told 0, which stands for unknown.
        exact: share that is told the deviation of the pair, the root mean square of noisy less clean.
        factor: how far the wrong level is off at most, up or down, drawn by its logarithm.
    """

    unknown: float = 0.35
    exact: float = 0.4
    factor: float = 1.6

    def __post_init__(self) -> None:
        require_between("told.unknown", self.unknown, 0.0, 1.0)
        require_between("told.exact", self.exact, 0.0, 1.0 - self.unknown)
        require_between("told.factor", self.factor, 1.0, 10.0)

    def sample(self, generator: torch.Generator) -> float:
        """What the deviation is multiplied by: 0 for unknown, 1, or a factor."""
        kind, wrong = torch.rand(2, generator=generator).tolist()
        if kind < self.unknown:
            return 0.0
        return 1.0 if kind < self.unknown + self.exact else float(self.factor ** (2.0 * wrong - 1.0))

    def apply(self, sample: Sample, times: float) -> Sample:
        """The sample with a map ``(3, H, W)`` of the variance that is told."""
        variance = (sample.noisy - sample.clean).square().mean() * times**2
        return sample._replace(variance=variance.expand_as(sample.noisy))


class SrgbSamples:
    """Training samples of developed pictures, of which a share has noise drawn on sRGB in place of the camera's.

    Args:
        camera: pairs of target ``"srgb"``; None where all noise is drawn on sRGB.
        drawn: the others; None where there are none.
        share: of the others.
        told: what the network is told; None for nothing.
    """

    def __init__(
        self, camera: PictureCrops | None, drawn: NoisyPictures | None, share: float, told: Told | None
    ) -> None:
        self.camera, self.drawn, self.share, self.told = camera, drawn, share, told

    def draw(self, generator: torch.Generator) -> Sample:
        return self.draw_batch([generator])[0]

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
        """One sample for each generator; those of the camera are made together."""
        found: dict[int, Sample] = {}
        of_camera: dict[int, torch.Generator] = {}
        for place, generator in enumerate(generators):
            if self.drawn is not None and (self.camera is None or self._is_drawn(generator)):
                found[place] = self.drawn.draw(generator)
            else:
                of_camera[place] = generator
        if self.camera is not None and of_camera:
            found |= zip(of_camera, self.camera.draw_batch([*of_camera.values()]), strict=True)
        samples = [found[place] for place in range(len(generators))]
        if self.told is None:
            return samples
        return [self.told.apply(*one) for one in zip(samples, map(self.told.sample, generators), strict=True)]

    def _is_drawn(self, generator: torch.Generator) -> bool:
        return bool(torch.rand((), generator=generator) < self.share)
