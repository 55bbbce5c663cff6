r"""The least that a reconstruction has to beat: LibRaw's documented curve undone, and one matrix.

.. math:: y = \mathrm{mosaic}(M c^{-1}(x)), \qquad c^{-1}(x) = x / 4.5 \text{ if } x < 0.081,
          \text{ else } ((x + 0.099) / 1.099)^{1 / 0.45}

c is the curve of ITU-R BT.709, by which LibRaw (and dcraw) develops unless told otherwise; a curve of another camera is
not learned. M has nine numbers and is solved for in closed form. Given the as-shot gains g of a frame, M is
:math:`\mathrm{diag}(\min g / g) C`, with one C for all frames: developers balance by the gains divided by the least, so
that white stays white.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.isp.fit.samples import FramePair, sample_pixels
from rawaug.paper.baselines.base import BASELINES, BaselineISP, Training
from rawaug.paper.baselines.upi import PIXELS, fit_product


def undo_bt709(x: Tensor) -> Tensor:
    """Undo the curve of ITU-R BT.709 on [0, 1]; tensors of any shape.

    Example:
        >>> undo_bt709(torch.tensor([0.045, 1.0]))
        tensor([0.0100, 1.0000])
    """
    return torch.where(x < 0.081, x / 4.5, ((x.clamp_min(0.0) + 0.099) / 1.099) ** (1.0 / 0.45))


def inverse_balance(white_balance: Sequence[float]) -> Tensor:
    """Compute what balanced colour is multiplied by to undo as-shot multipliers R, G, B: ``min g / g``, ``(3,)``."""
    gains = torch.tensor(white_balance)
    return gains.min() / gains


@BASELINES.register("curve-matrix")
class CurveMatrix(BaselineISP):
    """The inverse of BT.709's curve and one 3 x 3 matrix, blind or times the as-shot gains."""

    name = "curve-matrix"
    balanced: Tensor

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__(cfa)
        self.blind = nn.Parameter(torch.eye(3), requires_grad=False)
        self.register_buffer("balanced", torch.eye(3))

    def as_shot_setting(self, white_balance: tuple[float, float, float]) -> Tensor:
        """Make the matrix of a frame with these as-shot multipliers."""
        return inverse_balance(white_balance)[:, None] * self.balanced.cpu()

    def unprocess(self, srgb: Tensor, setting: Tensor | None = None) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape."""
        matrix = self.blind if setting is None else setting
        return torch.einsum("ij,bjhw->bihw", matrix.to(srgb), undo_bt709(srgb))

    def learn(self, pairs: Sequence[FramePair], training: Training) -> list[float]:
        """Fit both matrices to pairs of any CFA, registered or not."""
        pixels = sample_pixels(pairs, PIXELS, training.seed).pixels
        linear = undo_bt709(pixels.srgb)
        self.blind.copy_(fit_product(linear, pixels.target, pixels.known))

        factors = torch.stack([inverse_balance(pair.clean.white_balance) for pair in pairs])
        balanced = pixels.target / factors[:, :, None, None]
        self.balanced.copy_(fit_product(linear, balanced, pixels.known))
        return [math.nan]
