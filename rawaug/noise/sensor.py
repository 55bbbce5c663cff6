"""Sensor noise as a sequence of effects: shot and read noise, and a switch for each of :mod:`rawaug.noise.effects`.

Models in sequence, y -> model 1 -> model 2 -> ..., are clipped at white once, at the end; the variances of independent
ones add up. Their parameters share one dictionary and one seed per picture, from which each model draws its own stream.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from rawaug.noise.effects import (
    BlackOffset,
    ColourBias,
    ColumnNoise,
    DefectPixels,
    GreenImbalance,
    Quantisation,
    Range,
    RowNoise,
    TukeyLambdaNoise,
    require_not_negative,
    tukey_lambda_variance,
)
from rawaug.noise.levels import EldLevels, FixedLevels, Iso, NoiseLevels, log_uniform, uniform
from rawaug.noise.models import NOISE, NoiseModel, Params, PoissonGaussianNoise, ShotReadNoise, per_picture
from rawaug.noise.names import noise_levels
from rawaug.registry import Spec, require_between


class Compose(NoiseModel):
    """Several models with different streams, applied in order.

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
        """Draw the parameters of all models into one dictionary; the last seed serves them all."""
        params: Params = {}
        for model in self.models:
            params |= model.sample(batch, generator)
        return params

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Apply the models to ``clean`` ``(B, 4, h, w)`` one after the other."""
        noisy = self.models[0].disturb(clean, params, out)
        for model in self.models[1:]:
            model.disturb(noisy, params, out=noisy)
        return noisy

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Add up the variances ``(B, 4, h, w)`` of all models."""
        return torch.stack([model.variance(clean, params) for model in self.models]).sum(0)


_ABSENT = {
    "row_var": 0.0, "column_var": 0.0, "black_offset": 0.0, "colour_bias": 0.0, "dead_share": 0.0, "hot_share": 0.0,
    "quantum": 0.0, "conditioning": 1.0, "tukey_lambda": 0.14, "green_imbalance": 0.0,
}  # fmt: skip
"""The values of :class:`SensorNoise`'s parameters if an effect is absent; a shape of 0.14 is near the normal."""


@NOISE.register("SensorNoise")
class SensorNoise(Compose):
    """Shot and read noise with a switch for every other effect of a sensor; effects set to 0 or None are off.

    Args:
        levels: a law of (shot_var, read_var), or a name or pair that :func:`noise_levels` knows.
        poisson: use exact photon statistics instead of the Gaussian.
        tukey_lambda: shape of heavy-tailed read noise, or a range of it, instead of Gaussian. Implies ``poisson``.
        row_var, column_var: variance of banding along rows and columns, white = 1, or a range of it.
        black_offset_sd: standard deviation of the black level's error, white = 1.
        colour_bias_sd: standard deviation of the colours' offsets, white = 1.
        green_imbalance: standard deviation of the relative difference of the two greens; see :class:`GreenImbalance`.
        dead, hot: shares of defective pixels, or ranges of them; see :class:`DefectPixels`.
        clusters: share of the defects, 0 to 1, whose whole 2 x 2 cell is defective.
        bits, black_level: the grid of digital numbers; see :class:`Quantisation`.
        conditioning: range of the factor by which the variance map, which conditions a network, is wrong, as the levels
            in a file's tags can be.
        share: share of the pictures that have an effect, 0 to 1, drawn for each effect separately. All pictures have
            shot and read noise. Below 1 a denoiser learns real sensors without forgetting ideal ones.

    Raises:
        ValueError: if a variance or share is out of its range, or the levels are unknown.

    Example:
        >>> from rawaug.noise import Preset
        >>> model = SensorNoise(Preset("cycleisp_sidd"), row_var=(1e-7, 1e-5), bits=10, black_level=64)
    """

    def __init__(
        self,
        levels: NoiseLevels | Spec | Sequence[float] | Sequence[Spec],
        *,
        poisson: bool = False,
        tukey_lambda: float | tuple[float, float] | None = None,
        row_var: Range = 0.0,
        column_var: Range = 0.0,
        black_offset_sd: float = 0.0,
        colour_bias_sd: float = 0.0,
        green_imbalance: float = 0.0,
        dead: Range = 0.0,
        hot: Range = 0.0,
        clusters: float = 0.0,
        bits: int | tuple[int, ...] | None = None,
        black_level: int = 0,
        conditioning: tuple[float, float] = (1.0, 1.0),
        share: float = 1.0,
    ) -> None:
        require_not_negative(conditioning=conditioning)
        require_between("share", share, 0.0, 1.0)
        self.conditioning, self.share = conditioning, share
        if isinstance(levels, (str, Sequence, Mapping)):
            levels = noise_levels(levels)

        # The greens differ in the light that they receive, and photons are counted after that.
        models: list[NoiseModel] = []
        if green_imbalance:
            models.append(GreenImbalance(green_imbalance))

        if tukey_lambda is not None:
            models.append(TukeyLambdaNoise(levels, tukey_lambda))
        elif poisson:
            models.append(PoissonGaussianNoise(levels))
        else:
            models.append(ShotReadNoise(levels))

        if row_var:
            models.append(RowNoise(row_var))
        if column_var:
            models.append(ColumnNoise(column_var))
        if black_offset_sd:
            models.append(BlackOffset(black_offset_sd))
        if colour_bias_sd:
            models.append(ColourBias(colour_bias_sd))
        if dead or hot:
            models.append(DefectPixels(dead, hot, clusters))
        if bits is not None:
            models.append(Quantisation(bits, black_level))
        super().__init__(models)

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the parameters of all effects; those that a picture lacks keep their value of absence."""
        params = super().sample(batch, generator)
        if self.conditioning != (1.0, 1.0):
            params["conditioning"] = log_uniform(self.conditioning, batch, generator)
        if self.share < 1:
            for name, absence in _ABSENT.items():
                if name in params:
                    params[name][uniform(generator, batch) >= self.share] = absence

        return params

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Add up the variances ``(B, 4, h, w)``, then multiply by the factor ``conditioning``."""
        variance = super().variance(clean, params)
        if "conditioning" not in params:
            return variance
        return variance.mul_(per_picture(params["conditioning"], clean))


@NOISE.register("EldNoise")
class EldNoise(Compose):
    """ELD's full model of one of its five cameras: photons, Tukey-lambda read noise, banding, colour bias and rounding.

    Each picture draws one gain K, which determines all scales, and one of the measured shapes of the tails.

    Args:
        camera: ``CanonEOS5D4``, ``CanonEOS700D``, ``CanonEOS70D``, ``NikonD850`` or ``SonyA7S2``.
        iso: one ISO, limits, or None for the whole range of 100 to 6400.
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
        """Draw the parameters of all effects, each ``(batch,)``, at one gain per picture."""
        gain = self.law.sample_gain(batch, generator)
        index = torch.randint(len(self.shapes), (batch,), generator=generator, device=generator.device)
        shape = self.shapes.to(generator.device)[index]

        unit_var = gain.new_tensor([tukey_lambda_variance(value) for value in shape.tolist()])
        return super().sample(batch, generator) | {
            "iso": self.law.iso_at_gain(gain),
            "shot_var": gain / self.law.white_dn,
            "read_var": self.law.sample_scale("tukey_lambda", gain, generator).square() * unit_var,
            "tukey_lambda": shape,
            "row_var": self.law.sample_scale("row", gain, generator).square(),
        }
