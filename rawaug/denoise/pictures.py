"""What denoises developed pictures, sRGB ``(1, 3, H, W)`` in [0, 1], beside :class:`rawaug.RawDenoiser` for RAW."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn

import denoisers
from rawaug.denoise.denoiser import CPU, Noisy, counted
from rawaug.kernels.runtime import find_device


@dataclass(frozen=True)
class PictureDenoiser:
    """Anything that denoises pictures: ``run(srgb) -> srgb``, called on ``device``."""

    name: str
    run: Callable[[Tensor], Tensor]
    device: torch.device = CPU

    takes: ClassVar[str] = "srgb"

    @classmethod
    def of_network(cls, name: str, network: nn.Module, device: str = "cpu") -> PictureDenoiser:
        """A network of sRGB, which is moved to the device, in tiles."""
        where = find_device(device)
        network = network.to(where).eval()
        return cls(name, lambda srgb: denoisers.tiled(network, srgb, each=counted("tile")), where)

    @torch.inference_mode()
    def __call__(self, given: Noisy) -> Tensor:
        """sRGB ``(1, 3, H, W)`` denoised, on the CPU, cut to [0, 1]."""
        return self.run(given.image.to(self.device)).cpu().clamp(0.0, 1.0)
