"""Training samples of developed pictures, with a camera's noise or with noise drawn on sRGB."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from annotated_types import Interval

from rawaug.data.pairs import Sample
from rawaug.isp.functional import as_float
from rawaug.plugin.crops import crop_size, draw_patch
from rawaug.registry import require_between, require_bounds
from rawaug.training.sources import PictureCrops
from rawaug.training.srgb_noise import SrgbNoise


class NoisyPictures:
    """Training samples of a model of noise on sRGB: a crop of a picture, placed as in :class:`rawaug.RawPairs`.

    Args:
        pictures: a Dataset of pictures.
        noise: the model, see :func:`rawaug.training.srgb_noise.noise_on_srgb`.
        crop: side in pixels.
        zoom: see :class:`rawaug.RawPairs`.
    """

    def __init__(self, pictures: Sequence[Any], noise: SrgbNoise, crop: int, zoom: float = 1.0) -> None:
        self.pictures = pictures
        self.noise = noise
        self.crop = crop_size(crop)
        self.zoom = zoom

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw a sample of one crop, ``(3, crop, crop)``."""
        picture = self.pictures[int(torch.randint(len(self.pictures), (), generator=generator))]
        patch = draw_patch(picture, self.crop, True, generator, self.zoom)[0]

        clean = as_float(patch)[None]
        params = self.noise.sample(1, generator)
        noisy = self.noise.apply(clean, params)
        return Sample(noisy[0], clean[0], torch.zeros_like(clean[0]))


@dataclass
class Conditioning:
    """The level of noise that is given in training to a network that reads one.

    A share of the pairs has no level, another share has the pair's own, and the rest have a wrong one.

    Args:
        unknown: share of the pairs with the level 0, which stands for unknown.
        exact: share with the deviation of the pair, the root mean square of noisy minus clean.
        factor: largest factor by which the wrong level is off, up or down, drawn by its logarithm.
    """

    unknown: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.35
    exact: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.4
    factor: Annotated[float, Interval(ge=1.0, le=10.0)] = 1.6

    def __post_init__(self) -> None:
        require_bounds(self, "noise_level.")
        require_between("noise_level.exact", self.exact, 0.0, 1.0 - self.unknown)

    def sample(self, generator: torch.Generator) -> float:
        """Draw what the deviation is multiplied by: 0 for unknown, 1, or a factor."""
        kind, exponent = torch.rand(2, generator=generator).tolist()
        if kind < self.unknown:
            return 0.0
        if kind < self.unknown + self.exact:
            return 1.0
        return float(self.factor ** (2.0 * exponent - 1.0))

    def apply(self, sample: Sample, times: float) -> Sample:
        """Put a map ``(3, H, W)`` of the variance, its deviation multiplied by ``times``, into a sample."""
        variance = (sample.noisy - sample.clean).square().mean() * times**2
        return sample._replace(variance=variance.expand_as(sample.noisy))


class SrgbSamples:
    """Training samples of developed pictures; a share of them has noise drawn on sRGB in place of the camera's.

    Args:
        camera: pairs of target ``"srgb"``; None if all noise is drawn on sRGB.
        drawn: the samples with noise drawn on sRGB; None if there are none.
        share: share of the samples that have noise drawn on sRGB.
        noise_level: the level of noise that the network is given; None for none.
    """

    def __init__(
        self, camera: PictureCrops | None, drawn: NoisyPictures | None, share: float, noise_level: Conditioning | None
    ) -> None:
        self.camera = camera
        self.drawn = drawn
        self.share = share
        self.noise_level = noise_level

    def draw(self, generator: torch.Generator) -> Sample:
        """Draw one sample."""
        return self.draw_batch([generator])[0]

    def draw_batch(self, generators: Sequence[torch.Generator]) -> list[Sample]:
        """Draw one sample for each generator; those of the camera are made together."""
        samples: dict[int, Sample] = {}
        of_camera: dict[int, torch.Generator] = {}
        for number, generator in enumerate(generators):
            if self.drawn is not None and (self.camera is None or self._is_drawn(generator)):
                samples[number] = self.drawn.draw(generator)
            else:
                of_camera[number] = generator

        if self.camera is not None and of_camera:
            batch = self.camera.draw_batch(list(of_camera.values()))
            samples.update(zip(of_camera, batch, strict=True))

        in_order = []
        for number, generator in enumerate(generators):
            sample = samples[number]
            if self.noise_level is not None:
                sample = self.noise_level.apply(sample, self.noise_level.sample(generator))
            in_order.append(sample)
        return in_order

    def _is_drawn(self, generator: torch.Generator) -> bool:
        return bool(torch.rand((), generator=generator) < self.share)
