r"""What a JPEG loses, by a codec or as a transform of a batch of pictures on a GPU, with the same codes.

.. math:: \hat X = F^T \, \Big( q \cdot \Big\lfloor \frac{F X F^T}{8 q} \Big\rceil \Big) \, F

for each block X of 8 x 8 of luma and chroma, whose chroma may be the mean of two or four pixels, with the cosine
transform F and the steps q of the quality (ITU-T T.81, annex K; the scale of the qualities is that of libjpeg). libjpeg
works with integers: sums of products, and a rounding after each. In float64 these are exact in any order of summation,
so that rounding where libjpeg rounds gives its codes bit by bit, on any device and in any batch. Smaller chroma is
enlarged by libjpeg's triangular filter, which it uses from three samples of chroma a row on.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.kernels.runtime import move_together

_LUMA = (
    16, 11, 10, 16, 24, 40, 51, 61, 12, 12, 14, 19, 26, 58, 60, 55, 14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62, 18, 22, 37, 56, 68, 109, 103, 77, 24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101, 72, 92, 95, 98, 112, 100, 103, 99,
)  # fmt: skip
_CHROMA = (
    17, 18, 24, 47, 99, 99, 99, 99, 18, 21, 26, 66, 99, 99, 99, 99, 24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99, *(99,) * 32,
)  # fmt: skip
"""Steps of the quantisation at quality 50, row by row (ITU-T T.81, tables K.1 and K.2)."""

_ONE = 2**16
_TO_YCC = ((19595, 38470, 7471), (-11059, -21709, 32768), (32768, -27439, -5329))
_TO_RGB = ((0, 91881), (-22554, -46802), (116130, 0))
"""libjpeg's matrices, in units of 1/65536: R, G, B to Y, Cb, Cr, and Cb, Cr to what is added to Y."""

_STEPS = {"4:4:4": (1, 1), "4:2:2": (1, 2), "4:2:0": (2, 2)}
"""Rows and columns that share a sample of chroma."""


def compress_jpeg(srgb: Tensor, quality: Tensor, chroma_420: Tensor | None = None) -> Tensor:
    """Compress sRGB ``(B, 3, H, W)`` in [0, 1] as JPEGs of the qualities ``(B,)``, and decode them again.

    Chroma is 4:2:2. If ``chroma_420`` ``(B,)`` is given, it is 4:2:0 where that is true and 4:4:4 elsewhere. On CUDA
    the pictures stay on the device, as :func:`transform_jpeg` compresses them; elsewhere a codec is faster.
    """
    subsampling = ["4:2:2"] * len(srgb)
    if chroma_420 is not None:
        subsampling = ["4:2:0" if is_halved else "4:4:4" for is_halved in chroma_420.tolist()]
    if srgb.device.type == "cuda":
        return transform_jpeg((srgb * 255.0).round_(), quality.cpu(), subsampling).to(srgb).div_(255.0)

    from rawaug.io.pictures import recode_jpeg  # OpenImageIO

    pictures = (srgb * 255.0).round().to("cpu", torch.uint8)
    decoded = list(map(recode_jpeg, pictures, quality.tolist(), subsampling))
    return torch.stack(decoded).to(srgb) / 255.0


def transform_jpeg(codes: Tensor, quality: Tensor, subsampling: Sequence[str]) -> Tensor:
    """Compress pictures as libjpeg does, code by code.

    Args:
        codes: ``(B, 3, H, W)``, whole numbers from 0 to 255, sides even.
        quality: ``(B,)`` from 1 to 100, on the host.
        subsampling: of the chroma of each picture, ``4:4:4``, ``4:2:2`` or ``4:2:0``.

    Returns:
        float64 codes of the same shape.
    """
    height, width = codes.shape[-2:]
    rows, columns = torch.tensor([_STEPS[name] for name in subsampling])[:, :, None].unbind(1)
    i, j = torch.arange(-(-height // 16) * 16), torch.arange(-(-width // 16) * 16)

    # Four sites share a sample of chroma, some of them twice or all the same one. Whole blocks repeat the last sample
    # downwards and the last site to the right. Means are rounded down and up in turn.
    top, left = torch.minimum(i, -(-height // rows) - 1) * rows, j * columns
    shared_rows = torch.stack([top, top + rows - 1], dim=-1).clamp_max(height - 1)
    shared_columns = torch.stack([left, left + columns - 1], dim=-1).clamp_max(width - 1)
    mean_bias = torch.where(columns == 2, torch.where(rows == 2, 1 + j % 2, j % 2 * 2), 0) / 4

    # A pixel mixes the sample that it is in and those beside it, 3 to 1 along each axis.
    mixed_rows, mixed_columns = _nearest(i[:height], rows, height), _nearest(j[:width], columns, width)
    even, odd = torch.where(rows == 2, 8, 4), torch.where(rows == 2, 7, 8)
    mix_bias = torch.where(columns == 2, torch.where(j[:width] % 2 == 0, even, odd), 0) / 16

    numbers = torch.arange(len(codes))[:, None, None, None, None, None], torch.arange(2)[:, None, None, None, None]
    sites = shared_rows, shared_columns, mean_bias, mixed_rows, mixed_columns, mix_bias
    *moved, divisors, dct, inverse, mean, mix, to_ycc, to_rgb, n, colour = move_together(
        [*sites, 8 * _quantisation(quality), *_matrices(), *numbers], codes.device
    )
    shared_rows, shared_columns, mean_bias, mixed_rows, mixed_columns, mix_bias = moved

    def weigh(planes: Tensor, rows: Tensor, columns: Tensor, weights: Tensor, bias: Tensor) -> Tensor:
        """Weigh the four values at two rows ``(B, H, 2)`` and columns ``(B, W, 2)``, for each of ``(B, 2, H, W)``."""
        values = planes[n, colour, rows[:, None, :, None, :, None], columns[:, None, None, :, None, :]]
        return (values.flatten(-2) @ weights).add_(bias[:, None, None]).floor_()

    # Luma is less 128 here and chroma is about 0, as the transform takes them.
    ycc = torch.matmul(to_ycc, codes.double().flatten(2)).view(codes.shape)
    luma, chroma = ycc[:, :1].add(0.5 - 128).floor_(), ycc[:, 1:].add(0.5 - 1 / _ONE).floor_()
    luma = F.pad(luma, (0, len(j) - width, 0, len(i) - height), mode="replicate")
    chroma = weigh(chroma, shared_rows, shared_columns, mean, mean_bias)

    decoded = _quantise(torch.cat([luma, chroma], dim=1), divisors, dct, inverse)
    luma = decoded[:, :1, :height, :width]
    chroma = weigh(decoded[:, 1:], mixed_rows, mixed_columns, mix, mix_bias)
    offsets = torch.matmul(to_rgb, chroma.flatten(2)).add_(0.5).floor_().view(codes.shape)
    return offsets.add_(luma).add_(128).clamp_(0, 255)


def _nearest(pixels: Tensor, step: Tensor, size: int) -> Tensor:
    """Number the sample that each pixel is in and the one beside it ``(B, size, 2)``, for steps ``(B, 1)``."""
    sample = pixels // step
    beside = torch.minimum((sample + pixels % 2 * 2 - 1).clamp_min(0), -(-size // step) - 1)
    return torch.stack([sample, torch.where(step == 2, beside, sample)], dim=-1)


def _quantisation(quality: Tensor) -> Tensor:
    """The steps ``(B, 3, 1, 8, 1, 8)`` of Y, Cb and Cr at qualities ``(B,)``."""
    quality = quality.long()[:, None, None]
    scale = torch.where(quality < 50, 5000 // quality, 200 - 2 * quality)
    tables = torch.tensor([_LUMA, _CHROMA, _CHROMA])
    steps = ((tables * scale + 50) // 100).clamp(1, 255)
    return steps.double().reshape(-1, 3, 1, 8, 1, 8)


def _quantise(planes: Tensor, divisors: Tensor, dct: Tensor, inverse: Tensor) -> Tensor:
    """Quantise planes ``(B, 3, H, W)`` in blocks and decode them to [-128, 127], with libjpeg's roundings.

    ``dct`` and ``inverse`` ``(2, 8, 8)`` are for rows, then columns, and for columns, then rows.
    """
    height, width = planes.shape[-2:]
    rows, columns, blocks = (-1, 8), (-1, 8, width), (-1, 3, height // 8, 8, width // 8, 8)

    x = (planes.reshape(rows) @ dct[0]).add_(0.5).floor_()
    x = torch.matmul(dct[1], x.view(columns)).add_(0.5).floor_()

    levels = x.view(blocks) / divisors
    x = levels.abs().add_(0.5).floor_().copysign_(levels).mul_(divisors)

    x = torch.matmul(inverse[0], x.view(columns)).add_(0.5).floor_()
    x = (x.view(rows) @ inverse[1]).add_(0.5).floor_()
    return x.view(planes.shape).clamp_(-128, 127)


@lru_cache
def _matrices() -> tuple[Tensor, ...]:
    """Make the cosine transform and its inverse, each ``(2, 8, 8)``, weights of four samples, and matrices of colours.

    The transform is the linear part of libjpeg's fast one (Loeffler, Ligtenberg and Moschytz, ICASSP 1989), whose
    constants are rounded.
    """
    x = torch.eye(8, dtype=torch.float64)
    plus, minus = x[:4] + x.flip(0)[:4], x[:4] - x.flip(0)[:4]

    outer, inner = plus[0] + plus[3], plus[1] + plus[2]
    outer_change, inner_change = plus[0] - plus[3], plus[1] - plus[2]
    turned = 4433 * (outer_change + inner_change)
    even = [8192 * (outer + inner), turned + 6270 * outer_change, 8192 * (outer - inner), turned - 15137 * inner_change]

    a, b, c, d = minus.flip(0)
    both = 9633 * (a + c + b + d)
    ac, bd, ad, bc = both - 16069 * (a + c), both - 3196 * (b + d), -7373 * (a + d), -20995 * (b + c)
    odd = [12299 * d + ad + bd, 25172 * c + bc + ac, 16819 * b + bc + bd, 2446 * a + ad + ac]

    dct = torch.stack([row for pair in zip(even, odd, strict=True) for row in pair])
    forwards = torch.stack([dct.T / 2**11, dct / 2**15])
    backwards = torch.stack([dct.T / 2**14, dct / 2**18])  # of levels times eight steps
    mean, mix = torch.full((4,), 4), torch.tensor([9, 3, 3, 1])
    exact = [mean / 16, mix / 16, torch.tensor(_TO_YCC) / _ONE, torch.tensor(_TO_RGB) / _ONE]
    return forwards, backwards, *[matrix.double() for matrix in exact]
