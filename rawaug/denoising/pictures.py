r"""Denoisers of developed pictures, sRGB ``(1, 3, H, W)`` in [0, 1], beside :class:`rawaug.RawDenoiser` for RAW.

.. math:: d = x + w\, (f(x, s \sigma) - x)

A network f is told the level of the noise, its standard deviation :math:`\sigma`, and a share w of its correction is
applied. Both are estimated from the picture, see :mod:`rawaug.denoising.picture_levels`. The strength s is 1 unless the
user says otherwise.

A network that estimates the level sees the picture twice, upright and turned by a quarter, and the two results are
averaged. This gains half of what the self-ensemble does, which is the mean of eight views, as for RAW.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

import denoisers
from denoisers.classical import FILTERS
from denoisers.published import Image
from rawaug import bayer
from rawaug.denoising.base import ImageDenoiser, Noisy, progress_by, read_named
from rawaug.denoising.picture_levels import PictureLevel, estimate_level, white_level
from rawaug.registry import Spec, spec_label

_TILE = 1024
"""Side of a tile; without tiles, the default denoiser needs more than 2 GB for 12 megapixels."""
_LOWEST = 1e-4
"""The lowest level that a filter is told, since it divides by it."""
VIEWS = {1: (0,), 2: (0, 5), 4: range(4), 8: range(bayer.N_VIEWS)}
"""The views that are averaged, by the number of views."""


@dataclass(frozen=True, kw_only=True)
class PictureDenoiser(ImageDenoiser):
    """Anything that denoises pictures.

    :meth:`of` takes the name of a shipped denoiser of pictures or of a classical filter, ``{"name": ..., "settings":
    {...}}``, a ``.safetensors`` of rawaug or of FFDNet's authors, or a network of sRGB; with ``@15`` behind a name, it
    is told this level, in units of 1/255, every time.

    Attributes:
        run: ``run(srgb, noise) -> srgb``, called on ``device`` with the noise that is told or estimated.
        estimate: estimates the level of a picture where none is told.
        level: the level that it is told every time; None for the estimate.
        views: number of flips and quarter turns of the picture that are averaged, 1, 2, 4 or 8; by default as many as
            the network asks for.
        strength: factor on the estimated level, 0 to 10: 2 removes more, 0.5 less, 0 nothing.

    The other attributes are those of :class:`rawaug.denoising.base.ImageDenoiser`.

    Example:
        >>> denoiser = PictureDenoiser.of("NonLocalMeans@10")
        >>> denoiser(Noisy(torch.rand(1, 3, 32, 48))).shape
        torch.Size([1, 3, 32, 48])
    """

    takes: ClassVar[Image] = "srgb"
    default: ClassVar[str] = "rawaug-srgb"
    files: ClassVar[str] = "or a .safetensors of rawaug run srgb or of FFDNet's authors"

    run: Callable[[Tensor, PictureLevel], Tensor] = field(repr=False)
    estimate: Callable[[Tensor], PictureLevel] = field(repr=False)
    level: float | None = None

    def __post_init__(self) -> None:
        if self.views not in VIEWS:
            raise ValueError(f"views must be 1, 2, 4 or 8, got {self.views!r}")
        if not 0.0 <= self.strength <= 10.0:
            raise ValueError(f"strength must be between 0 and 10, got {self.strength}")
        if self.level is not None and not self.reads_levels:
            raise ValueError(f"{self.name}: is told no level; leave out what stands after @")

    @classmethod
    def _resolve(cls, spec: Any, name: str | None) -> PictureDenoiser:
        if isinstance(spec, nn.Module):
            return _of_network(type(spec).__name__, spec, {})
        if isinstance(spec, Mapping):
            return _of_filter(spec)

        stem, level = _split_level(str(spec))
        if stem in FILTERS:
            denoiser = _of_filter(stem)
        else:
            file = read_named(stem, cls)
            denoiser = _of_network(file.name, file.network, file.info)

        if level is None:
            return denoiser
        return replace(denoiser, name=f"{denoiser.name}, told {255.0 * level:g}", level=level)

    @torch.inference_mode()
    def __call__(self, noisy: Noisy) -> Tensor:
        """sRGB ``(1, 3, H, W)`` denoised, on the CPU, cut to [0, 1]."""
        srgb = noisy.image.to(self.device)
        total = torch.zeros_like(srgb)
        with self._precision():
            for view in VIEWS[self.views]:
                denoised = self._denoise(bayer.turn(srgb, view).contiguous())
                total += bayer.turn_back(denoised, view)

        mean = total.div_(self.views).cpu().clamp_(0.0, 1.0)
        return self._require_sound(mean, noisy.image, noisy.image.shape)

    def _denoise(self, srgb: Tensor) -> Tensor:
        """One view of the picture at the level that is told, or at the one that is estimated."""
        if not self.reads_levels:
            return self.run(srgb, PictureLevel(0.0, 1.0))
        if self.level is None and self.strength == 0.0:
            return srgb

        if self.level is None:
            noise = self.estimate(srgb)
            noise = noise._replace(level=self.strength * noise.level)
        else:
            noise = PictureLevel(self.level, 1.0)

        denoised = self.run(srgb, noise)
        return torch.lerp(srgb, denoised, noise.share, out=denoised)  # in place, since pictures are large


# -- by what it is made of ---------------------------------------------------------------------------------------------


def _of_network(name: str, network: nn.Module, info: Mapping[str, Any]) -> PictureDenoiser:
    """A network of sRGB in tiles; one that reads levels is told the picture's."""
    network = network.eval()
    reads_levels = bool(getattr(network, "reads_variance", False))

    run: Callable[..., Tensor] = _denoise_blindly
    if reads_levels:
        run = _denoise_at

    return PictureDenoiser(
        name=name,
        network=network,
        info=info,
        run=partial(run, network),
        estimate=partial(estimate_level, network),
        reads_levels=reads_levels,
        views=getattr(network, "views", 1),
    )


def _of_filter(spec: Spec) -> PictureDenoiser:
    """A classical filter of white noise on the three colours, which is told scikit-image's estimate of its level."""
    denoiser = FILTERS.make(spec)

    def run(srgb: Tensor, noise: PictureLevel) -> Tensor:
        deviation = max(_LOWEST, noise.level)
        planes = (srgb[0] / deviation).permute(1, 2, 0).contiguous().numpy()
        return torch.from_numpy(deviation * denoiser.denoise(planes)).permute(2, 0, 1)[None].float()

    def estimate(srgb: Tensor) -> PictureLevel:
        return PictureLevel(white_level(srgb), 1.0)

    return PictureDenoiser(name=spec_label(spec), run=run, estimate=estimate)


def _split_level(spec: str) -> tuple[str, float | None]:
    """Split ``NAME@15`` into a name and a level, white at 1; the level is None where there is none."""
    name, at, stated_level = spec.rpartition("@")
    if not at:
        return spec, None

    try:
        level = float(stated_level) / 255.0
    except ValueError:
        level = -1.0
    if not 0.0 <= level <= 1.0:
        raise ValueError(f"{spec}: the level after @ must be from 0 to 255, got {stated_level}")
    return name, level


def _denoise_blindly(network: nn.Module, srgb: Tensor, noise: PictureLevel) -> Tensor:
    """The picture denoised by a network that reads no level."""
    return denoisers.denoise_tiles(network, srgb, each=progress_by("tile"))


def _denoise_at(network: nn.Module, srgb: Tensor, noise: PictureLevel) -> Tensor:
    """The picture denoised by a network that is told the deviation of its noise, 0 for unknown."""
    variance = srgb.new_full((1, 1, 1, 1), noise.level**2).expand_as(srgb)
    return denoisers.denoise_tiles(network, srgb, variance, tile=_TILE, each=progress_by("tile")).float()
