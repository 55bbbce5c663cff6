r"""Shot and read noise, which every sensor has.

.. math:: y_{noisy} = y + n, \qquad \operatorname{var}(n) = \mathrm{shot\_var} \cdot y + \mathrm{read\_var}

on linear, black-subtracted RAW with white = 1 (Foi et al., "Practical Poissonian-Gaussian noise modeling and fitting
for single-image raw-data", 2008). Shot noise is the Poisson statistics of photons, ``shot_var`` being the share of
white that one electron makes; read noise comes from the electronics. Noisy RAW is clipped at white, as a sensor does,
and never at black: zero-mean noise stays zero-mean in the shadows.

Each picture has one ``seed`` among its parameters, from which ``apply`` draws. The same parameters give the same bits,
whatever else is in the batch and on any number of threads. On a GPU the default noise equals that of the CPU within
1e-6 of its standard deviation. All other noise, and any noise without Triton, has its own stream for each kind of
device.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from rawaug.bayer import noise_variance
from rawaug.errors import count_of
from rawaug.kernels import fastest
from rawaug.kernels.reference import normals
from rawaug.kernels.runtime import eager, move_together
from rawaug.noise.levels import NoiseLevels, draw_levels
from rawaug.registry import Registry
from rawaug.seeding import derive_seed, keyed_generator

NOISE = Registry("noise", "rawaug.noise", "rawaug.noise")
"""The noise models by name, subclasses of :class:`NoiseModel`; :mod:`rawaug.noise.names` has presets and cameras."""

Params = dict[str, Tensor]
"""Parameters of a batch by name; they are tensors whose first dimension is B."""

_NO_SHOT = 1e-30
"""Replaces a shot_var of 0 to avoid division by zero; too small to affect the picture."""
_GROUP = 2**18
"""Number of values whose photons are drawn at a time, from many small pictures or one large one."""
INVERSION_LIMIT = 10.0
"""The rate above which counts are drawn by the expansion, whose distribution function errs by 5e-5."""
_CPU_PIECE = 2**15
"""Number of counts that are drawn at a time on a CPU, to stay in its cache."""


class NoiseModel(ABC):
    """Base of noise on packed RAW ``(B, 4, h, w)``, black 0 and white 1.

    It is used as ``noisy = model.apply(clean, model.sample(B, generator))``.

    Models that are combined on one picture draw from its one seed without correlation, each from its own ``stream``.
    """

    stream: ClassVar[str]
    by_plane = False
    """Whether the four planes differ in more than their signal; such noise applies to packed Bayer RAW only."""

    @abstractmethod
    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw the parameters of ``batch`` pictures, as tensors of that leading dimension on the generator's device."""

    @abstractmethod
    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the noise to ``clean`` ``(B, 4, h, w)`` without the clip at white.

        The result is written to ``out``, which may be ``clean`` itself, or to new memory.
        """

    @abstractmethod
    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Compute the variance map ``(B, 4, h, w)`` of the noise on a signal, before the clip at white."""

    @eager
    def apply(self, clean: Tensor, params: Params) -> Tensor:
        """Make noisy RAW from clean packed RAW, both ``(B, 4, h, w)``; it is clipped at white and not at black.

        The same parameters give the same bits. They may be on another device than the picture. No gradient passes.

        Raises:
            ValueError: if ``clean`` is not packed RAW in float32 or float64, or ``params`` are for another batch size.
        """
        _require_batch(clean, params)
        return self.disturb(clean, params).clamp_(max=1.0)

    def apply_with_variance(self, clean: Tensor, params: Params) -> tuple[Tensor, Tensor]:
        """Make noisy RAW as :meth:`apply` does, and its variance map from the noisy signal, both ``(B, 4, h, w)``."""
        noisy = self.apply(clean, params)
        return noisy, self.variance(noisy, params)

    def move(self, params: Params, device: torch.device) -> Params:
        """Move the parameters that :meth:`apply` takes from the device of the pictures; by default it takes none."""
        return params

    def generators(self, params: Params, device: torch.device) -> Iterator[torch.Generator]:
        """Yield one generator for each picture on ``device``, keyed by the picture's seed and the model's stream."""
        for seed in params["seed"].tolist():
            yield keyed_generator(seed, self.stream, device=device)


def _require_batch(clean: Tensor, params: Params) -> None:
    """Raise ValueError unless ``clean`` is ``(B, 4, h, w)`` in float32 or float64 and every parameter has length B."""
    if clean.ndim != 4 or clean.shape[1] != 4 or clean.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"noise needs packed float32 RAW (B, 4, h, w), got {tuple(clean.shape)} {clean.dtype}")
    for name, value in params.items():
        if value.shape[:1] != clean.shape[:1]:
            pictures = count_of(len(clean), "picture")
            raise ValueError(f"noise parameter {name!r}: {tuple(value.shape)}, but the batch has {pictures}")


def move_params(params: Params, device: torch.device) -> Params:
    """Move parameters to a device in one copy; seeds stay on the host, where generators are made."""
    names = [name for name in params if not name.endswith("seed")]
    moved = move_together([params[name] for name in names], device)
    return {**params, **dict(zip(names, moved, strict=True))}


def draw_seeds(batch: int, generator: torch.Generator) -> Tensor:
    """Draw one int64 seed for each picture, ``(batch,)``."""
    return torch.randint(2**63 - 1, (batch,), generator=generator, device=generator.device)


def per_picture(value: Tensor, like: Tensor) -> Tensor:
    """Shape parameters ``(B,)`` as ``(B, 1, 1, 1)``, on the device and in the type of ``like``."""
    return value.to(like).reshape(-1, 1, 1, 1)


def draw_normals(like: Tensor, generators: Iterable[torch.Generator]) -> Tensor:
    """Draw standard normals in the shape ``(B, ...)`` and type of ``like`` from one generator for each picture."""
    values = torch.empty_like(like, memory_format=torch.contiguous_format)
    for picture, generator in zip(values, generators, strict=True):
        picture.normal_(generator=generator)
    return values


class ShotReadModel(NoiseModel):
    """Base of noise with var = shot_var y + read_var, whose levels come from a law such as ``Preset("upi")``."""

    stream = "shot_read"

    def __init__(self, levels: NoiseLevels) -> None:
        self.levels = levels

    def sample(self, batch: int, generator: torch.Generator) -> Params:
        """Draw ``shot_var``, ``read_var`` and ``seed``, and ``iso`` if the levels depend on it, each ``(batch,)``."""
        drawn = draw_levels(self.levels, batch, generator)
        params = {name: drawn[name] for name in ("shot_var", "read_var", "iso") if name in drawn}
        return params | {"seed": draw_seeds(batch, generator)}

    def variance(self, clean: Tensor, params: Params) -> Tensor:
        """Compute ``shot_var max(clean, 0) + read_var``, ``(B, 4, h, w)``."""
        shot_var = per_picture(params["shot_var"], clean)
        read_var = per_picture(params["read_var"], clean)
        return noise_variance(clean, shot_var, read_var)


class ShotReadNoise(ShotReadModel):
    """Gaussian noise of variance ``shot_var * y + read_var``: the default, and fast.

    Example:
        >>> from rawaug.noise import FixedLevels
        >>> model = ShotReadNoise(FixedLevels(1e-3, 1e-5))
        >>> params = model.sample(2, torch.Generator().manual_seed(0))
        >>> model.apply(torch.rand(2, 4, 8, 8), params).shape
        torch.Size([2, 4, 8, 8])
    """

    @property
    def is_plain(self) -> bool:
        """Whether shot and read noise are all there is, so that the pass that makes clean RAW may add them."""
        return type(self).apply_with_variance is ShotReadNoise.apply_with_variance

    @eager
    def apply(self, clean: Tensor, params: Params) -> Tensor:
        """Make noisy RAW ``(B, 4, h, w)`` in one pass over the pixels; see :meth:`NoiseModel.apply`."""
        _require_batch(clean, params)
        return self._add_noise(clean, params, white=1.0)[0]

    @eager
    def apply_with_variance(self, clean: Tensor, params: Params) -> tuple[Tensor, Tensor]:
        """Make noisy RAW and its variance map, both ``(B, 4, h, w)``, in one pass over the pixels."""
        _require_batch(clean, params)
        return self._add_noise(clean, params, white=1.0, mapped=True)

    @torch.no_grad()
    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add the noise to ``clean`` ``(B, 4, h, w)`` without the clip at white."""
        noisy, _ = self._add_noise(clean, params, white=math.inf)
        if out is None:
            return noisy
        return out.copy_(noisy)

    def _add_noise(self, clean: Tensor, params: Params, white: float, mapped: bool = False) -> tuple[Tensor, Tensor]:
        in_pytorch = partial(self._in_pytorch, clean, params, white, mapped)
        if clean.dtype != torch.float32:
            return in_pytorch()

        return fastest("shot_read", clean, *self.levels_and_keys(params), white, mapped, otherwise=in_pytorch)

    def levels_and_keys(self, params: Params) -> tuple[Tensor, list[int]]:
        """Shot and read variance ``(B, 2)`` and a number for each picture, as the passes over pixels take them."""
        return torch.stack([params["shot_var"], params["read_var"]], dim=1), self._keys(params)

    def _in_pytorch(self, clean: Tensor, params: Params, white: float, with_variance: bool) -> tuple[Tensor, Tensor]:
        params = move_params(params, clean.device)
        deviation = self.variance(clean, params).sqrt_()
        noisy = torch.addcmul(clean, self._normals(clean, params), deviation).clamp_(max=white)
        if with_variance:
            return noisy, self.variance(noisy, params)
        return noisy, noisy[:, :, :0]

    def _normals(self, like: Tensor, params: Params) -> Tensor:
        if like.device.type != "cpu":
            return draw_normals(like, self.generators(params, like.device))

        height, width = like.shape[-2:]
        pictures = []
        for key in self._keys(params):
            pictures.append(normals(key, height, width))
        return torch.stack(pictures).to(like)

    def _keys(self, params: Params) -> list[int]:
        return [derive_seed(seed, self.stream) for seed in params["seed"].tolist()]


class PoissonGaussianNoise(ShotReadModel):
    """Exact photon statistics: ``shot_var * Poisson(y / shot_var) + N(0, read_var)``, skewed at low counts."""

    @torch.no_grad()
    def disturb(self, clean: Tensor, params: Params, out: Tensor | None = None) -> Tensor:
        """Add photon and read noise to ``clean`` ``(B, 4, h, w)`` without the clip at white."""
        noisy = out
        if noisy is None:
            noisy = torch.empty_like(clean, memory_format=torch.contiguous_format)

        generators = list(self.generators(params, clean.device))
        pictures = max(1, _GROUP // max(1, clean[:1].numel()))
        for first in range(0, len(clean), pictures):
            group = slice(first, first + pictures)
            noise = self._noise(clean[group], params, group, generators[group])
            torch.add(clean[group], noise, out=noisy[group])
        return noisy

    def _noise(self, clean: Tensor, params: Params, group: slice, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw the noise of a group of pictures: for each picture first the photons, then the read noise."""
        shot_var = per_picture(params["shot_var"][group], clean)
        light = clean.clamp(min=0)
        photons = poisson(light / shot_var.clamp(min=_NO_SHOT), draw_normals(clean, generators)).mul_(shot_var)
        shot_noise = photons.sub_(light).masked_fill_(shot_var <= _NO_SHOT, 0.0)

        group_params = {name: value[group] for name, value in params.items()}
        return shot_noise.add_(self.read_noise(clean, group_params, generators))

    def read_noise(self, like: Tensor, params: Params, generators: Sequence[torch.Generator]) -> Tensor:
        """Draw read noise in the shape ``(B, 4, h, w)`` of ``like``, from one generator for each picture."""
        return draw_normals(like, generators).mul_(per_picture(params["read_var"], like).sqrt())


def poisson(rate: Tensor, normals: Tensor) -> Tensor:
    """Turn standard normal draws into Poisson counts for the expected counts ``rate``; both are of any shape.

    ``normals`` must be contiguous; the counts are written over them.

    A count is the quantile of its draw, because ``torch.poisson`` has poor streams on CUDA and fails at high rates.
    Below :data:`INVERSION_LIMIT` the distribution function is summed; from there on its inverse is Giles' expansion in
    ``rate**-0.5`` (Algorithm 955, ACM TOMS 2016), rounded down.
    """
    piece = max(rate.numel(), 1)
    if rate.device.type == "cpu":
        piece = _CPU_PIECE

    for part, out in zip(rate.reshape(-1).split(piece), normals.view(-1).split(piece), strict=True):
        low = part < INVERSION_LIMIT
        low_counts = _invert_sum(part[low], out[low]).to(out)
        out.copy_(_invert_expansion(part, out))
        out[low] = low_counts
    return normals


def _invert_expansion(rate: Tensor, w: Tensor) -> Tensor:
    """Invert the distribution function by Giles' expansion to the order 1 / rate, rounded down."""
    root = rate.clamp(min=INVERSION_LIMIT).sqrt()
    w2 = w * w

    tail = (-8 / 405 + w2 * (7 / 810 + w2 / 270)) / root - w * (1 / 36 + w2 / 72)
    return (rate + w * root + (1 / 3 + w2 / 6) + tail / root).floor_().clamp_(min=0)


def _invert_sum(rate: Tensor, w: Tensor) -> Tensor:
    """Count the k with F(k) < Phi(w), in double precision; in single, the sum would stop short of the far tail."""
    rate = rate.double()
    u = torch.special.ndtr(w.double()).clamp_(max=1 - 1e-13)  # the sum reaches this limit

    term = torch.exp(-rate)
    total = term.clone()
    count = torch.zeros_like(rate)
    k = 0
    while (below := total < u).any():
        k += 1
        count += below
        term *= rate / k
        total += term

    return count
