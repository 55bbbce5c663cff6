r"""What denoises developed pictures, sRGB ``(1, 3, H, W)`` in [0, 1], beside :class:`rawaug.RawDenoiser` for RAW.

.. math:: d = x + w\, (f(x, s \sigma) - x)

A network f is told the level of the noise, its standard deviation :math:`\sigma`, and the share w of its correction is
applied; both are estimated from the picture, see :mod:`rawaug.denoising.picture_levels`. The strength s is 1 unless the
user says otherwise. A network that estimates the level sees the picture twice, upright and turned by a quarter, and the
mean is taken: half of what the self-ensemble gains, the mean of eight turns as for RAW.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

import denoisers
from denoisers.classical import FILTERS
from denoisers.files import find_denoiser, list_shipped
from rawaug import bayer
from rawaug.denoising.denoiser import CPU, Noisy, progress_by
from rawaug.denoising.picture_levels import estimate_level, white_level
from rawaug.denoising.weights import read_network
from rawaug.kernels.runtime import find_device, has_fast_bfloat16
from rawaug.registry import Spec, spec_label, suggest

PICTURES = "rawaug-srgb"
"""The default picture denoiser."""
_TILE = 1280
"""Side of a tile; the default denoiser needs more than 2 GB for 12 megapixels at once."""
TURNS = {1: (0,), 2: (0, 5), 4: range(4), 8: range(bayer.N_VIEWS)}
"""The views that are averaged, by the number of views."""


@dataclass(frozen=True)
class PictureDenoiser:
    """Anything that denoises pictures: ``run(srgb) -> srgb``, called on ``device``, for each of ``views`` turns.

    ``mixed`` says whether it computes in bfloat16.
    """

    name: str
    run: Callable[[Tensor], Tensor]
    device: torch.device = CPU
    views: int = 1
    mixed: bool = False

    takes: ClassVar[str] = "srgb"

    @classmethod
    def of(
        cls,
        spec: str | Path,
        device: str = "cpu",
        strength: float = 1.0,
        views: int | None = None,
        precision: Literal["full", "auto"] = "full",
    ) -> PictureDenoiser:
        """The denoiser that a name or a file stands for.

        Args:
            spec: the name of a shipped denoiser of pictures or of a classical filter, or a ``.safetensors`` of rawaug
                or of FFDNet's authors; with ``@15`` behind it, it is told this level, in units of 1/255, every time.
            device: auto, cpu, cuda, ...
            strength: factor on the estimated level: 2 removes more, 0.5 less, 0 nothing.
            views: 1, 2, 4 or 8 turns of the picture, at that many times the work; by default 2 of a network that
                estimates the level, and 1 of others.
            precision: ``"auto"`` computes in bfloat16 where that is fast and costs the network less than 0.05 dB.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is no denoiser of pictures, or strength or level is negative.

        Example:
            >>> denoiser = PictureDenoiser.of("rawaug-srgb@10")  # doctest: +SKIP
        """
        path, level = _split_level(str(spec))
        if not 0.0 <= strength <= 10.0:
            raise ValueError(f"strength must be between 0 and 10, got {strength}")
        if path in FILTERS:
            return replace(cls.of_filter(path, level, strength), views=views or 1)

        name, network = _network(path)
        denoiser = cls.of_network(name, network, device, strength)
        if level is not None:
            _, _, stated_level = str(spec).rpartition("@")
            run = partial(_denoise_at, network, level=level)
            denoiser = replace(denoiser, name=f"{name}, told {stated_level}", run=run)

        if not views:
            views = 2 if getattr(network, "light", False) else 1
        mixed = precision == "auto" and getattr(network, "mixed", False) and has_fast_bfloat16(denoiser.device)
        return replace(denoiser, views=views, mixed=mixed)

    @classmethod
    def of_filter(cls, spec: Spec, level: float | None = None, strength: float = 1.0) -> PictureDenoiser:
        """A classical filter of white noise on the three colours; without a level it is told scikit-image's."""
        denoiser = FILTERS.make(spec)

        def run(srgb: Tensor) -> Tensor:
            deviation = max(1e-4, strength * white_level(srgb) if level is None else level)
            planes = (srgb[0] / deviation).permute(1, 2, 0).contiguous().numpy()
            return torch.from_numpy(deviation * denoiser.denoise(planes)).permute(2, 0, 1)[None].float()

        return cls(spec_label(spec) if level is None else f"{spec_label(spec)}, told {255.0 * level:.3g}", run)

    @classmethod
    def of_network(cls, name: str, network: nn.Module, device: str = "cpu", strength: float = 1.0) -> PictureDenoiser:
        """A network of sRGB, which is moved to the device, in tiles; one that reads levels is told the picture's."""
        where = find_device(device)
        network = network.to(where, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]

        def run(srgb: Tensor) -> Tensor:
            if not getattr(network, "reads_variance", False):
                return denoisers.denoise_tiles(network, srgb, each=progress_by("tile"))
            if strength == 0.0:
                return srgb

            noise = estimate_level(network, srgb)
            denoised = _denoise_at(network, srgb, strength * noise.level)
            return torch.lerp(srgb, denoised, noise.share)

        return cls(name, run, where)

    @torch.inference_mode()
    def __call__(self, given: Noisy) -> Tensor:
        """sRGB ``(1, 3, H, W)`` denoised, on the CPU, cut to [0, 1]."""
        image = given.image.to(self.device)
        total = torch.zeros_like(image)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.mixed):
            for k in TURNS[self.views]:
                total += bayer.turn_back(self.run(bayer.turn(image, k).contiguous()), k)
        return (total / self.views).cpu().clamp_(0.0, 1.0)


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


def _network(spec: str) -> tuple[str, nn.Module]:
    """The name and the network of a file, which has three channels."""
    if not Path(spec).suffix and spec not in list_shipped():
        raise ValueError(
            f"{spec}: no such denoiser of pictures{suggest(spec, list_shipped())}; give one of {PICTURES}, or "
            "a .safetensors of rawaug run srgb or of FFDNet's authors"
        )
    file = read_network(find_denoiser(spec))
    if file.image != PictureDenoiser.takes:
        raise ValueError(f"{spec}: denoises RAW, not pictures; use {PICTURES}")

    return file.name, file.network


def _denoise_at(network: Any, srgb: Tensor, level: float) -> Tensor:
    """The picture denoised by a network that is told the deviation of its noise, 0 for unknown."""
    variance = srgb.new_full((1, 1, 1, 1), level**2).expand_as(srgb)
    return denoisers.denoise_tiles(network, srgb, variance, tile=_TILE, each=progress_by("tile")).float()
