r"""The stages of the ISP between sRGB and the mosaic, each with its inverse, and how each enters the baked pass.

======  ===============  ==============================================  ==============================================
stage   name             reverse (sRGB to RAW)                           forward (RAW to sRGB)
======  ===============  ==============================================  ==============================================
f1      tone mapping     x1 = x + phi(x; theta_r)                        x = x1 + phi(x1; theta_f)
f2      gamma            x2 = max(x1, eps) ** gamma                      x1 = max(x2, eps) ** (1 / gamma)
f3      colour           x3 = C x2                                       x2 = pinv(C) x3
f4      white balance    x4 = h(x3; g), Brooks' highlight-safe 1/g       x3 = g x4
f5      lens shading     x5 = x4 G(p) A(x4, p)                           x4 = x5 / G(p) A'(x5, p)
f6      mosaic           y = one channel a site                          x5 = bilinear demosaic of y
======  ===============  ==============================================  ==============================================

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022, eqs. 3 to 9 and
figure 2; the highlight-safe inverse gains are eq. 4 of Brooks et al., "Unprocessing Images for Learned Raw Denoising",
CVPR 2019. f6 is in :mod:`rawaug.bayer`; :class:`rawaug.isp.tone.ToneCurve` can replace f1 and f2. Images are
``(B, 3, H, W)``, linear from x2 on, white at 1.

Everything but f6 is pointwise, given the parameters: a set of pixels ``(B, 3, 1, P)`` is as good as a picture.

The baked pass (:mod:`rawaug.isp.fast`) is ``y_c = sum_k C[c, k] T_k(x) max(m + (1 - m) / g_c, 1 / g_c) G(p) A(x4)``.
What a stage does to every picture alike goes into the tables ``T`` and ``A`` once (:meth:`Stage.bake`); what depends
on a picture's setting or place goes into ``C``, ``1 / g`` and ``G`` for each batch (:meth:`Stage.adjust`), and what no
table holds of the place multiplies the RAW (:meth:`Stage.place_gain`).

A new kind of stage is a class with ``@STAGES.register(name)`` above it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from rawaug.isp.config import HIGHLIGHT_KNEE, ISPConfig, ISPParams
from rawaug.kernels.reference import mask_frame
from rawaug.registry import Registry

STAGES = Registry("stage", "rawaug.stages", "rawaug.isp")
"""The stages of an ISP by name: subclasses of :class:`Stage`."""

EPS = 1e-6
"""Floor under a power: keeps the gradient of x ** (1 / gamma) finite at black."""

WIDTH = 32
"""Number of features of the networks."""
LEAST_FACTOR = 0.02
"""Initial entries of L of a Gaussian mask."""
_HALF_LEVEL = 0.5 / 255


def as_float(srgb: Tensor) -> Tensor:
    """Convert a picture ``(..., 3, H, W)`` from uint8 to float32 in [0, 1]; floats pass as they are."""
    if srgb.dtype == torch.uint8:
        return srgb.float() / 255.0
    return srgb


def as_display_referred(srgb: Tensor) -> Tensor:
    """Convert a picture ``(B, 3, H, W)`` to float32; ValueError unless it is uint8, or float32 in [0, 1]."""
    if srgb.layout != torch.strided:
        raise ValueError(f"a picture must be a dense tensor, got {srgb.layout}; call to_dense()")
    if srgb.dtype not in (torch.uint8, torch.float32):
        raise ValueError(f"a picture must be uint8 or float32 in [0, 1], got {srgb.dtype}; convert it first")

    require_display_range(srgb)
    return as_float(srgb)


_OVERSHOOT = 0.5
"""Bicubic interpolation goes beyond [0, 1] by less."""


def require_display_range(image: Tensor) -> None:
    """Raise ValueError if floats of an image of any shape leave [0, 1] by more than half an 8-bit level, or are NaN."""
    # Only on the CPU: elsewhere reading a value back would stall the device.
    if image.device.type != "cpu" or image.dtype == torch.uint8 or not image.numel():
        return

    lowest, highest = torch.aminmax(image.detach())
    low, high = float(lowest), float(highest)
    if low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL:
        return

    missing = int(image.isnan().sum())
    if missing:
        raise ValueError(f"a float picture is in [0, 1], got NaN in {missing} of {image.numel()} values")

    advice = "normalise after rawaug, or divide by the largest value that it can have"
    if low >= -_OVERSHOOT and high <= 1.0 + _OVERSHOOT:
        advice = "call clamp(0, 1) if an interpolation has overshot, and normalise after rawaug"
    raise ValueError(f"a float picture must be in [0, 1], got {low:.4g} to {high:.4g}; {advice}")


def _pixelwise(hidden: int, outputs: int, inputs: int = 3) -> nn.Sequential:
    """Stack ``hidden`` 1 x 1 convolutions to 32 features with ReLU, and one that is zero until it is trained."""
    last = nn.Conv2d(WIDTH, outputs, 1)
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(torch.zeros(outputs))

    layers: list[nn.Module] = []
    channels = inputs
    for _ in range(hidden):
        layers += [nn.Conv2d(channels, WIDTH, 1), nn.ReLU()]
        channels = WIDTH
    return nn.Sequential(*layers, last)


class ToneNetwork(nn.Module):
    """The tone curve f1 as a residual 3-32-32-32-3 network of 1 x 1 convolutions with ReLU; the identity at first."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = _pixelwise(hidden=3, outputs=3)

    def forward(self, x: Tensor) -> Tensor:
        """Map colours ``(B, 3, H, W)`` to colours of the same shape, each pixel by itself."""
        return x + self.layers(x)

    @torch.no_grad()
    def start_from(self, toe: float) -> None:
        """Start as ``x1 = x + toe (1 - x)``: with the gamma stage that is the curve of sRGB and of BT.709."""
        # Three hidden features pass x on (it is not negative, so ReLU keeps it), and the last layer adds the rest.
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
    """f2 reversed: display-referred to linear ``(B, 3, H, W)``, ``max(x, eps) ** gamma``."""
    return x.clamp_min(EPS) ** gamma


def gamma_compress(x: Tensor, gamma: Tensor | float) -> Tensor:
    """f2: linear to display-referred ``(B, 3, H, W)``, ``max(x, eps) ** (1 / gamma)``."""
    return x.clamp_min(EPS) ** (1.0 / gamma)


def correct_colour(x: Tensor, matrix: Tensor) -> Tensor:
    """f3 in either direction: multiply the colours of ``x`` ``(B, 3, H, W)`` by ``matrix`` ``(B, 3, 3)``."""
    return torch.einsum("bij,bjhw->bihw", matrix, x)


def inverse_gains(x: Tensor, gains: Tensor, knee: float | None = HIGHLIGHT_KNEE) -> Tensor:
    """f4 reversed: divide ``x`` ``(B, 3, H, W)`` by ``gains`` ``(B, 3)``, sparing highlights; None divides plainly.

    ``m = clip((mean(x) - knee) / (1 - knee), 0)^2`` and the factor is ``max(m + (1 - m) / g, 1 / g)``.
    """
    # Where a gain is above 1, clipped sRGB must come back as saturated RAW, not as a coloured grey; where it is below
    # 1, bending its factor towards 1 would darken highlights, hence the maximum.
    inverse = (1.0 / gains)[:, :, None, None]
    if knee is None:
        return x * inverse

    mask = ((x.mean(dim=1, keepdim=True) - knee) / (1.0 - knee)).clamp(0.0, 1.0) ** 2
    return x * torch.maximum(mask + (1.0 - mask) * inverse, inverse)


def highlight_rise(floor: Tensor, knee: float | None) -> Tensor:
    """How much brighter a spared highlight is where the mask is 1; ``floor`` ``(..., 3)`` is one over the gains."""
    if knee is None:
        return torch.zeros_like(floor)
    return (1.0 - floor).clamp_min(0.0)


def apply_gains(x: Tensor, gains: Tensor) -> Tensor:
    """f4: multiply ``x`` ``(B, 3, H, W)`` by ``gains`` ``(B, 3)``."""
    return x * gains[:, :, None, None]


def frame_coordinates(
    height: int, width: int, offset: tuple[int, int] = (0, 0), frame: tuple[int, int] | None = None
) -> Tensor:
    """Coordinates (y, x) of a crop's pixels in its *full* frame, whose centre is 0 and half of whose diagonal is 1.

    Args:
        height, width: sides of the crop.
        offset: its top and left in the frame.
        frame: height and width of the frame; the crop is one by default.

    Returns:
        float32 ``(1, 2, H, W)``.
    """
    full_height, full_width = frame or (height, width)
    half_diagonal = 0.5 * (full_height**2 + full_width**2) ** 0.5

    y = (torch.arange(height, dtype=torch.float32) + (offset[0] + 0.5 - full_height / 2)) / half_diagonal
    x = (torch.arange(width, dtype=torch.float32) + (offset[1] + 0.5 - full_width / 2)) / half_diagonal
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


def coordinates_or_full(x: Tensor, coordinates: Tensor | None) -> Tensor:
    """``coordinates`` ``(B, 2, H, W)``, or those of a full frame, in the type of the image ``x`` ``(B, 3, H, W)``."""
    if coordinates is None:
        coordinates = frame_coordinates(*x.shape[-2:])
    return coordinates.to(x)


class GaussianMask(nn.Module):
    """The sensor's fall-off ``G(p) = exp(-||L^T (p - mu)||^2 / 2)``, precision ``Sigma^-1 = L L^T``.

    ``p`` are the coordinates of :func:`frame_coordinates`. A flat mask, L = 0, is a saddle, which gradient descent
    never leaves; the mask starts with :data:`LEAST_FACTOR` instead, which takes 0.02 % of the light from the corners.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(2))
        self.factor = nn.Parameter(torch.tensor([LEAST_FACTOR, 0.0, LEAST_FACTOR]))  # L11, L21, L22

    @property
    def precision(self) -> Tensor:
        """Sigma^-1, ``(2, 2)``, positive semi-definite by construction."""
        factor = torch.zeros(2, 2, device=self.factor.device, dtype=self.factor.dtype)
        rows, columns = torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1])
        factor = factor.index_put((rows, columns), self.factor)
        return factor @ factor.T

    def forward(self, coordinates: Tensor) -> Tensor:
        """Compute the mask ``(B, 1, H, W)``, in (0, 1], at coordinates ``(B, 2, H, W)``."""
        p = coordinates - self.mean[None, :, None, None]
        square = torch.einsum("bihw,ij,bjhw->bhw", p, self.precision, p)
        return torch.exp(-0.5 * square)[:, None]

    @torch.no_grad()
    def set(self, mean: Tensor, precision: Tensor) -> None:
        """Set the mean ``(2,)`` and the precision ``(2, 2)``; less curvature than at the start is taken as that."""
        values, vectors = torch.linalg.eigh(precision)
        root = vectors @ torch.diag(values.clamp_min(LEAST_FACTOR**2).sqrt())
        lower = torch.linalg.qr(root.T).R.T

        self.mean.copy_(mean)
        self.factor.copy_(torch.stack([lower[0, 0], lower[1, 0], lower[1, 1]]))


class AttentionMask(nn.Module):
    """A gain for each pixel by its colour and by its place, ``A = 2 sigmoid(a(x)) 2 sigmoid(b(p))``, in (0, 4).

    Both networks are zero at first, so that the mask is the identity, for which the paper's sigmoid has no factor of 2.
    Colour and place are factors of their own, so that the baked pass can look the first one up in a table.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = _pixelwise(hidden=2, outputs=1)
        self.place_layers = _pixelwise(hidden=2, outputs=1, inputs=2)

    def of_colour(self, x: Tensor) -> Tensor:
        """Compute the gains ``(B, 1, H, W)`` by the colours of an image ``(B, 3, H, W)``."""
        return 2.0 * torch.sigmoid(self.layers(x))

    def of_place(self, coordinates: Tensor) -> Tensor:
        """Compute the gains ``(B, 1, H, W)`` by the coordinates ``(B, 2, H, W)`` of the pixels in the full frame."""
        return 2.0 * torch.sigmoid(self.place_layers(coordinates))

    def forward(self, x: Tensor, coordinates: Tensor) -> Tensor:
        """Compute the mask ``(B, 1, H, W)`` of an image ``(B, 3, H, W)`` at coordinates ``(1 or B, 2, H, W)``."""
        return self.of_colour(x) * self.of_place(coordinates)


class Tables(NamedTuple):
    """The tables of the baked pass, at the nodes of an N x N x N cube.

    Args:
        cube: the colours of the nodes, ``(1, 3, N, N * N)``.
        x2: what the stages up to x2 make of them, of the same shape.
        attention: the attention mask there, ``(1, 1, N, N * N)``, if there is one.
    """

    cube: Tensor
    x2: Tensor
    attention: Tensor | None = None


class BatchParams(NamedTuple):
    """The numbers that the baked pass takes from the settings of a batch of B pictures.

    Args:
        matrix: ``(B, 3, 3)``, x2 to x3.
        floor: ``(B, 1, 3)``, one over the gains.
        frame: ``(B, 6)``, where the picture lies; see :class:`rawaug.kernels.reference.Camera`.
        curves: ``(B, T)``, inverse tone curves, or ``(B, 0)`` where the tone is in the tables.
        shading: ``(3,)``, exponents of the mask, or ``(0,)`` without one.
    """

    matrix: Tensor
    floor: Tensor
    frame: Tensor
    curves: Tensor
    shading: Tensor


class Stage(nn.Module, ABC):
    """A stage of the ISP; images are ``(B, 3, H, W)``.

    Parameters whose names start with ``forward_`` belong to the forward pass, all others to the reverse pass.
    """

    name: ClassVar[str]
    """The name of the stage in ``ISPConfig.stages`` and in files."""
    makes: ClassVar[int]
    """k of ``x_k``, the image that the reverse pass makes: the stage's position in the usual order."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.config = config

    @abstractmethod
    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute ``x_k`` from ``x_(k-1)``, both ``(B, 3, H, W)``.

        ``params`` are the settings of the pictures, which stages up to x2 do without, and ``coordinates``
        ``(1 or B, 2, H, W)`` those of the pixels in the full frame.
        """

    @abstractmethod
    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute ``x_(k-1)`` from ``x_k``, both ``(B, 3, H, W)``; arguments as in :meth:`reverse`."""

    def bake(self, tables: Tables) -> Tables:
        """Put what this stage does to every picture alike into the tables of the reverse pass."""
        if self.makes > 2:
            return tables
        return tables._replace(x2=self.reverse(tables.x2, None))

    def bake_forward(self, tables: Tables) -> Tables:
        """Put what this stage does to every picture alike into the tables of the forward pass, whose x2 is sRGB."""
        if self.makes > 2:
            return tables
        return tables._replace(x2=self.forward(tables.x2, None))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put what this stage does to these pictures into ``batch``.

        Args:
            batch: what the stages before this one have put there.
            params: the settings of the pictures.
            place: where each lies in its frame, ``(B, 4 to 6)``: top, left, height and width of the frame, and, if the
                crop was turned or enlarged, its view and how many rows of the frame it has; None for full frames.
            size: height and width of the pictures.
        """
        return batch

    def describe(self) -> str:
        """Describe the stage's parameters in one line; the line is empty if the settings hold them all."""
        return ""

    @property
    def has_place_gain(self) -> bool:
        """Whether this stage multiplies RAW by what :meth:`place_gain` computes."""
        return False

    def place_gain(self, coordinates: Tensor, forward: bool) -> Tensor:
        """Compute what this stage multiplies RAW by besides, by place alone, which no table holds.

        Args:
            coordinates: ``(B, 2, H, W)`` of pixels in the full frame.
            forward: whether it is the forward pass, which multiplies RAW before all else, or the reverse pass, which
                does so after all else.

        Returns:
            ``(B, 1, H, W)``, ones by default.
        """
        return torch.ones_like(coordinates[:, :1])

    # -- fitting ----------------------------------------------------------------------------------------------------

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The few numbers, by name, that :meth:`coarse` depends on."""
        return {}

    def coarse(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute the reverse pass ``(B, 3, H, W)`` in a few numbers, from which a fit starts.

        A stage whose parameters each frame has for itself does nothing here.
        """
        return x

    def start_coarse(self, gamma: float, toe: float) -> None:
        """Start as the curve ``(x + toe (1 - x))^gamma``."""

    def start_fine(self) -> None:
        """Start :meth:`reverse` from :meth:`coarse`."""

    def start_forward(self) -> None:
        """Start :meth:`forward` from :meth:`reverse`."""

    def parameters_of(self, forward: bool) -> dict[str, Tensor]:
        """The parameters that a fit of the forward or of the reverse pass changes, as ``stage.name``."""
        parameters: dict[str, Tensor] = {}
        for key, parameter in self.named_parameters():
            if key.startswith("forward_") == forward:
                parameters[f"{self.name}.{key}"] = parameter
        return parameters


def node_colours(nodes: int) -> Tensor:
    """The colours at the nodes of a table, float32 ``(1, 3, N, N * N)``; the axes of the cube are B, G, R."""
    axis = torch.linspace(0.0, 1.0, nodes, dtype=torch.float32)
    cube = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"))
    return cube.flip(0).reshape(1, 3, nodes, nodes**2)


@STAGES.register("tone")
class ToneMap(Stage):
    """f1: one tone network for each direction."""

    name, makes = "tone", 1
    toe: Tensor

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_network = ToneNetwork()
        self.forward_network = ToneNetwork()
        self.register_buffer("toe", torch.zeros(()), persistent=False)

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x1 from sRGB, both ``(B, 3, H, W)``, by the reverse network."""
        return self.reverse_network(x)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute sRGB from x1, both ``(B, 3, H, W)``, by the forward network."""
        return self.forward_network(x)

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The toe of the curve."""
        return {"toe": self.toe}

    def coarse(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute ``x + toe (1 - x)``, ``(B, 3, H, W)``: with a gamma behind it the curve of sRGB."""
        return x + self.toe * (1.0 - x)

    def start_coarse(self, gamma: float, toe: float) -> None:
        """Take the toe of the curve; the stage gamma takes its power."""
        self.toe.fill_(toe)

    def start_fine(self) -> None:
        """Start the reverse network as the curve with the toe."""
        self.reverse_network.start_from(float(self.toe))


@STAGES.register("gamma")
class Gamma(Stage):
    """f2: one power for each direction, 2.2 at first."""

    name, makes = "gamma", 2

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_gamma = nn.Parameter(torch.tensor(2.2))
        self.forward_gamma = nn.Parameter(torch.tensor(2.2))

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x2 from x1, both ``(B, 3, H, W)``, by the reverse power."""
        return gamma_expand(x, self.reverse_gamma)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x1 from x2, both ``(B, 3, H, W)``, by the forward power."""
        return gamma_compress(x, self.forward_gamma)

    def describe(self) -> str:
        """Describe both powers."""
        return f"gamma: {self.reverse_gamma.item():.3f} reverse, {self.forward_gamma.item():.3f} forward"

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The reverse power."""
        return {"gamma": self.reverse_gamma}

    def coarse(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute the reverse pass itself, ``(B, 3, H, W)``, which is one number already."""
        return self.reverse(x, None)

    @torch.no_grad()
    def start_coarse(self, gamma: float, toe: float) -> None:
        """Take the power of the curve; the stage tone takes its toe."""
        self.reverse_gamma.fill_(gamma)

    @torch.no_grad()
    def start_forward(self) -> None:
        """Start the forward power from the reverse one."""
        self.forward_gamma.copy_(self.reverse_gamma)


@STAGES.register("colour")
class ColorCorrection(Stage):
    """f3: each picture's own matrix C."""

    name, makes = "colour", 3

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x3 = C x2, both ``(B, 3, H, W)``."""
        return correct_colour(x, require_params(params).matrix)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x2 = pinv(C) x3, both ``(B, 3, H, W)``."""
        return correct_colour(x, torch.linalg.pinv(require_params(params).matrix))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put the matrices ``(B, 3, 3)`` of ``params`` into ``batch``; ``place`` and ``size`` do not matter."""
        return batch._replace(matrix=params.matrix.to(batch.matrix))


@STAGES.register("gains")
class WhiteBalance(Stage):
    """f4: each picture's own gains, with Brooks' care for highlights on the way back."""

    name, makes = "gains", 4

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x4 from x3, both ``(B, 3, H, W)``, by :func:`inverse_gains`."""
        return inverse_gains(x, require_params(params).gains, self.config.knee)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x3 = g x4, both ``(B, 3, H, W)``."""
        return apply_gains(x, require_params(params).gains)

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put one over the gains ``(B, 3)`` of ``params`` into ``batch``; ``place`` and ``size`` do not matter."""
        return batch._replace(floor=1.0 / params.gains.to(batch.floor)[:, None])


@STAGES.register("shading")
class LensShading(Stage):
    """f5: a Gaussian mask over the frame and, with ``ISPConfig.attention``, an attention mask for each direction."""

    name, makes = "shading", 5

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.mask = GaussianMask()
        self.reverse_attention: AttentionMask | None = None
        self.forward_attention: AttentionMask | None = None
        if config.attention:
            self.reverse_attention = AttentionMask()
            self.forward_attention = AttentionMask()

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x5 = x4 G(p) A(x4 G(p), p), both ``(B, 3, H, W)``."""
        where = coordinates_or_full(x, coordinates)
        x = x * self.mask(where)

        if self.reverse_attention is None:
            return x
        return x * self.reverse_attention(x, where)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x4 from x5, both ``(B, 3, H, W)``: divide by the mask, then apply the forward attention.

        The attention's gains by place come first, those by colour last.
        """
        where = coordinates_or_full(x, coordinates)
        if self.forward_attention is None:
            return x / self.mask(where)

        x = x * self.forward_attention.of_place(where) / self.mask(where)
        return x * self.forward_attention.of_colour(x)

    def bake(self, tables: Tables) -> Tables:
        """Put the reverse attention mask by colour into the tables."""
        return _bake_attention(tables, self.reverse_attention)

    def bake_forward(self, tables: Tables) -> Tables:
        """Put the forward attention mask by colour into the tables."""
        return _bake_attention(tables, self.forward_attention)

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put the mask's exponents and each picture's frame ``(B, 6)`` into ``batch``.

        ``place`` and ``size`` are as in :meth:`Stage.adjust`; ``params`` do not matter.
        """
        centre = (float(self.mask.mean[0]), float(self.mask.mean[1]))
        places = [[0, 0, *size]] * len(batch.frame)
        if place is not None:
            places = place.tolist()
        rows = [mask_frame(row, *size, centre) for row in places]
        frame = batch.frame.new_tensor(rows).reshape(len(batch.frame), 6)

        precision = self.mask.precision * (0.5 / math.log(2.0))
        shading = torch.stack([precision[0, 0], 2.0 * precision[0, 1], precision[1, 1]])
        return batch._replace(frame=frame, shading=shading)

    @property
    def has_place_gain(self) -> bool:
        """Whether there is an attention mask."""
        return self.reverse_attention is not None

    def place_gain(self, coordinates: Tensor, forward: bool) -> Tensor:
        """Compute the attention's gains by place ``(B, 1, H, W)``, in the direction asked for."""
        attention = self.reverse_attention
        if forward:
            attention = self.forward_attention

        if attention is None:
            return super().place_gain(coordinates, forward)
        return attention.of_place(coordinates)

    def describe(self) -> str:
        """Describe the mask by its mean and precision."""
        mean = self.mask.mean.tolist()
        precision = [round(entry, 3) for entry in self.mask.precision.flatten().tolist()]
        return f"shading: mean {mean}, precision {precision}"

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The five numbers of the mask."""
        return {f"mask.{key}": p for key, p in self.mask.named_parameters()}

    def coarse(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Multiply ``x`` ``(B, 3, H, W)`` by the Gaussian mask alone."""
        return x * self.mask(coordinates_or_full(x, coordinates))


def _bake_attention(tables: Tables, mask: AttentionMask | None) -> Tables:
    if mask is None:
        return tables
    return tables._replace(attention=mask.of_colour(tables.cube))


def require_params(params: ISPParams | None) -> ISPParams:
    """The settings, which every stage after x2 needs; ValueError if there are none yet."""
    if params is None:
        raise ValueError("this stage needs the pictures' parameters; choose them first")
    return params
