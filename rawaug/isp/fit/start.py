"""The start of a fit in closed form: the curves of the standards, every frame's own colour, and the fall-off of light.

``x2 = (x + toe (1 - x))^gamma`` is the curve of sRGB, of BT.709 and of a plain gamma. An ISP with the stage ``curve``
bends a table instead, by the slopes of :class:`rawaug.isp.tone.ToneCurve`.

A frame's colour is ``M_f = diag(1 / g_f) C_f`` (sRGB to RAW), with the rows of ``C_f`` l1-normalised. Frames of one
camera share ``M_f`` divided by its row sums ``s_f``, and ``k_f = s_f wb_f``, which is 1 if the metadata are exact. Both
are drawn together by ``rho(d) = tau^2 d^2 / (tau^2 + d^2)`` (Geman and McClure), under which wrong metadata cost a
constant.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from rawaug.isp.config import ISPParams
from rawaug.isp.dictionary import l1_normalise
from rawaug.isp.fit.descent import reading_error
from rawaug.isp.fit.samples import FitFrames, PixelSamples
from rawaug.isp.functional import correct_colour
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import Gamma, LensShading, ToneMap
from rawaug.isp.tone import NODES, PIECES, ToneCurve

TIE = 1e-1
"""Weight of the deviations; the squared errors of a good fit are about 1e-6."""
TIE_RANGE = 0.05
"""The scale tau; deviations of frames that belong together are a few hundredths at most."""
FEWEST_PIXELS = 32
_CAMERA_RIDGE = 1e-3
"""Weight of a known camera's matrix in the start, as a share of the mean square of the colours."""


@torch.no_grad()
def set_curve(isp: DictionaryISP, gamma: float, toe: float) -> None:
    """Set the curve of an ISP to ``(x + toe (1 - x))^gamma``; a table is this minus its value at black."""
    tone, power, table = isp.stages.find(ToneMap), isp.stages.find(Gamma), isp.stages.find(ToneCurve)
    if tone is not None:
        tone.toe = torch.tensor(toe)
    if power is not None:
        power.reverse_gamma.fill_(gamma)
    if table is not None:
        code = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
        curve = (code + toe * (1.0 - code)) ** gamma
        table.dictionary.curves.copy_((curve - curve[0]) / (1.0 - curve[0]))
        table.slopes = torch.zeros(len(table.dictionary.curves), PIECES)


def shaded_light(isp: DictionaryISP, pixels: PixelSamples, curve: Callable[[Tensor], Tensor] | None = None) -> Tensor:
    """Compute x2 times the mask ``(F, 3, 1, P)``, which ``M_f`` takes to RAW; by default by the ISP's own curve."""
    x = (curve or isp.stages.linear)(pixels.srgb)
    shading = isp.stages.find(LensShading)
    if shading is not None:
        x = x * shading.mask(pixels.coordinates)
    return x


class FrameColour(NamedTuple):
    """The colour of each of F frames, refined together with the global parameters.

    Args:
        log_scale: ``(F, 3)``, logarithm of one over the gains.
        matrix: ``(F, 3, 3)``, whose rows are l1-normalised on use.
    """

    log_scale: Tensor
    matrix: Tensor

    @classmethod
    def from_product(cls, product: Tensor) -> FrameColour:
        """Split ``M`` ``(F, 3, 3)``."""
        return cls(product.abs().sum(2).log(), l1_normalise(product))

    def product(self) -> Tensor:
        """Compute ``M`` ``(F, 3, 3)``."""
        return self.log_scale.exp()[:, :, None] * l1_normalise(self.matrix)

    def params(self) -> ISPParams:
        """The settings of the frames in the ISP's form, without weights."""
        none = self.log_scale.new_empty(len(self.log_scale), 0)
        return ISPParams(none, none, l1_normalise(self.matrix), torch.exp(-self.log_scale), none)

    def pick(self, frames: Tensor | slice) -> FrameColour:
        """Take the colours of some frames, by an index ``(f,)`` or a slice."""
        return FrameColour(self.log_scale[frames], self.matrix[frames])

    def neutral(self, balance: Tensor) -> tuple[Tensor, Tensor]:
        """White-keeping matrices ``(F, 3, 3)`` and ``log k`` ``(F, 3)``, given the as-shot balance ``(F, 3)``."""
        product = self.product()
        rows = product.sum(2)
        return product / rows[:, :, None], rows.clamp_min(1e-3).log() + balance.log()


def tie(colour: FrameColour, frames: FitFrames) -> Tensor:
    """Compute the penalty that draws the colours of the frames of one camera together, a scalar."""
    matrix, neutral = colour.neutral(frames.as_shot)
    values = torch.cat([matrix.flatten(1), neutral], dim=1)

    centre = torch.empty_like(values)
    cameras = [shot.camera for shot in frames.shots]
    for camera in dict.fromkeys(cameras):
        group = torch.tensor([number for number, name in enumerate(cameras) if name == camera])
        centre[group] = values.detach()[group].quantile(0.5, dim=0)

    square = (values - centre) ** 2
    bounded: Tensor = TIE_RANGE**2 * square / (TIE_RANGE**2 + square)
    return TIE * bounded.sum(1).mean()


@torch.no_grad()
def fit_colours(linear: Tensor, samples: PixelSamples, known_matrix: Tensor | None = None) -> tuple[FrameColour, float]:
    """Find every frame's best colour by :func:`least_squares`; also return the error of the readings under it."""
    colour = FrameColour.from_product(least_squares(linear, samples, known_matrix))
    return colour, float(reading_error(correct_colour(linear, colour.product()), samples))


@torch.no_grad()
def least_squares(linear: Tensor, samples: PixelSamples, known_matrix: Tensor | None = None) -> Tensor:
    """Solve for ``M_f`` ``(F, 3, 3)``, which takes ``linear`` ``(F, 3, 1, P)`` to the readings, by least squares.

    If the colours of a frame do not determine it, ``known_matrix`` ``(F, 3, 3)`` does, from linear sRGB to
    white-balanced camera RGB: the ridge draws ``M_f`` to its rows, each times the gain that fits the readings best.
    """
    x = linear[:, :, 0].double()
    y, known = samples.target[:, :, 0].double(), samples.known[:, :, 0].double()
    if (known.sum(2) < FEWEST_PIXELS).any():
        frame = int((known.sum(2) < FEWEST_PIXELS).any(1).nonzero()[0])
        raise ValueError(f"frame {frame}: too few unclipped pixels to fit; use a better exposed frame or more pixels")

    moments = torch.einsum("fip,fjp,fcp->fcij", x, x, known)
    cross = torch.einsum("fip,fcp,fcp->fci", x, y, known)
    power = moments.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    if known_matrix is None:
        return torch.linalg.solve(moments + 1e-9 * power * torch.eye(3).double(), cross).float()

    rows = known_matrix.double()
    gains = (rows * cross).sum(2) / torch.einsum("fci,fcij,fcj->fc", rows, moments, rows)
    rows = gains[:, :, None] * rows
    ridge = _CAMERA_RIDGE * power * torch.eye(3).double()
    return torch.linalg.solve(moments + ridge, cross + _CAMERA_RIDGE * power[..., 0] * rows).float()


@torch.no_grad()
def fit_fall_off(linear: Tensor, samples: PixelSamples, product: Tensor) -> tuple[Tensor, Tensor]:
    """Fit the mean ``(2,)`` and precision ``(2, 2)`` of a Gaussian to log(reading / prediction).

    ``product`` ``(F, 3, 3)`` takes ``linear`` ``(F, 3, 1, P)`` to the prediction.
    """
    # A quadratic in the coordinates; an offset per frame and channel absorbs the effect of the mask on the matrices.
    predicted = correct_colour(linear, product)
    bright = (samples.known * (samples.target > 0.02) * (predicted > 0.02))[:, :, 0].double()
    ratio = (samples.target.clamp_min(1e-3) / predicted.clamp_min(1e-3)).log()[:, :, 0].double()
    y, x = samples.coordinates[:, :, 0].double().unbind(1)
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
