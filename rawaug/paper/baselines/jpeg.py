r"""A JPEG codec through which gradients pass, as in InvISP's training.

Colour is converted to YCbCr, chrominance is halved in size, and each plane goes through the discrete cosine transform
of its 8 x 8 blocks. The coefficients become whole multiples of the tables of ITU-T T.81, Annex K, scaled to the quality
as in libjpeg. The rounding is the Fourier series of the sawtooth,

.. math:: Q(c) = c - \frac{1}{\pi} \sum_{k=1}^{K} \frac{(-1)^{k+1}}{k} \sin(2 \pi k c), \qquad K = 10

through which gradients pass. Entropy coding loses nothing and is left out. Source: Xing et al., "Invertible Image
Signal Processing", CVPR 2021; ITU-T T.81.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

BLOCK = 8
TERMS = 10
"""This is K, the number of terms of the Fourier series."""
LUMINANCE = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
CHROMINANCE = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *((99,) * 8,) * 4,
)
"""These are the quantisation tables of Annex K."""


def fourier_round(x: Tensor) -> Tensor:
    """Round a tensor of any shape to nearly whole numbers, smoothly."""
    sawtooth = torch.zeros_like(x)
    for k in range(1, TERMS + 1):
        sign = 1.0 if k % 2 else -1.0
        sawtooth = sawtooth + sign / k * torch.sin(2.0 * math.pi * k * x)
    return x - sawtooth / math.pi


def quantisation_table(base: tuple[tuple[int, ...], ...], quality: int) -> Tensor:
    """Compute the table ``(8, 8)`` of a quality from 1 to 100, in units of 1 / 255."""
    percent = 5000.0 / quality if quality < 50 else 200.0 - 2.0 * quality
    table = ((torch.tensor(base) * percent + 50.0) / 100.0).floor()
    return table.clamp(1.0, 255.0) / 255.0


def cosines() -> Tensor:
    """Compute the orthonormal matrix ``(8, 8)`` of the discrete cosine transform, with a frequency in each row."""
    pixel = torch.arange(BLOCK).double()
    frequency = pixel[:, None]
    matrix = torch.cos(math.pi * (2.0 * pixel + 1.0) * frequency / (2 * BLOCK)) / 2.0
    matrix[0] /= math.sqrt(2.0)
    return matrix.float()


def quantise(plane: Tensor, table: Tensor) -> Tensor:
    """Code and decode a plane ``(B, C, H, W)``, zero at mid-grey, whose sides are multiples of 8."""
    transform = cosines().to(plane)
    table = table.to(plane)

    blocks = plane.unfold(2, BLOCK, BLOCK).unfold(3, BLOCK, BLOCK)  # (B, C, H/8, W/8, 8, 8)
    coefficients = transform @ blocks @ transform.T
    coefficients = fourier_round(coefficients / table) * table
    blocks = transform.T @ coefficients @ transform

    return blocks.transpose(3, 4).reshape(plane.shape)


def jpeg(srgb: Tensor, quality: int) -> Tensor:
    """Put sRGB ``(B, 3, H, W)`` in [0, 1] through JPEG of a ``quality`` from 1 to 100; the result is in [0, 1].

    Sides of any length are padded with their last values to multiples of 16, and cropped again.
    """
    from kornia.color import rgb_to_ycbcr, ycbcr_to_rgb

    if not 1 <= quality <= 100:
        raise ValueError(f"quality must be from 1 to 100, got {quality}")

    height, width = srgb.shape[-2:]
    padding = (0, -width % (2 * BLOCK), 0, -height % (2 * BLOCK))
    padded = F.pad(srgb, padding, mode="replicate")

    ycbcr = rgb_to_ycbcr(padded) - 0.5
    luma = quantise(ycbcr[:, :1], quantisation_table(LUMINANCE, quality))
    chroma = F.avg_pool2d(ycbcr[:, 1:], 2)
    chroma = quantise(chroma, quantisation_table(CHROMINANCE, quality))
    chroma = F.interpolate(chroma, scale_factor=2.0, mode="bilinear", align_corners=False)  # as libjpeg does

    decoded = ycbcr_to_rgb(torch.cat([luma, chroma], dim=1) + 0.5)
    return decoded[..., :height, :width].clamp(0.0, 1.0)
