"""The norms by which a training compares denoised RAW with its target: l1, l2, rms and log_mse."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor, nn

from rawaug.registry import Registry

LOSSES = Registry("loss", "rawaug.losses", "rawaug.training")
"""This maps names to losses, classes whose instances are called as ``loss(denoised, target) -> scalar``."""

Criterion = Callable[[Tensor, Tensor], Tensor]
"""``criterion(denoised, target)`` maps two batches ``(B, 4, h, w)`` to a scalar."""

LOSSES.register("l1")(nn.L1Loss)
LOSSES.register("l2")(nn.MSELoss)


@LOSSES.register("rms")
class RootMeanSquare(nn.Module):
    """The mean over pictures of ``sqrt(mean (a - b)^2 + epsilon^2)``.

    Hard pictures do not outweigh the rest, as they do in l2. With ``weigh: relative``, the loss is the share of the
    noise that is left.
    """

    def __init__(self, epsilon: float = 1e-2) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Compare two batches ``(B, C, H, W)``: a scalar."""
        mean_square = (a - b).square().flatten(1).mean(1)
        return (mean_square + self.epsilon**2).sqrt().mean()


@LOSSES.register("log_mse")
class LogMeanSquare(nn.Module):
    """The mean over pictures of ``log(mean (a - b)^2 + epsilon) / 2``: their PSNR, except for its sign and unit.

    A flat picture, whose error is small, then counts as much as a picture full of texture, as it does in a table of
    PSNR. Source: the PSNR loss of Chen et al., "HINet", CVPR Workshops 2021.
    """

    def __init__(self, epsilon: float = 1e-4) -> None:
        super().__init__()
        self.epsilon = epsilon

    def forward(self, a: Tensor, b: Tensor) -> Tensor:
        """Compare two batches ``(B, C, H, W)``: a scalar."""
        mean_square = (a - b).square().flatten(1).mean(1)
        return 0.5 * (mean_square + self.epsilon).log().mean()
