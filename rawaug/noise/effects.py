r"""The effects of a sensor beyond shot and read noise; each is a model that can be combined with the others.

They are row and column noise (banding), heavy-tailed read noise, errors of the black level, greens that
disagree, dead and hot pixels, and rounding to digital numbers, after Wei et al., "A physics-based noise formation model
for extreme low-light raw denoising", 2020. All act on black-subtracted RAW with white = 1. The heavy tails follow the
Tukey lambda distribution,

.. math:: Q(u) = (u^\lambda - (1 - u)^\lambda) / \lambda, \qquad \lambda > -1/2,

which is logistic at 0, near the normal at 0.14, and heavier the lower the shape (Joiner and Rosenblatt 1971).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cache
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.noise.levels import NoiseLevels, log_uniform, normal, uniform
from rawaug.noise.models import (
    NoiseModel,
    Params,
    PoissonGaussianNoise,
    draw_normals,
    draw_seeds,
    per_picture,
)
from rawaug.registry import require_between

_NO_STEP = 1e-12
"""Replaces a quantum of 0, which means that nothing is rounded."""

Range = float | tuple[float, float]
"""One value for all pictures, or the limits between which each picture draws its own."""


def require_not_negative(**values: Range) -> None:
    """Raise ValueError unless each number is at least 0, or each range is positive and ascending."""
    for name, value in values.items():
        if isinstance(value, tuple):
            is_valid = 0 < value[0] <= value[1]
        else:
            is_valid = not value < 0
        if not is_valid:
            raise ValueError(f"{name} must be at least 0, or a range (low, high) with 0 < low <= high, got {value}")


def draw_between(value: Range, batch: int, generator: torch.Generator) -> Tensor:
    """Repeat one value ``(batch,)`` times, or draw log-uniformly between two limits."""
    if isinstance(value, tuple):
        return log_uniform(value, batch, generator)
    return torch.full((batch,), float(value), device=generator.device, dtype=torch.float32)


@cache
def tukey_lambda_variance(shape: float) -> float:
    """The variance of the Tukey lambda distribution of scale 1; ValueError for shapes up to -1/2: it is infinite."""
    from scipy.stats import tukeylambda

    if shape <= -0.5:
        raise ValueError(f"a Tukey lambda shape must be above -0.5 (finite variance), got {shape}")
    return float(tukeylambda.var(shape))


class TukeyLambdaNoise(PoissonGaussianNoise):
    """Photon noise with Tukey-lambda read noise; its ``shape``, above -0.5, is one value or uniform in a range."""

    def __init__(self, levels: NoiseLevels, shape: float | tuple[float, float]) -> None:
        super().__init__(levels)
        self.shape = shape if isinstance(shape, tuple) else (shape, shape)
        tukey_lambda_variance(min(self.shape))  # raises ValueError for an infinite variance

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw levels, seeds and the shape ``tukey_lambda`` of the tails, each ``(batch,)``."""
        low, high = self.shape
        shape = low + (high - low) * uniform(generator, batch)
        return super().sample(batch, generator) | {"tukey_lambda": shape}

    def read_noise(self, like: Tensor, params: Params, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw heavy-tailed read noise of the stated variance, ``(B, 4, h, w)``."""
        noise = torch.empty_like(like, memory_format=torch.contiguous_format)
        shapes, variances = params["tukey_lambda"].tolist(), params["read_var"].tolist()
        for picture, shape, read_var, generator in zip(noise, shapes, variances, generators, strict=True):
            scale = math.sqrt(read_var / tukey_lambda_variance(shape))
            u = uniform(generator, *picture.shape)
            picture.copy_(_tukey_lambda(u, shape).mul_(scale))
        return noise


def _tukey_lambda(u: Tensor, shape: float) -> Tensor:
    """Compute the quantile function Q(u)."""
    log_u = u.clamp(min=2**-25).log_()  # rand is a multiple of 2^-24, and may be 0
    log_v = (1 - u).log_()

    if shape == 0:
        return log_u.sub_(log_v)
    return log_u.mul_(shape).expm1_().sub_(log_v.mul_(shape).expm1_()).div_(shape)


class _Banding(NoiseModel):
    """A Gaussian offset of each line of the sensor, whose variance is the parameter ``key``."""

    key: ClassVar[str]
    across: ClassVar[int]
    line_of_plane: ClassVar[list[int]]
    """Which of the two lines of a cell the planes R, Gr, Gb and B lie in."""

    def __init__(self, line_var: Range) -> None:
        require_not_negative(**{self.key: line_var})
        self.line_var = line_var

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the variance of the lines and the seeds, each ``(batch,)``."""
        return {self.key: draw_between(self.line_var, batch, generator), "seed": draw_seeds(batch, generator)}

    @torch.no_grad()
    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the offsets of the lines to ``clean`` ``(B, 4, h, w)``."""
        one = clean[:, :2].narrow(self.across, 0, min(1, clean.shape[self.across]))
        lines = draw_normals(one, self.generators(params, clean.device))
        lines *= per_picture(params[self.key], clean).sqrt()
        return torch.add(clean, lines[:, self.line_of_plane], out=out)

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """The variance of the lines, which is the same at every site of a picture, ``(B, 4, h, w)``."""
        return per_picture(params[self.key], clean).expand_as(clean).clone()


class RowNoise(_Banding):
    """Banding: each row of the sensor has a Gaussian offset of this variance, a number or a range, white = 1."""

    stream, key = "row", "row_var"
    across, line_of_plane = -1, [0, 0, 1, 1]


class ColumnNoise(_Banding):
    """Banding: each column of the sensor has a Gaussian offset, as in :class:`RowNoise`."""

    stream, key = "column", "column_var"
    across, line_of_plane = -2, [0, 1, 0, 1]


class _FixedPattern(NoiseModel):
    """An error that is constant over a picture: it moves the mean and adds no variance from pixel to pixel."""

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Return zeros ``(B, 4, h, w)``, as there is no variance."""
        return torch.zeros_like(clean)


class BlackOffset(_FixedPattern):
    """A black level that is off by N(0, sd^2) in each picture, the same for all colours; ``sd`` with white = 1."""

    stream = "black_offset"
    colours: ClassVar[tuple[int, ...]] = ()
    """Shape of the offsets of one picture."""

    def __init__(self, sd: float) -> None:
        require_not_negative(sd=sd)
        self.sd = sd

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the offsets, ``(batch,)`` or one for each plane ``(batch, 4)``."""
        return {self.stream: self.sd * normal(generator, batch, *self.colours)}

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the offsets to ``clean`` ``(B, 4, h, w)``."""
        offsets = params[self.stream].to(clean).reshape(len(clean), math.prod(self.colours), 1, 1)
        return torch.add(clean, offsets, out=out)


class ColourBias(BlackOffset):
    """An offset N(0, sd^2) of each of R, Gr, Gb and B in each picture, ``sd`` with white = 1: a cast in the shadows."""

    stream = "colour_bias"
    by_plane = True
    colours = (4,)


class GreenImbalance(BlackOffset):
    r"""A gain difference between the greens of red and blue rows, as red and blue neighbours leak in unequally.

    .. math:: y'_{Gr} = (1 + e/2) \, y_{Gr}, \qquad y'_{Gb} = (1 - e/2) \, y_{Gb}, \qquad e \sim N(0, sd^2)

    with one e per picture. The mean of both greens and the clean target stay as they are. In smooth areas of a
    developed picture, such an imbalance shows as a maze.

    Args:
        sd: standard deviation of the relative difference e, typically 0.01.
    """

    stream = "green_imbalance"
    by_plane = True

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Multiply the planes Gr and Gb of ``clean`` ``(B, 4, h, w)`` by their gains."""
        halves = clean.new_tensor([0.0, 0.5, -0.5, 0.0]).reshape(4, 1, 1)
        return torch.mul(clean, 1.0 + halves * per_picture(params[self.stream], clean), out=out)


class DefectPixels(_FixedPattern):
    """Dead pixels, which read black, and hot ones, which add a dark current of U(0, 1); ``variance`` leaves them out.

    Args:
        dead, hot: the share of pixels, typically 1e-5 to 1e-3, or a range to draw it from.
        clusters: the share of the defects, 0 to 1, whose whole 2 x 2 cell is defective.
    """

    stream = "defects"

    def __init__(self, dead: Range = 0.0, hot: Range = 0.0, clusters: float = 0.0) -> None:
        require_not_negative(dead=dead, hot=hot)
        require_between("clusters", clusters, 0.0, 1.0)
        if _largest(dead) + _largest(hot) > 1:
            raise ValueError(f"shares of dead and hot pixels must add up to at most 1, got {dead} and {hot}")

        self.dead, self.hot, self.clusters = dead, hot, clusters

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the shares of dead and hot pixels and the seeds, each ``(batch,)``."""
        shares = {
            "dead_share": draw_between(self.dead, batch, generator),
            "hot_share": draw_between(self.hot, batch, generator),
        }
        return shares | {"seed": draw_seeds(batch, generator)}

    def generators(self, params: Params, device: torch.device) -> Iterator[torch.Generator]:
        """Yield one generator for each picture; all frames of a burst have the defects of one sensor."""
        return super().generators({**params, "seed": params.get("sensor_seed", params["seed"])}, device)

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Put the defects into ``clean`` ``(B, 4, h, w)``."""
        noisy = clean.clone() if out is None else out.copy_(clean)

        for i, generator in enumerate(self.generators(params, clean.device)):
            dead, hot = float(params["dead_share"][i]), float(params["hot_share"][i])
            place, current = uniform(generator, 2, *clean.shape[1:]).to(clean)
            if self.clusters:
                cell = uniform(generator, *clean.shape[-2:])
                place = torch.where(cell < self.clusters, place[:1], place)

            noisy[i].masked_fill_(place < dead, 0.0)
            noisy[i] += torch.where(place >= 1 - hot, current, 0.0)
        return noisy


def _largest(share: Range) -> float:
    return max(share) if isinstance(share, tuple) else share


class Quantisation(NoiseModel):
    """Rounding to the sensor's digital numbers; a variance of a twelfth of a squared step needs noise of half a step.

    Args:
        bits: the sensor's depth, 1 to 16, or several depths, of which each picture draws one.
        black_level: the black level in digital numbers; 2^bits - 1 - black_level steps lead from black to white.
    """

    stream = "quantisation"

    def __init__(self, bits: int | tuple[int, ...], black_level: int = 0) -> None:
        depths = bits if isinstance(bits, tuple) else (bits,)
        if not depths:
            raise ValueError("bits must be 1 to 16, got none")

        self.quanta = []
        for depth in depths:
            if not 1 <= depth <= 16 or not 0 <= black_level < 2**depth - 1:
                raise ValueError(f"bits must be 1 to 16 and the black level below white, got {bits} and {black_level}")
            self.quanta.append(1 / (2**depth - 1 - black_level))

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the step of the grid for each picture, ``(batch,)``, white = 1."""
        if len(self.quanta) == 1:
            return {"quantum": draw_between(self.quanta[0], batch, generator)}

        index = torch.randint(len(self.quanta), (batch,), generator=generator, device=generator.device)
        return {"quantum": torch.tensor(self.quanta, device=generator.device)[index]}

    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Round ``clean`` ``(B, 4, h, w)`` to the grid."""
        quantum = per_picture(params["quantum"], clean).clamp_min(_NO_STEP)
        return torch.div(clean, quantum, out=out).round_().mul_(quantum)

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Return a twelfth of the squared step, ``(B, 4, h, w)``."""
        return (per_picture(params["quantum"], clean).square() / 12).expand_as(clean).clone()
