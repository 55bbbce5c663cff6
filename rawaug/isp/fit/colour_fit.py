r"""Every frame's own colour: ``M_f = diag(1 / g_f) C_f`` (sRGB to RAW), rows of ``C_f`` l1-normalised.

What a camera's frames have in common shows once the as-shot white balance is taken out: ``M_f`` divided by its row
sums ``s_f``, and ``k_f = s_f wb_f``, which is 1 where the metadata are exact. Frames of one camera are drawn
together by ``rho(d) = tau^2 d^2 / (tau^2 + d^2)`` (Geman and McClure) on both: a deviation far beyond tau, such as
metadata that lie, costs a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rawaug.isp import stages
from rawaug.isp.dictionary import l1_normalised
from rawaug.isp.fit.samples import PixelSamples, Shot
from rawaug.isp.setting import ISPParams

TIE = 1e-1
"""Weight of the deviations; the squared errors of a good fit are near 1e-6."""
TIE_RANGE = 0.05
"""tau: deviations of frames that belong together are a few hundredths at most."""
FEWEST_PIXELS = 32


@dataclass
class FrameColour:
    """Per-frame colour, refined together with the global parameters."""

    log_scale: Tensor  # (F, 3), log of 1 / gains
    matrix: Tensor  # (F, 3, 3), rows l1-normalised on use

    @classmethod
    def from_product(cls, product: Tensor) -> FrameColour:
        """Split ``M`` ``(F, 3, 3)``."""
        return cls(product.abs().sum(2).log(), l1_normalised(product))

    def product(self) -> Tensor:
        """``M`` ``(F, 3, 3)``."""
        return self.log_scale.exp()[:, :, None] * l1_normalised(self.matrix)

    def params(self) -> ISPParams:
        """As the ISP takes them (without weights)."""
        none = self.log_scale.new_empty(len(self.log_scale), 0)
        return ISPParams(none, none, l1_normalised(self.matrix), torch.exp(-self.log_scale), none)

    def pick(self, frames: Tensor | slice) -> FrameColour:
        """The colours of some frames."""
        return FrameColour(self.log_scale[frames], self.matrix[frames])

    def neutral(self, balance: Tensor) -> tuple[Tensor, Tensor]:
        """White-keeping matrices ``(F, 3, 3)`` and ``log k`` ``(F, 3)``, given the as-shot balance ``(F, 3)``."""
        product = self.product()
        rows = product.sum(2)
        return product / rows[:, :, None], rows.clamp_min(1e-3).log() + balance.log()


class Tie:
    """What draws the frames of one camera together.

    Args:
        shots: the frames, in order.
    """

    def __init__(self, shots: Sequence[Shot]) -> None:
        cameras = [shot.camera for shot in shots]
        self.groups = [torch.tensor([c == camera for c in cameras]) for camera in dict.fromkeys(cameras)]
        self.balance = torch.tensor([shot.white_balance for shot in shots])

    def __call__(self, colour: FrameColour) -> Tensor:
        matrix, neutral = colour.neutral(self.balance)
        values = torch.cat([matrix.flatten(1), neutral], dim=1)
        centre = torch.empty_like(values)
        for group in self.groups:
            centre[group] = values.detach()[group].quantile(0.5, dim=0)
        square = (values - centre) ** 2
        bounded: Tensor = TIE_RANGE**2 * square / (TIE_RANGE**2 + square)
        return TIE * bounded.sum(1).mean()


@torch.no_grad()
def least_squares(linear: Tensor, samples: PixelSamples) -> Tensor:
    """``M_f`` ``(F, 3, 3)`` that takes ``linear`` ``(F, 3, 1, P)`` to the readings, from the normal equations.

    Raises:
        ValueError: if a frame has too few unclipped pixels.
    """
    x = linear[:, :, 0].double()
    y, known = samples.target[:, :, 0].double(), samples.known[:, :, 0].double()
    if (known.sum(2) < FEWEST_PIXELS).any():
        frame = int((known.sum(2) < FEWEST_PIXELS).any(1).nonzero()[0])
        raise ValueError(f"frame {frame}: too few unclipped pixels to fit; use a better exposed frame or more pixels")
    moments = torch.einsum("fip,fjp,fcp->fcij", x, x, known)
    cross = torch.einsum("fip,fcp,fcp->fci", x, y, known)
    ridge = 1e-9 * moments.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(3).double()
    return torch.linalg.solve(moments + ridge, cross).float()


@torch.no_grad()
def fall_off(linear: Tensor, samples: PixelSamples, product: Tensor) -> tuple[Tensor, Tensor]:
    """Mean ``(2,)`` and precision ``(2, 2)`` of the Gaussian that best explains log(reading / prediction).

    A quadratic in the place, with one offset a frame and channel that takes up what the mask does to the matrices.
    """
    predicted = stages.correct_colour(linear, product)
    bright = (samples.known * (samples.target > 0.02) * (predicted > 0.02))[:, :, 0].double()
    ratio = (samples.target.clamp_min(1e-3) / predicted.clamp_min(1e-3)).log()[:, :, 0].double()
    y, x = samples.place[:, :, 0].double().unbind(1)
    terms = torch.stack([y, x, y * y, y * x, x * x], dim=1)  # (F, 5, P)
    count = bright.sum(2, keepdim=True).clamp_min(1.0)
    ratio = ratio - (ratio * bright).sum(2, keepdim=True) / count
    means = torch.einsum("fkp,fcp->fkc", terms, bright) / count.transpose(1, 2)
    centred = (terms[:, :, None] - means[..., None]) * bright[:, None]  # (F, 5, 3, P)
    normal = torch.einsum("fkcp,flcp->kl", centred, centred) + 1e-6 * torch.eye(5).double()
    c = torch.linalg.solve(normal, torch.einsum("fkcp,fcp->k", centred, ratio))
    precision = -torch.stack([2 * c[2], c[3], c[3], 2 * c[4]]).reshape(2, 2)
    mean = torch.linalg.lstsq(precision, c[:2, None]).solution[:, 0]  # double to the end: sums vary in their last bit
    return mean.clamp(-0.5, 0.5).float(), precision.float()
