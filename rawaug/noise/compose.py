"""Noise models in sequence: y -> model 1 -> model 2 -> ..., and one clip at white at the end.

Variances of independent models add up. The models' parameters lie side by side in one dictionary, with one seed a
picture from which every model draws its own stream.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rawaug.noise.by_name import noise_levels
from rawaug.noise.iso import EldLevels, Iso
from rawaug.noise.levels import FixedLevels, NoiseLevels
from rawaug.noise.models import NoiseModel, Params, PoissonGaussianNoise, ShotReadNoise
from rawaug.noise.sensor import (
    BlackOffset,
    ColourBias,
    DefectPixels,
    Quantisation,
    Range,
    RowNoise,
    TukeyLambdaNoise,
    tukey_lambda_variance,
)
from rawaug.registry import NOISE


class Compose(NoiseModel):
    """Several models, applied in order.

    Raises:
        ValueError: if two of them draw from the same stream, as two kinds of shot and read noise do.

    Example:
        >>> model = Compose([ShotReadNoise(FixedLevels(1e-3, 1e-5)), RowNoise(1e-6), Quantisation(bits=12)])
    """

    stream = "compose"

    def __init__(self, models: Sequence[NoiseModel]) -> None:
        streams = [model.stream for model in models]
        if not models or len(set(streams)) < len(streams):
            raise ValueError(f"Compose needs one or more noise models of different kinds, got {streams}")
        self.models = list(models)
        self.by_plane = any(model.by_plane for model in models)

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        params: Params = {}
        for model in self.models:
            params |= model.sample(batch, generator)
        return params

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        noisy = self.models[0].disturb(clean, params, out)
        for model in self.models[1:]:
            model.disturb(noisy, params, out=noisy)
        return noisy

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        return torch.stack([model.variance(clean, params) for model in self.models]).sum(0)


@NOISE.register("SensorNoise")
class SensorNoise(Compose):
    """Shot and read noise with a switch for everything else that a sensor does; what is 0 or None is off.

    Args:
        levels: what samples (shot_var, read_var), or a name or pair that :func:`noise_levels` knows.
        poisson: exact photon statistics instead of the Gaussian.
        tukey_lambda: shape of heavy-tailed read noise instead of Gaussian, or a range of it. Implies ``poisson``.
        row_var: variance of banding, or a range of it.
        black_offset_sd: standard deviation of the black level's error.
        colour_bias_sd: standard deviation of the colours' offsets.
        dead, hot: shares of defect pixels.
        bits, black_level: the grid of digital numbers.

    Example:
        >>> from rawaug.noise import Preset
        >>> model = SensorNoise(Preset("cycleisp_sidd"), row_var=(1e-7, 1e-5), bits=10, black_level=64)
    """

    def __init__(
        self,
        levels: NoiseLevels | str | Sequence[float] | Sequence[str],
        *,
        poisson: bool = False,
        tukey_lambda: float | tuple[float, float] | None = None,
        row_var: Range = 0.0,
        black_offset_sd: float = 0.0,
        colour_bias_sd: float = 0.0,
        dead: float = 0.0,
        hot: float = 0.0,
        bits: int | None = None,
        black_level: int = 0,
    ) -> None:
        levels = noise_levels(levels) if isinstance(levels, (str, Sequence)) else levels
        models: list[NoiseModel] = [PoissonGaussianNoise(levels) if poisson else ShotReadNoise(levels)]
        if tukey_lambda is not None:
            models = [TukeyLambdaNoise(levels, tukey_lambda)]
        if row_var:
            models.append(RowNoise(row_var))
        if black_offset_sd:
            models.append(BlackOffset(black_offset_sd))
        if colour_bias_sd:
            models.append(ColourBias(colour_bias_sd))
        if dead or hot:
            models.append(DefectPixels(dead, hot))
        if bits is not None:
            models.append(Quantisation(bits, black_level))
        super().__init__(models)


@NOISE.register("EldNoise")
class EldNoise(Compose):
    """ELD's full model of one of its five cameras: photons, Tukey-lambda read noise, banding, colour bias and rounding.

    One gain K is drawn a picture, and the scales of all of them follow it (:class:`rawaug.noise.iso.EldLevels`); the
    shape of the tails is one of those that were measured (Wei et al. 2020). It matters in deep shadows.

    Args:
        camera: ``CanonEOS5D4``, ``CanonEOS700D``, ``CanonEOS70D``, ``NikonD850`` or ``SonyA7S2``.
        iso: one ISO, limits, or None for all of 100 to 6400.
    """

    def __init__(self, camera: str, iso: Iso = None) -> None:
        self.law = EldLevels(camera, iso)
        shapes = self.law.camera["tukey_lambda_shape"]
        self.shapes = torch.tensor(shapes, dtype=torch.float32)
        tails = TukeyLambdaNoise(FixedLevels(0, 0), (min(shapes), max(shapes)))
        bias = ColourBias(self.law.camera["colour_bias_sd_dn"] / self.law.white_dn)
        rounding = Quantisation(bits=14, black_level=2**14 - 1 - int(self.law.white_dn))
        super().__init__([tails, RowNoise(0.0), bias, rounding])

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        gain = self.law.sample_gain(batch, generator)
        chosen = torch.randint(len(self.shapes), (batch,), generator=generator, device=generator.device)
        shape = self.shapes.to(generator.device)[chosen]
        unit_var = gain.new_tensor([tukey_lambda_variance(value) for value in shape.tolist()])
        return super().sample(batch, generator) | {
            "shot_var": gain / self.law.white_dn,
            "read_var": self.law.sample_scale("tukey_lambda", gain, generator).square() * unit_var,
            "tukey_lambda": shape,
            "row_var": self.law.sample_scale("row", gain, generator).square(),
        }
