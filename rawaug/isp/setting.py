"""One camera setting per picture, and the result of a pass under it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

from torch import Tensor


class ISPParams(NamedTuple):
    """One camera setting per picture; replays a pass. Leading dimension B everywhere.

    Args:
        colour_weights: ``(B, N)`` weights of the colour atoms.
        gain_weights: ``(B, M)`` weights of the gain atoms; ``(B, 0)`` where the gains follow from a light.
        matrix: ``(B, 3, 3)`` sRGB to camera.
        gains: ``(B, 3)`` white balance times digital gain, forward direction.
        tone_weights: ``(B, K)`` weights of the tone curves; ``(B, 0)`` where the tone is learned.
    """

    colour_weights: Tensor
    gain_weights: Tensor
    matrix: Tensor
    gains: Tensor
    tone_weights: Tensor


@dataclass
class ISPResult:
    """Result of a pass: ``raw`` ``(B, 1, H, W)`` or ``srgb`` ``(B, 3, H, W)``, the parameters; x1..x5 on request."""

    image: Tensor
    params: ISPParams
    intermediates: dict[str, Tensor] = field(default_factory=dict)

    @property
    def raw(self) -> Tensor:
        """The mosaic of a reverse pass."""
        return self.image

    @property
    def srgb(self) -> Tensor:
        """The picture of a forward pass."""
        return self.image
