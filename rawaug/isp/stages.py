r"""The stages of the ISP between sRGB and the mosaic, each with its inverse.

======  ===============  ==============================================  ==============================================
stage   name             reverse (sRGB to RAW)                           forward (RAW to sRGB)
======  ===============  ==============================================  ==============================================
f1      tone mapping     x1 = x + phi(x; theta_r)                        x = x1 + phi(x1; theta_f)
f2      gamma            x2 = max(x1, eps) ** gamma                      x1 = max(x2, eps) ** (1 / gamma)
f3      colour           x3 = C x2                                       x2 = pinv(C) x3
f4      white balance    x4 = h(x3; g), Brooks' highlight-safe 1/g       x3 = g x4
f5      lens shading     x5 = x4 G(p) A(x4)                              x4 = x5 / G(p) A'(x5)
f6      mosaic           y = one channel a site                          x5 = bilinear demosaic of y
======  ===============  ==============================================  ==============================================

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022, eqs. 3 to 9 and
figure 2; the highlight-safe inverse gains are eq. 4 of Brooks et al., "Unprocessing Images for Learned Raw Denoising",
CVPR 2019. f6 is in :mod:`rawaug.bayer`. Images are ``(B, 3, H, W)``, linear from x2 on, white at 1.

Everything but f6 is pointwise, given the parameters: a set of pixels ``(B, 3, 1, P)`` is as good as a picture.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

EPS = 1e-6
"""Floor under a power: keeps the gradient of x ** (1 / gamma) finite at black."""

_HALF_LEVEL = 0.5 / 255

HIGHLIGHT_KNEE = 0.9
"""Mean linear value above which Brooks' inverse gains bend towards 1."""


def as_float(srgb: Tensor) -> Tensor:
    """uint8 to float32 in [0, 1]; floats pass."""
    return srgb.float() / 255.0 if srgb.dtype == torch.uint8 else srgb


def display_referred(srgb: Tensor) -> Tensor:
    """:func:`as_float` of what is seen to be a picture: uint8, or float32 in [0, 1] within half an 8-bit level.

    Floats are looked at on the CPU only, elsewhere that would stall the device.

    Raises:
        ValueError: if it is not.
    """
    if srgb.layout != torch.strided:
        raise ValueError(f"a picture must be a dense tensor, got {srgb.layout}; call to_dense()")
    if srgb.dtype not in (torch.uint8, torch.float32):
        raise ValueError(f"a picture must be uint8 or float32 in [0, 1], got {srgb.dtype}; convert it first")
    require_display_range(srgb)
    return as_float(srgb)


def require_display_range(image: Tensor) -> None:
    """Raise ValueError if floats on the CPU leave [0, 1] by more than half an 8-bit level, or are NaN."""
    if image.device.type != "cpu" or image.dtype == torch.uint8 or not image.numel():
        return
    low, high = (float(value) for value in torch.aminmax(image.detach()))
    if not (low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL):
        if missing := int(image.isnan().sum()):
            raise ValueError(
                f"a float picture is in [0, 1], got NaN in {missing} of {image.numel()} values; correct it first"
            )
        raise ValueError(
            f"a float picture must be in [0, 1], got {low:.4g} to {high:.4g}; scale it, and normalise after rawaug"
        )


def scene_referred(raw: Tensor) -> Tensor:
    """RAW ``(B, 1, H, W)`` as float32, looked at on the CPU as :func:`display_referred` does.

    Raises:
        ValueError: if it has another shape or is no floating-point RAW, or a value is not finite.
    """
    if raw.ndim != 4 or raw.shape[1] != 1 or not raw.is_floating_point():
        raise ValueError(f"RAW must be a floating-point mosaic (B, 1, H, W), got {tuple(raw.shape)} {raw.dtype}")
    if raw.device.type == "cpu" and (damaged := int((~raw.detach().isfinite()).sum())):
        raise ValueError(f"RAW must be finite, got NaN or infinity in {damaged} of {raw.numel()} values")
    return raw.float()


class ToneNetwork(nn.Module):
    """f1: a residual 3-32-32-32-3 network of 1 x 1 convolutions with ReLU, piecewise linear in colour.

    It starts as the identity (last layer zero), so that an untrained ISP is a plain gamma camera.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        last = nn.Conv2d(width, 3, 1)
        nn.init.zeros_(last.weight)
        last.bias = nn.Parameter(torch.zeros(3))
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 1), nn.ReLU(), nn.Conv2d(width, width, 1), nn.ReLU(),
            nn.Conv2d(width, width, 1), nn.ReLU(), last,
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        return x + self.layers(x)

    @torch.no_grad()
    def start_from(self, toe: float) -> None:
        """Start as ``x1 = x + toe (1 - x)``: with the gamma stage that is the curve of sRGB and of BT.709.

        Three hidden features pass x through (it is not negative, so ReLU lets it), and the last layer adds the rest.
        """
        *hidden, last = (layer for layer in self.layers if isinstance(layer, nn.Conv2d))
        through = torch.eye(3)[..., None, None]
        for layer in hidden:
            layer.weight[:3] = 0.0
            layer.weight[:3, :3] = through
            layer.get_parameter("bias")[:3] = 0.0
        last.weight.zero_()
        last.weight[:, :3] = -toe * through
        last.get_parameter("bias").fill_(toe)


def gamma_expand(x: Tensor, gamma: Tensor | float) -> Tensor:
    """f2 reversed: display-referred to linear, ``max(x, eps) ** gamma``."""
    return x.clamp_min(EPS) ** gamma


def gamma_compress(x: Tensor, gamma: Tensor | float) -> Tensor:
    """f2: linear to display-referred, ``max(x, eps) ** (1 / gamma)``."""
    return x.clamp_min(EPS) ** (1.0 / gamma)


def correct_colour(x: Tensor, matrix: Tensor) -> Tensor:
    """f3 in either direction: ``(B, 3, H, W)`` times ``matrix`` ``(B, 3, 3)`` acting on colour columns."""
    return torch.einsum("bij,bjhw->bihw", matrix, x)


def inverse_gains(x: Tensor, gains: Tensor, knee: float | None = HIGHLIGHT_KNEE) -> Tensor:
    """f4 reversed: divide by ``gains`` ``(B, 3)``, sparing highlights.

    ``m = clip((mean(x) - knee) / (1 - knee), 0)^2`` and the factor is ``max(m + (1 - m) / g, 1 / g)``: where a gain is
    above 1, clipped sRGB comes back as saturated RAW, not as a coloured grey. ``knee=None`` divides plainly.
    """
    inverse = (1.0 / gains)[:, :, None, None]
    if knee is None:
        return x * inverse
    mask = ((x.mean(dim=1, keepdim=True) - knee) / (1.0 - knee)).clamp(0.0, 1.0) ** 2
    return x * torch.maximum(mask + (1.0 - mask) * inverse, inverse)


def apply_gains(x: Tensor, gains: Tensor) -> Tensor:
    """f4: multiply by ``gains`` ``(B, 3)``."""
    return x * gains[:, :, None, None]


def place_in_frame(
    height: int, width: int, offset: tuple[int, int] = (0, 0), frame: tuple[int, int] | None = None
) -> Tensor:
    """Coordinates ``(1, 2, H, W)`` (y, x) of a crop's pixels in its *full* frame.

    The centre of the frame is 0 and half its diagonal is 1, so that a round mask is round on any aspect ratio.

    Args:
        height, width: size of the crop.
        offset: (top, left) of the crop in the frame.
        frame: (height, width) of the frame; the crop itself by default.
    """
    full_height, full_width = frame or (height, width)
    half_diagonal = 0.5 * (full_height**2 + full_width**2) ** 0.5
    y = (torch.arange(height, dtype=torch.float32) + (offset[0] + 0.5 - full_height / 2)) / half_diagonal
    x = (torch.arange(width, dtype=torch.float32) + (offset[1] + 0.5 - full_width / 2)) / half_diagonal
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


def placed(x: Tensor, place: Tensor | None) -> Tensor:
    """``place``, or that of a full frame, in the type of the image ``x``."""
    return (place_in_frame(*x.shape[-2:]) if place is None else place).to(x)


class GaussianMask(nn.Module):
    r"""The sensor's fall-off ``G(p) = exp(-||L^T (p - mu)||^2 / 2)``, precision ``Sigma^-1 = L L^T``.

    Flat (1 everywhere) at first. ``p`` are the coordinates of :func:`place_in_frame`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(2))
        self.factor = nn.Parameter(torch.zeros(3))  # L11, L21, L22

    @property
    def precision(self) -> Tensor:
        """Sigma^-1, ``(2, 2)``, positive semi-definite by construction."""
        factor = torch.zeros(2, 2, device=self.factor.device, dtype=self.factor.dtype)
        rows, columns = torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1])
        factor = factor.index_put((rows, columns), self.factor)
        return factor @ factor.T

    def forward(self, place: Tensor) -> Tensor:
        """Mask ``(B, 1, H, W)`` in (0, 1] at coordinates ``(B, 2, H, W)``."""
        p = place - self.mean[None, :, None, None]
        return torch.exp(-0.5 * torch.einsum("bihw,ij,bjhw->bhw", p, self.precision, p))[:, None]

    @torch.no_grad()
    def set(self, mean: Tensor, precision: Tensor) -> None:
        """Start from a mean ``(2,)`` and a precision ``(2, 2)``; negative curvature is taken as none."""
        values, vectors = torch.linalg.eigh(precision)
        root = vectors @ torch.diag(values.clamp_min(0.0).sqrt())
        lower = torch.linalg.qr(root.T).R.T
        self.mean.copy_(mean)
        self.factor.copy_(torch.stack([lower[0, 0], lower[1, 0], lower[1, 1]]))


class AttentionMask(nn.Module):
    """A per-pixel gain ``A = 2 sigmoid(conv-ReLU-conv-ReLU-conv)`` in (0, 2), 1 at first.

    1 x 1 kernels, 32-32-1 features as in the paper's figure; the factor 2 lets the untrained mask be the identity.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        last = nn.Conv2d(width, 1, 1)
        nn.init.zeros_(last.weight)
        last.bias = nn.Parameter(torch.zeros(1))
        self.layers = nn.Sequential(
            nn.Conv2d(3, width, 1), nn.ReLU(), nn.Conv2d(width, width, 1), nn.ReLU(), last
        )  # fmt: skip

    def forward(self, x: Tensor) -> Tensor:
        """Mask ``(B, 1, H, W)`` of an image ``(B, 3, H, W)``."""
        return 2.0 * torch.sigmoid(self.layers(x))
