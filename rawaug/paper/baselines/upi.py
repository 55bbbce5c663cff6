"""UPI (Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019), as published and tuned to pairs.

As published, ``y = mosaic(clip(h(C s^-1(x)^2.2; g)))``. ``s^-1(x) = 1/2 - sin(asin(1 - 2x) / 3)`` undoes the tone curve
``s(x) = 3x^2 - 2x^3``. ``C`` is a random convex combination of four cameras' XYZ-to-camera matrices, times sRGB-to-XYZ,
rows divided by their sum. The gains ``g`` are a digital one, 1 / N(0.8, 0.1), times a red one, U(1.9, 2.4), and a blue
one, U(1.5, 1.9); ``h`` divides by them and spares highlights. Nothing is learned.

Tuned, as in the paper of the dictionary ISP, it has one matrix and one set of gains fitted to pairs: below the
highlights ``y = M s^-1(x)^2.2`` with ``M = diag(1 / g) C``, where the rows of ``C`` sum to 1. Second moments hold all
of a frame's mean squared error, ``MSE_f(M) = sum_c m_c A_fc m_c - 2 m_c b_fc + e_fc``. The fit minimises ``sum_f
log(MSE_f + eps)`` by weighted least squares with weights ``1 / (MSE_f + eps)``; it rises in no round.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.camera.lights import SRGB_TO_XYZ
from rawaug.isp import functional
from rawaug.isp.config import HIGHLIGHT_KNEE
from rawaug.isp.fit.samples import FramePair, sample_pixels
from rawaug.paper.baselines.base import BASELINES, BaselineISP, Training

GAMMA = 2.2
XYZ_TO_CAMERA = (
    ((1.0234, -0.2969, -0.2266), (-0.5625, 1.6328, -0.0469), (-0.0703, 0.2188, 0.6406)),
    ((0.4913, -0.0541, -0.0202), (-0.6130, 1.3513, 0.2906), (-0.1564, 0.2151, 0.7183)),
    ((0.8380, -0.2630, -0.0639), (-0.2887, 1.0725, 0.2496), (-0.0627, 0.1427, 0.5438)),
    ((0.6596, -0.2079, -0.0562), (-0.4782, 1.3016, 0.1933), (-0.0970, 0.1581, 0.5181)),
)
"""These are the matrices of the four cameras of the Darmstadt Noise Dataset, as published with UPI."""
INVERSE_DIGITAL = (0.8, 0.1)
"""1 / digital gain has this mean and standard deviation."""
RED, BLUE = (1.9, 2.4), (1.5, 1.9)
"""These are the lowest and the highest gain of a colour in units of green's."""


class UPIParams(NamedTuple):
    """Camera settings, one for each picture: matrices ``(B, 3, 3)`` from sRGB to the camera, and gains ``(B, 3)``."""

    matrix: Tensor
    gains: Tensor


def inverse_smoothstep(x: Tensor) -> Tensor:
    """Invert ``3x^2 - 2x^3`` on [0, 1] by ``1/2 - sin(asin(1 - 2x) / 3)``; tensors of any shape."""
    return 0.5 - torch.sin(torch.asin(1.0 - 2.0 * x.clamp(0.0, 1.0)) / 3.0)


def camera_matrix(weights: Tensor) -> Tensor:
    """Turn weights ``(B, 4)`` of the cameras, of any positive sum, into sRGB-to-camera ``(B, 3, 3)``, row sums 1."""
    cameras = torch.tensor(XYZ_TO_CAMERA).to(weights) @ SRGB_TO_XYZ.to(weights)
    matrix = torch.einsum("bn,nij->bij", weights, cameras)
    return matrix / matrix.sum(dim=2, keepdim=True)


class SmoothstepISP(BaselineISP):
    """UPI's stages. The setting of a pass is :class:`UPIParams`; subclasses say what it is if none is given."""

    @abstractmethod
    def default_params(self, batch: int) -> UPIParams:
        """Make the setting of ``batch`` pictures about which nothing is known."""

    def as_shot_setting(self, white_balance: tuple[float, float, float]) -> UPIParams:
        """Put as-shot multipliers R, G, B in place of the default ones; the digital gain stays."""
        params = self.default_params(1)
        balance = torch.tensor(white_balance) / white_balance[1]
        return params._replace(gains=params.gains[:, 1:2].cpu() * balance)

    def unprocess(self, srgb: Tensor, setting: UPIParams | None = None) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to linear camera colour of the same shape."""
        return unprocess_pixels(srgb, setting or self.default_params(len(srgb)))


def unprocess_pixels(x: Tensor, params: UPIParams) -> Tensor:
    """Convert sRGB to linear camera colour, both ``(B, 3, H, W)``; not clipped yet."""
    linear = functional.gamma_expand(inverse_smoothstep(x), GAMMA)
    return functional.inverse_gains(functional.correct_colour(linear, params.matrix.to(x)), params.gains.to(x))


@BASELINES.register("upi")
class UPI(SmoothstepISP):
    """UPI as published, with a random camera for each picture, or the mean one."""

    name = "upi"

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        """Convert sRGB ``(B, 3, H, W)`` to mosaics ``(B, 1, H, W)``, each by its own camera."""
        return self.reverse(srgb, self.sample(len(srgb), generator))

    def default_params(self, batch: int) -> UPIParams:
        """Take the published means: the four cameras alike, digital gain 1 / 0.8, red 2.15, blue 1.7."""
        digital = 1.0 / INVERSE_DIGITAL[0]
        gains = torch.tensor([digital * sum(RED) / 2, digital, digital * sum(BLUE) / 2])
        return UPIParams(camera_matrix(torch.ones(1, 4)).expand(batch, 3, 3), gains.expand(batch, 3))

    def sample(self, batch: int, generator: torch.Generator) -> UPIParams:
        """Draw ``batch`` cameras from the published distributions."""
        weights = torch.rand(batch, 4, generator=generator, device=generator.device)
        normal = torch.randn(batch, generator=generator, device=generator.device)
        digital = 1.0 / (INVERSE_DIGITAL[0] + INVERSE_DIGITAL[1] * normal)
        uniform = torch.rand(2, batch, generator=generator, device=generator.device)
        red = RED[0] + (RED[1] - RED[0]) * uniform[0]
        blue = BLUE[0] + (BLUE[1] - BLUE[0]) * uniform[1]
        return UPIParams(camera_matrix(weights), torch.stack([digital * red, digital, digital * blue], dim=1))


LOG_MSE_EPS = 1e-5
"""This is added to a frame's MSE under the logarithm, so that frames beyond 50 dB do not count."""
ROUNDS = 100
PIXELS = 32768
"""This many pixels are drawn from each frame."""


@BASELINES.register("upi-tuned")
class TunedUPI(SmoothstepISP):
    """UPI's stages with the matrix and gains of a fitted camera; both are the identity before the fit."""

    name = "upi-tuned"

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__(cfa)
        self.matrix = nn.Parameter(torch.eye(3), requires_grad=False)
        self.gains = nn.Parameter(torch.ones(3), requires_grad=False)

    def default_params(self, batch: int) -> UPIParams:
        """Return the fitted matrix and gains for each of ``batch`` pictures."""
        return UPIParams(self.matrix.expand(batch, 3, 3), self.gains.expand(batch, 3))

    def learn(self, pairs: Sequence[FramePair], training: Training) -> list[float]:
        """Fit to pairs of any CFA, registered or not; raise ValueError if the best matrix turns white black."""
        pixels = sample_pixels(pairs, PIXELS, training.seed).pixels
        linear = functional.gamma_expand(inverse_smoothstep(pixels.srgb), GAMMA)
        product = fit_product(linear, pixels.target, pixels.known)
        sums = product.sum(1)
        if (sums <= 0.0).any():
            raise ValueError("tuned UPI: the pairs fit only with negative gains; give frames with more colours")
        self.gains.copy_(1.0 / sums)
        self.matrix.copy_(product / sums[:, None])
        return [math.nan]


def fit_product(linear: Tensor, target: Tensor, known: Tensor) -> Tensor:
    """Compute the matrix ``(3, 3)`` of the least sum of the logarithms of the frames' errors.

    Only pixels below the highlights count, where the inverse gains are plain divisions.

    Args:
        linear: linear colour, ``(F, 3, 1, P)``.
        target, known: as in :class:`rawaug.isp.fit.samples.PixelSamples`.

    Raises:
        ValueError: if a frame has fewer than 32 pixels below the highlights.
    """
    below = known * (linear.mean(1, keepdim=True) < HIGHLIGHT_KNEE)
    x = linear[:, :, 0].double()
    y = target[:, :, 0].double()
    weight = below[:, :, 0].double()
    if (weight.sum(2) < 32).any():
        raise ValueError("a frame has too few pixels below the highlights; use better exposed frames")

    # Second moments of each frame: of the inputs, by output channel; of input and output; of the output.
    weight = weight / weight.sum((1, 2), keepdim=True)
    inputs = torch.einsum("fip,fjp,fcp->fcij", x, x, weight)
    cross = torch.einsum("fip,fcp,fcp->fci", x, y, weight)
    energy = (weight * y * y).sum((1, 2))

    # Least squares, with frames weighted by one over their error, which makes the sum one of logarithms.
    frames = torch.ones(len(energy)).double()
    for iteration in range(ROUNDS + 1):
        a, b = torch.einsum("f,fcij->cij", frames, inputs), torch.einsum("f,fci->ci", frames, cross)
        ridge = 1e-9 * a.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None] * torch.eye(3).to(a)
        product = torch.linalg.solve(a + ridge, b)
        if iteration == ROUNDS:
            break

        square = torch.einsum("ci,fcij,cj->f", product, inputs, product)
        error = (square - 2.0 * (product * cross).sum((1, 2)) + energy).clamp_min(0.0)
        frames = 1.0 / (error + LOG_MSE_EPS)
    return product
