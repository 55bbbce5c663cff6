r"""PBRID, a small blind network of RAW: half-quadratic splitting, unrolled with the same weights.

The state s has seven channels of the mosaic's full size, which all begin as the noisy mosaic x; the first is the
estimate. One turn is

.. math:: s \leftarrow s + U([s, s_0 + \mu (x - s_0)])

with a U-Net U and a step :math:`\mu` in (0, 1) that a small head reads from x. There are ten turns. The code is this
project's own; layers are named as in the file of weights that its authors publish. That file has no licence, so it is
used for measuring only: it does not ship, and nothing is trained from it.

Source: https://github.com/hellopipu/PBRID, one of the entries of the RAW denoising challenge of Megvii, 2022.
"""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from denoisers.layers import pad_to_multiple

STATES = 7
"""The state has this many channels, the first of which is the estimate."""
TURNS = 10
"""The U-Net runs this many times."""
WIDTHS = (10, 14, 14, 16)
"""The U-Net's four scales have these numbers of features."""
BLOCKS = 4
"""Each scale has this many residual blocks going down, and as many going up."""
MULTIPLE = 64
"""The sides of a mosaic are padded to multiples of this: the head halves them six times."""


class PBRID(nn.Module):
    """Denoises packed RAW ``(B, 4, h, w)`` blind, with 97,207 parameters and 253 GMAC for each megapixel of mosaic.

    Example:
        >>> noisy = torch.rand(1, 4, 40, 50)
        >>> PBRID()(noisy).shape
        torch.Size([1, 4, 40, 50])
    """

    reads_variance: ClassVar[bool] = False
    stride: ClassVar[int] = MULTIPLE // 2

    def __init__(self) -> None:
        super().__init__()
        first = nn.Conv2d(1, 16, 8, stride=8)
        second = nn.Conv2d(16, 16, 8, stride=8, groups=16)
        last = nn.Conv2d(16, 1, 1)
        self.ee = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), nn.AdaptiveAvgPool2d(1), last, nn.Sigmoid())
        self.rec_blocks = _UNet()

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise packed RAW ``(B, 4, h, w)``, which is first clipped to [0, 1]; ``variance`` is not used."""
        height, width = noisy.shape[-2:]
        packed = pad_to_multiple(noisy.clamp(0.0, 1.0), self.stride)
        mosaic = F.pixel_shuffle(packed, 2)

        step = self.ee(mosaic)
        state = mosaic.expand(-1, STATES, -1, -1)

        for _ in range(TURNS):
            estimate = state[:, :1]
            fidelity = estimate + step * (mosaic - estimate)
            state = state + self.rec_blocks(torch.cat([state, fidelity], dim=1))

        denoised = F.pixel_unshuffle(state[:, :1], 2)
        return denoised[..., :height, :width]


class _Residual(nn.Module):
    """``x + conv(ReLU(conv(x)))``."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.res = nn.Sequential(_conv(width, width), nn.ReLU(), _conv(width, width))

    def forward(self, x: Tensor) -> Tensor:
        correction: Tensor = self.res(x)
        return x + correction


class _UNet(nn.Module):
    """Four scales of residual blocks without biases: eight channels in, the correction of the state out."""

    def __init__(self) -> None:
        super().__init__()
        self.m_head = _conv(STATES + 1, WIDTHS[0])

        for k, (wide, narrow) in enumerate(pairwise(WIDTHS), start=1):
            down = nn.Conv2d(wide, narrow, 2, stride=2, bias=False)
            up = nn.ConvTranspose2d(narrow, wide, 2, stride=2, bias=False)
            self.add_module(f"m_down{k}", nn.Sequential(*_residuals(wide), down))
            self.add_module(f"m_up{k}", nn.Sequential(up, *_residuals(wide)))

        self.m_body = nn.Sequential(*_residuals(WIDTHS[-1]))
        self.m_tail = _conv(WIDTHS[0], STATES)

    def forward(self, x: Tensor) -> Tensor:
        scales = [self.m_head(x)]
        for k in range(1, len(WIDTHS)):
            down = self.get_submodule(f"m_down{k}")
            scales.append(down(scales[-1]))

        x = self.m_body(scales[-1])
        for k in reversed(range(1, len(WIDTHS))):
            up = self.get_submodule(f"m_up{k}")
            x = up(x + scales[k])

        correction: Tensor = self.m_tail(x + scales[0])
        return correction


def _residuals(width: int) -> list[nn.Module]:
    return [_Residual(width) for _ in range(BLOCKS)]


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1, bias=False)
