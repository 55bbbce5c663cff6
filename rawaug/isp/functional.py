r"""The computations of an ISP's stages, as functions of images ``(B, 3, H, W)``; :mod:`rawaug.isp.stages` uses them.

Images are display-referred up to the gamma and linear after it, with white at 1. The coordinates of pixels are those of
the full frame that a crop is part of.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rawaug.isp.config import HIGHLIGHT_KNEE

EPS = 1e-6
"""Floor under a power, which keeps the gradient of x ** (1 / gamma) finite at black."""

_HALF_LEVEL = 0.5 / 255
"""Half an 8-bit level."""
_OVERSHOOT = 0.5
"""Upper bound of how far bicubic interpolation exceeds [0, 1]."""


def as_float(srgb: Tensor) -> Tensor:
    """Convert a picture ``(..., 3, H, W)`` from uint8 to float32 in [0, 1]; floats are returned as they are."""
    if srgb.dtype == torch.uint8:
        return srgb.float() / 255.0
    return srgb


def as_display_referred(srgb: Tensor) -> Tensor:
    """Convert a picture ``(B, 3, H, W)`` to float32; ValueError unless it is uint8, or float32 in [0, 1]."""
    if srgb.layout != torch.strided:
        raise ValueError(f"a picture must be a dense tensor, got {srgb.layout}; call to_dense()")
    if srgb.dtype not in (torch.uint8, torch.float32):
        raise ValueError(f"a picture must be uint8 or float32 in [0, 1], got {srgb.dtype}; convert it first")

    require_display_range(srgb)
    return as_float(srgb)


def as_mosaic(raw: Tensor) -> Tensor:
    """Convert RAW to float32; ValueError unless it is a floating-point mosaic ``(B, 1, H, W)`` of finite values."""
    if raw.ndim != 4 or raw.shape[1] != 1 or not raw.is_floating_point():
        raise ValueError(f"RAW must be a floating-point mosaic (B, 1, H, W), got {tuple(raw.shape)} {raw.dtype}")
    if raw.device.type == "cpu" and (damaged := int((~raw.detach().isfinite()).sum())):
        raise ValueError(f"RAW must be finite, got NaN or infinity in {damaged} of {raw.numel()} values")
    return raw.float()


def require_display_range(image: Tensor) -> None:
    """Raise ValueError if floats of an image of any shape leave [0, 1] by more than half an 8-bit level, or are NaN."""
    # This is checked on the CPU only; reading a value back would stall other devices.
    if image.device.type != "cpu" or image.dtype == torch.uint8 or not image.numel():
        return

    lowest, highest = torch.aminmax(image.detach())
    low, high = float(lowest), float(highest)
    if low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL:
        return

    missing = int(image.isnan().sum())
    if missing:
        raise ValueError(f"a float picture is in [0, 1], got NaN in {missing} of {image.numel()} values")

    advice = "normalise after rawaug, or divide by the largest value that it can have"
    if low >= -_OVERSHOOT and high <= 1.0 + _OVERSHOOT:
        advice = "call clamp(0, 1) if an interpolation has overshot, and normalise after rawaug"
    raise ValueError(f"a float picture must be in [0, 1], got {low:.4g} to {high:.4g}; {advice}")


def gamma_expand(x: Tensor, gamma: Tensor | float) -> Tensor:
    """Reverse f2: display-referred to linear ``(B, 3, H, W)``, ``max(x, eps) ** gamma``."""
    return x.clamp_min(EPS) ** gamma


def gamma_compress(x: Tensor, gamma: Tensor | float) -> Tensor:
    """Apply f2: linear to display-referred ``(B, 3, H, W)``, ``max(x, eps) ** (1 / gamma)``."""
    return x.clamp_min(EPS) ** (1.0 / gamma)


def correct_colour(x: Tensor, matrix: Tensor) -> Tensor:
    """Apply f3 in either direction: multiply the colours of ``x`` ``(B, 3, H, W)`` by ``matrix`` ``(B, 3, 3)``."""
    return torch.einsum("bij,bjhw->bihw", matrix, x)


def inverse_gains(x: Tensor, gains: Tensor, knee: float | None = HIGHLIGHT_KNEE) -> Tensor:
    """Reverse f4: divide ``x`` ``(B, 3, H, W)`` by ``gains`` ``(B, 3)``, sparing highlights unless ``knee`` is None.

    ``m = clip((mean(x) - knee) / (1 - knee), 0)^2`` and the factor is ``max(m + (1 - m) / g, 1 / g)``.
    """
    # If a gain is above 1, clipped sRGB must come back as saturated RAW, not as a coloured grey. If it is below 1,
    # bending its factor towards 1 would darken highlights, hence the maximum.
    inverse = (1.0 / gains)[:, :, None, None]
    if knee is None:
        return x * inverse

    mask = ((x.mean(dim=1, keepdim=True) - knee) / (1.0 - knee)).clamp(0.0, 1.0) ** 2
    return x * torch.maximum(mask + (1.0 - mask) * inverse, inverse)


def highlight_rise(floor: Tensor, knee: float | None) -> Tensor:
    """Compute the rise of a spared highlight where the mask is 1; ``floor`` ``(..., 3)`` is one over the gains."""
    if knee is None:
        return torch.zeros_like(floor)
    return (1.0 - floor).clamp_min(0.0)


def apply_gains(x: Tensor, gains: Tensor) -> Tensor:
    """Apply f4: multiply ``x`` ``(B, 3, H, W)`` by ``gains`` ``(B, 3)``."""
    return x * gains[:, :, None, None]


def frame_coordinates(
    height: int, width: int, offset: tuple[int, int] = (0, 0), frame: tuple[int, int] | None = None
) -> Tensor:
    """Compute coordinates (y, x) of a crop's pixels in its *full* frame, with centre 0 and half the diagonal 1.

    Args:
        height, width: sides of the crop.
        offset: its top and left in the frame.
        frame: height and width of the frame; by default the crop is the full frame.

    Returns:
        float32 ``(1, 2, H, W)``.
    """
    full_height, full_width = frame or (height, width)
    half_diagonal = 0.5 * (full_height**2 + full_width**2) ** 0.5

    y = (torch.arange(height, dtype=torch.float32) + (offset[0] + 0.5 - full_height / 2)) / half_diagonal
    x = (torch.arange(width, dtype=torch.float32) + (offset[1] + 0.5 - full_width / 2)) / half_diagonal
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


def coordinates_or_full(x: Tensor, coordinates: Tensor | None) -> Tensor:
    """Get ``coordinates`` ``(B, 2, H, W)``, or those of a full frame, in the type of ``x`` ``(B, 3, H, W)``."""
    if coordinates is None:
        coordinates = frame_coordinates(*x.shape[-2:])
    return coordinates.to(x)
