r"""Noise drawn on sRGB, as is usual for training denoisers of developed pictures, to compare with camera noise.

.. math:: x_{noisy} = \mathrm{JPEG}_q(x + M n + (P(\lambda x) / \lambda - x))

with white normals n, a matrix M that mixes the colours, photon counts P, and a clip to [0, 1] after each step. As
elsewhere, ``sample`` draws the parameters, one row for each picture, and a pure ``apply`` uses them. The ranges are
those of Zhang et al., "Designing a Practical Degradation Model for Deep Blind Image Super-Resolution", ICCV 2021, as in
the code of KAIR and BSRGAN, but without its blurs and its resizing. Coloured noise is white noise that a blur has
spread over neighbours, as earlier denoisers and enlargers leave it.
"""

from __future__ import annotations

import math
from typing import Protocol

import torch
from torch import Tensor

from rawaug.noise.levels import uniform
from rawaug.noise.models import Params, draw_normals, draw_seeds, per_picture, poisson
from rawaug.plugin.finishing import gaussian_blur
from rawaug.plugin.jpeg import compress_jpeg
from rawaug.registry import Spec, check_settings, require_between, split_spec, suggest
from rawaug.seeding import keyed_generator

_LUMA = torch.tensor([0.299, 0.587, 0.114], device="cpu")
"""The weights of R, G and B in luma (ITU-R BT.601)."""


class SrgbNoise(Protocol):
    """A model of noise on sRGB; :func:`noise_on_srgb` makes one by its name."""

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the parameters of ``batch`` pictures."""
        ...

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Add noise to sRGB ``(B, 3, H, W)``; both are float32 in [0, 1]."""
        ...


class WhiteNoise:
    """White Gaussian noise of a standard deviation drawn uniformly between the limits ``sigma``, in units of 1/255."""

    def __init__(self, sigma: tuple[float, float] = (0.0, 50.0)) -> None:
        _require_limits("sigma", sigma, 0, 255)
        self.sigma = sigma

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw ``sigma`` and ``seed``, both ``(B,)``."""
        low, high = self.sigma
        sigma = low + (high - low) * uniform(generator, batch)
        return {"sigma": sigma / 255, "seed": draw_seeds(batch, generator)}

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Add the noise to sRGB ``(B, 3, H, W)``."""
        normals = draw_normals(srgb, _generators(params))
        noisy = srgb + per_picture(params["sigma"], srgb) * normals
        return noisy.clamp_(0.0, 1.0)


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
        self.sigma = sigma
        self.poisson = poisson
        self.jpeg = jpeg

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the parameters of pictures.

        Returns:
            ``mixing`` ``(B, 3, 3)``; ``photons`` at white, 0 for none, ``grey``, ``quality`` and ``seed``, ``(B,)``.
        """
        low, high = self.sigma
        kind = uniform(generator, batch, 1, 1)
        sigma = torch.randint(low, high + 1, (batch, 1, 1), generator=generator) / 255
        basis = uniform(generator, batch, 3, 3)
        scales = uniform(generator, batch, 3)
        exponent, has_poisson, is_grey = uniform(generator, 3, batch)

        white = sigma * torch.eye(3)
        grey = sigma * torch.tensor([1.0, 0.0, 0.0]).expand(3, 3)  # all colours share one normal
        correlated = high / 255 * _mixing(basis, scales)
        mixing = torch.where(kind < 0.8, torch.where(kind < 0.4, white, grey), correlated)

        return {
            "mixing": mixing,
            "photons": torch.where(has_poisson < self.poisson, 10.0 ** (2.0 + 2.0 * exponent), 0.0),
            "grey": is_grey < 0.5,
            "quality": torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator),
            "seed": draw_seeds(batch, generator),
        }

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Add the noise to sRGB ``(B, 3, H, W)``, and compress it."""
        generators = _generators(params)
        mixed = torch.einsum("bij,bjhw->bihw", params["mixing"].to(srgb), draw_normals(srgb, generators))
        noisy = (srgb + mixed).clamp_(0.0, 1.0)

        for picture, photons, grey, generator in zip(noisy, params["photons"], params["grey"], generators, strict=True):
            if not photons:
                continue
            light = picture
            if grey:
                light = torch.einsum("c,chw->hw", _LUMA.to(picture), picture)[None]
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
        wide: largest share of the variance, 0 to 1, of coloured noise that is blurred more: grain many pixels wide,
            as strong chroma filters leave it.
        wide_blur: lowest and highest deviation of the blur of that part.
    """

    def __init__(
        self,
        sigma: float = 30.0,
        coloured: float = 0.6,
        blur: tuple[float, float] = (0.3, 1.5),
        jpeg: tuple[int, int] = (75, 99),
        wide: float = 0.0,
        wide_blur: tuple[float, float] = (1.5, 6.0),
    ) -> None:
        _require_limits("jpeg", jpeg, 1, 100)
        require_between("sigma", sigma, 0.0, 255.0)
        require_between("coloured", coloured, 0.0, 1.0)
        require_between("wide", wide, 0.0, 1.0)
        self.sigma = sigma
        self.coloured = coloured
        self.blur = blur
        self.jpeg = jpeg
        if not 0.0 < wide_blur[0] <= wide_blur[1]:
            raise ValueError(f"wide_blur must be (lowest, highest) with 0 < lowest <= highest, got {wide_blur}")
        self.wide = wide
        self.wide_blur = wide_blur

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the parameters of pictures.

        Returns:
            ``sigma``, ``blur``, ``grey`` (the share that is the same in all colours), ``quality`` (0 for none),
            ``seed`` and ``chroma_420``, all ``(B,)``; with ``wide`` also ``wide_share`` and ``wide_blur``.
        """
        strength, coloured, blur, grey, compressed, chroma = uniform(generator, 6, batch)
        quality = torch.randint(self.jpeg[0], self.jpeg[1] + 1, (batch,), generator=generator)
        low, high = self.blur
        is_coloured = coloured < self.coloured

        params = {
            "sigma": strength**1.5 * self.sigma / 255,
            "blur": torch.where(is_coloured, low + (high - low) * blur, 0.0),
            "grey": torch.where(is_coloured, grey, 0.0),
            "quality": torch.where(compressed < 0.5, quality, 0),
            "seed": draw_seeds(batch, generator),
            "chroma_420": chroma < 0.5,
        }
        if self.wide:
            share, width = uniform(generator, 2, batch)
            low, high = self.wide_blur
            params["wide_share"] = torch.where(is_coloured, self.wide * share, 0.0)
            params["wide_blur"] = low * (high / low) ** width
        return params

    def apply(self, srgb: Tensor, params: Params) -> Tensor:
        """Add the noise to sRGB ``(B, 3, H, W)``, and compress some of the pictures."""
        generators = _generators(params)
        noise = _unit_noise(srgb, generators, params["blur"], params["grey"])
        if "wide_share" in params:
            wide = _unit_noise(srgb, generators, params["wide_blur"], params["grey"])
            share = per_picture(params["wide_share"], srgb)
            noise = (1.0 - share).sqrt() * noise + share.sqrt() * wide
        noisy = (srgb + per_picture(params["sigma"], srgb) * noise).clamp_(0.0, 1.0)

        is_jpeg = params["quality"] > 0
        if is_jpeg.any():
            noisy[is_jpeg] = compress_jpeg(noisy[is_jpeg], params["quality"][is_jpeg], params["chroma_420"][is_jpeg])
        return noisy


def _unit_noise(srgb: Tensor, generators: list[torch.Generator], deviation: Tensor, grey: Tensor) -> Tensor:
    """Draw normals of the shape of ``srgb``, blur them, mix a share of their mean into all colours, and scale to 1."""
    noise = gaussian_blur(draw_normals(srgb, generators), deviation)
    noise = noise.lerp(noise.mean(1, keepdim=True), per_picture(grey, srgb))
    return noise / noise.square().mean((1, 2, 3), keepdim=True).sqrt()


MODELS: dict[str, type[SrgbNoise]] = {"BSRGAN": BsrganNoise, "Coloured": ColouredNoise, "Gaussian": WhiteNoise}
"""The models by their names in recipes."""


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
    """Compute a root M of the covariance ``|U^T D U|``: D of ``scales``, U orthonormal with the span of ``basis``."""
    u = torch.linalg.svd(basis).U
    values, vectors = torch.linalg.eigh((u.mT * scales[:, None] @ u).abs())
    return vectors * values.clamp_min(0.0).sqrt()[:, None]


def _generators(params: Params) -> list[torch.Generator]:
    return [keyed_generator(seed, "srgb noise") for seed in params["seed"].tolist()]


def _require_limits(key: str, limits: tuple[float, float], least: int, most: int) -> None:
    is_finite = all(map(math.isfinite, limits))
    if len(limits) != 2 or not is_finite or not least <= limits[0] <= limits[1] <= most:
        raise ValueError(f"{key} must be (lowest, highest) within {least} to {most}, got {limits}")
