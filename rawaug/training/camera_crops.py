r"""Training samples from sRGB pictures by published cameras: a crop, its zoom, a camera in a light, noise.

Pictures scaled down for the screen are sharper, pixel by pixel, than RAW of a lens and an optical low-pass filter. A
zoom z >= 1, drawn log-uniformly, shows ``crop / z`` pixels of the picture on the crop's side (bicubic), so that a
network meets edges of every width.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.sample import Sample
from rawaug.isp.camera_sampling import CameraSampler, unprocess
from rawaug.noise import NoiseModel


class CameraCrops:
    """Crops of random pictures as RAW of random cameras.

    Args:
        pictures: uint8 ``(3, H, W)``, each at least ``crop`` on a side.
        sampler: draws camera, light, tone and exposure.
        noise: drawn for every crop.
        crop: side in mosaic pixels, even.
        cfa: of the RAW.
        zoom: the largest zoom; 1 for none.
    """

    def __init__(
        self, pictures: Any, sampler: CameraSampler, noise: NoiseModel, crop: int, cfa: CFA, zoom: float = 1.0
    ) -> None:
        if not zoom >= 1.0:
            raise ValueError(f"zoom must be at least 1, got {zoom}")
        self.pictures, self.sampler, self.noise = pictures, sampler, noise
        self.crop, self.cfa, self.zoom = crop, cfa, zoom

    def draw(self, generator: torch.Generator) -> Sample:
        """One crop of a random picture."""
        picture = self.pictures[int(torch.randint(len(self.pictures), (), generator=generator))]
        patch = zoomed_crop(picture, self.crop, self.zoom, generator)
        view = int(torch.randint(bayer.N_VIEWS, (), generator=generator))
        patch = bayer.turn(patch, view).contiguous()[None]
        camera = unprocess(patch, self.sampler.sample(1, generator))
        clean = bayer.pack(bayer.mosaic(camera, self.cfa), self.cfa).clamp_(max=1.0)
        noisy, variance = self.noise.apply_with_variance(clean, self.noise.sample(1, generator))
        return Sample(noisy[0], clean[0], variance[0])


def zoomed_crop(picture: Tensor, crop: int, zoom: float, generator: torch.Generator) -> Tensor:
    """A random uint8 ``(3, crop, crop)`` of ``(3, H, W)``; half of the crops are not zoomed."""
    height, width = picture.shape[-2:]
    share, drawn = torch.rand(2, generator=generator).tolist()
    side = crop if share < 0.5 else math.ceil(crop * zoom**-drawn)
    top = int(torch.randint(height - side + 1, (), generator=generator))
    left = int(torch.randint(width - side + 1, (), generator=generator))
    patch = picture[:, top : top + side, left : left + side]
    if side == crop:
        return patch
    larger = F.interpolate(patch[None].float(), size=(crop, crop), mode="bicubic", align_corners=False)[0]
    return larger.round().clamp(0, 255).to(torch.uint8)
