r"""The mean of two DRUNets: their errors differ in part, and the mean has less of each.

.. math:: d = (1 - w) f(y) + w g(y)

f and g are told the same level. Since the squared error is convex, that of the mean is never above the mean of the two
errors, and it is below both where the networks are nearly as good as each other. On noise that one of them was not
trained on, the mean lies between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Unpack

import torch
from torch import Tensor

from denoisers.drunet import DRUNet
from denoisers.network import DENOISERS, Denoiser, Shared
from rawaug.registry import require_between


@DENOISERS.register("MeanDRUNet")
class MeanDRUNet(Denoiser):
    """The mean of two DRUNets of developed pictures; a variance of 0 stands for a level that is not known.

    Args:
        width, patch: those of both networks, see :class:`denoisers.DRUNet`.
        blocks: blocks of the first network, one number for all scales or one for each.
        second_blocks: blocks of the second network, likewise.
        share: share of the second network in the mean, 0 to 1.
        channels, variance_map, deviation, domain, seed: see :class:`denoisers.Denoiser`.

    Example:
        >>> noisy = torch.rand(1, 3, 33, 50)
        >>> MeanDRUNet(width=4)(noisy, torch.zeros_like(noisy)).shape
        torch.Size([1, 3, 33, 50])
    """

    defaults: ClassVar[Shared] = {**Denoiser.defaults, "channels": 3}
    mixed: ClassVar[bool] = True
    light: ClassVar[bool] = True

    def __init__(
        self,
        width: int = 32,
        patch: int = 2,
        blocks: int | Sequence[int] = 1,
        second_blocks: int | Sequence[int] = 1,
        share: float = 0.5,
        **shared: Unpack[Shared],
    ) -> None:
        require_between("share", share, 0.0, 1.0)
        own: Shared = {**self.defaults, **shared}
        first = DRUNet(width, blocks=blocks, patch=patch, light=True, **own)
        second = DRUNet(width, blocks=second_blocks, patch=patch, light=True, **own)

        config = {"width": width, "patch": patch, "share": share}
        config["blocks"] = first.config["blocks"]
        config["second_blocks"] = second.config["blocks"]
        super().__init__(config, first.stride, **shared)

        self.share = share
        self.first = first
        self.second = second

    def forward(self, noisy: Tensor, variance: Tensor | None = None) -> Tensor:
        """Denoise ``(B, channels, H, W)``; the result has the same shape and is not clipped.

        ``variance`` and errors are those of :class:`denoisers.Denoiser`.
        """
        first = self.first(noisy, variance)
        second = self.second(noisy, variance)
        return torch.lerp(first, second.to(first), self.share)

    def residual(self, features: Tensor) -> Tensor:
        """Compute the mean of both corrections ``(B, channels, h, w)`` from features ``(B, inputs, h, w)``."""
        return torch.lerp(self.first.residual(features), self.second.residual(features), self.share)
