r"""UPI as published: ``y = mosaic(clip(h(C s^-1(x)^2.2; g)))``.

``s^-1(x) = 1/2 - sin(asin(1 - 2x) / 3)`` undoes the tone curve ``s(x) = 3x^2 - 2x^3``. ``C`` is a random convex
combination of four cameras' XYZ-to-camera matrices, times sRGB-to-XYZ, rows divided by their sum. The gains ``g`` are a
digital one, 1 / N(0.8, 0.1), times a red one, U(1.9, 2.4), and a blue one, U(1.5, 1.9); ``h`` divides by them and
spares highlights. Nothing is learned. Domain: display-referred sRGB in [0, 1] to linear camera colour in [0, 1].

Source: Brooks et al., "Unprocessing Images for Learned Raw Denoising", CVPR 2019.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rawaug import bayer
from rawaug.isp import stages
from rawaug.isp.baselines.base import BaselineISP, checked_raw, checked_srgb
from rawaug.registry import BASELINES

GAMMA = 2.2
XYZ_TO_CAMERA = (
    ((1.0234, -0.2969, -0.2266), (-0.5625, 1.6328, -0.0469), (-0.0703, 0.2188, 0.6406)),
    ((0.4913, -0.0541, -0.0202), (-0.6130, 1.3513, 0.2906), (-0.1564, 0.2151, 0.7183)),
    ((0.8380, -0.2630, -0.0639), (-0.2887, 1.0725, 0.2496), (-0.0627, 0.1427, 0.5438)),
    ((0.6596, -0.2079, -0.0562), (-0.4782, 1.3016, 0.1933), (-0.0970, 0.1581, 0.5181)),
)
"""Of the four cameras of the Darmstadt Noise Dataset, as published with UPI."""
SRGB_TO_XYZ = (
    (0.4124564, 0.3575761, 0.1804375),
    (0.2126729, 0.7151522, 0.0721750),
    (0.0193339, 0.1191920, 0.9503041),
)
"""Linear sRGB (D65) to XYZ, IEC 61966-2-1."""
INVERSE_DIGITAL = (0.8, 0.1)
"""Mean and standard deviation of 1 / digital gain."""
RED, BLUE = (1.9, 2.4), (1.5, 1.9)


class UPIParams(NamedTuple):
    """One camera setting a picture; replays a pass.

    Args:
        matrix: ``(B, 3, 3)`` linear sRGB to camera, rows of sum 1.
        gains: ``(B, 3)`` digital gain times white balance, forward direction.
    """

    matrix: Tensor
    gains: Tensor


def smoothstep(x: Tensor) -> Tensor:
    """The tone curve ``3x^2 - 2x^3`` on [0, 1]; values beyond are clipped, where it would turn back."""
    x = x.clamp(0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def inverse_smoothstep(x: Tensor) -> Tensor:
    """``1/2 - sin(asin(1 - 2x) / 3)`` on [0, 1]."""
    return 0.5 - torch.sin(torch.asin(1.0 - 2.0 * x.clamp(0.0, 1.0)) / 3.0)


def camera_matrix(weights: Tensor) -> Tensor:
    """Weights ``(B, 4)`` of the cameras, of any positive sum, to linear sRGB-to-camera ``(B, 3, 3)``, rows of sum 1."""
    cameras = torch.tensor(XYZ_TO_CAMERA).to(weights) @ torch.tensor(SRGB_TO_XYZ).to(weights)
    matrix = torch.einsum("bn,nij->bij", weights, cameras)
    return matrix / matrix.sum(dim=2, keepdim=True)


class SmoothstepISP(BaselineISP):
    """UPI's stages with a matrix and gains from wherever; both passes are pure functions of picture and parameters."""

    @abstractmethod
    def default_params(self, batch: int) -> UPIParams:
        """The defaults of a pass."""

    def apply(self, srgb: Any, params: UPIParams | None = None) -> Any:
        """sRGB ``(B, 3, H, W)``, uint8 or float, to the mosaic ``(B, 1, H, W)`` with the given parameters.

        With a function alone it is ``nn.Module.apply``, which a surrounding module may call.
        """
        if params is None:
            return super().apply(srgb)
        return self.to_mosaic(unprocess_pixels(checked_srgb(srgb), params))

    def balanced(self, white_balance: tuple[float, float, float]) -> UPIParams:
        """The defaults with as-shot multipliers R, G, B in place of their own; the digital gain stays."""
        params = self.default_params(1)
        balance = torch.tensor(white_balance) / white_balance[1]
        return params._replace(gains=params.gains[:, 1:2].cpu() * balance)

    def make(self, srgb: Tensor, setting: UPIParams | None = None, place: Tensor | None = None) -> Tensor:
        return self.to_mosaic(unprocess_pixels(checked_srgb(srgb), setting or self.default_params(len(srgb))))

    def unprocess(self, srgb: Tensor) -> Tensor:
        return unprocess_pixels(srgb, self.default_params(len(srgb)))

    def render(self, raw: Tensor) -> Tensor:
        return self.render_with(raw, self.default_params(len(raw)))

    def render_with(self, raw: Tensor, params: UPIParams) -> Tensor:
        """The mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)`` in [0, 1] with the given parameters."""
        return render_pixels(bayer.demosaic(checked_raw(raw), self.cfa), params)


def unprocess_pixels(x: Tensor, params: UPIParams) -> Tensor:
    """sRGB to linear camera colour, both ``(B, 3, H, W)``; not clipped yet."""
    linear = stages.gamma_expand(inverse_smoothstep(x), GAMMA)
    return stages.inverse_gains(stages.correct_colour(linear, params.matrix.to(x)), params.gains.to(x))


def render_pixels(x: Tensor, params: UPIParams) -> Tensor:
    """Linear camera colour to sRGB, both ``(B, 3, H, W)``: the inverse of :func:`unprocess_pixels` below highlights."""
    balanced = stages.apply_gains(x, params.gains.to(x)).clamp(0.0, 1.0)
    linear = stages.correct_colour(balanced, torch.linalg.inv(params.matrix).to(x))
    return smoothstep(stages.gamma_compress(linear, GAMMA))


@BASELINES.register("upi")
class UPI(SmoothstepISP):
    """UPI as published: a random camera a picture, or the mean one.

    Example:
        >>> upi, srgb = UPI("GRBG"), torch.rand(2, 3, 8, 10)
        >>> params = upi.sample(2, torch.Generator().manual_seed(0))
        >>> torch.equal(upi.apply(srgb, params), upi.apply(srgb, params))
        True
        >>> upi.reverse(srgb).shape
        torch.Size([2, 1, 8, 10])
    """

    name = "upi"
    trainable = False

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        mosaic: Tensor = self.apply(srgb, self.sample(len(srgb), generator))
        return mosaic

    def default_params(self, batch: int) -> UPIParams:
        """The published distributions' means: the four cameras alike, digital gain 1 / 0.8, red 2.15, blue 1.7."""
        digital = 1.0 / INVERSE_DIGITAL[0]
        gains = torch.tensor([digital * sum(RED) / 2, digital, digital * sum(BLUE) / 2])
        return UPIParams(camera_matrix(torch.ones(1, 4)).expand(batch, 3, 3), gains.expand(batch, 3))

    def sample(self, batch: int, generator: torch.Generator) -> UPIParams:
        """Draw ``batch`` cameras from the published distributions."""
        weights = torch.rand(batch, 4, generator=generator, device=generator.device)
        normal = torch.randn(batch, generator=generator, device=generator.device)
        digital = 1.0 / (INVERSE_DIGITAL[0] + INVERSE_DIGITAL[1] * normal)
        uniform = torch.rand(2, batch, generator=generator, device=generator.device)
        red, blue = (low + (high - low) * u for (low, high), u in zip((RED, BLUE), uniform, strict=True))
        return UPIParams(camera_matrix(weights), torch.stack([digital * red, digital, digital * blue], dim=1))
