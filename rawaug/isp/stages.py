r"""The stages of the ISP between sRGB and the mosaic, each with its inverse, and how each enters the baked pass.

======  ===============  ==============================================  ==============================================
stage   name             reverse (sRGB to RAW)                           forward (RAW to sRGB)
======  ===============  ==============================================  ==============================================
f1      tone mapping     x1 = x + phi(x; theta_r)                        x = x1 + phi(x1; theta_f)
f2      gamma            x2 = max(x1, eps) ** gamma                      x1 = max(x2, eps) ** (1 / gamma)
f3      colour           x3 = C x2                                       x2 = pinv(C) x3
f4      white balance    x4 = h(x3; g), Brooks' highlight-safe 1/g       x3 = g x4
f5      lens shading     x5 = x4 G(p) A(x4)                              x4 = x5 / G(p) A'(x5)
f6      mosaic           y = one channel a site                          x5 = bilinear demosaic of y
======  ===============  ==============================================  ==============================================

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022, eqs. 3 to 9 and
figure 2; the highlight-safe inverse gains are eq. 4 of Brooks et al., "Unprocessing Images for Learned Raw Denoising",
CVPR 2019. f6 is in :mod:`rawaug.bayer`; :class:`rawaug.isp.tone.ToneCurve` can replace f1 and f2. Images are
``(B, 3, H, W)``, linear from x2 on, white at 1.

Everything but f6 is pointwise, given the parameters: a set of pixels ``(B, 3, 1, P)`` is as good as a picture.

The baked pass (:mod:`rawaug.isp.fast`) is ``y_c = sum_k C[c, k] T_k(x) max(m + (1 - m) / g_c, 1 / g_c) G(p) A(x4)``.
What a stage does to every picture alike goes into the tables ``T`` and ``A`` once (:meth:`Stage.bake`); what depends
on a picture's setting or place goes into ``C``, ``1 / g`` and ``G`` for each batch (:meth:`Stage.adjust`).

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
from rawaug.registry import STAGES

EPS = 1e-6
"""Floor under a power: keeps the gradient of x ** (1 / gamma) finite at black."""

WIDTH = 32
"""Features of the networks."""
_HALF_LEVEL = 0.5 / 255


def as_float(srgb: Tensor) -> Tensor:
    """uint8 to float32 in [0, 1]; floats pass."""
    return srgb.float() / 255.0 if srgb.dtype == torch.uint8 else srgb


def as_display_referred(srgb: Tensor) -> Tensor:
    """:func:`as_float` of a picture; ValueError unless it is uint8 or float32 in [0, 1]."""
    if srgb.layout != torch.strided:
        raise ValueError(f"a picture must be a dense tensor, got {srgb.layout}; call to_dense()")
    if srgb.dtype not in (torch.uint8, torch.float32):
        raise ValueError(f"a picture must be uint8 or float32 in [0, 1], got {srgb.dtype}; convert it first")
    require_display_range(srgb)
    return as_float(srgb)


def require_display_range(image: Tensor) -> None:
    """Raise ValueError if floats leave [0, 1] by more than half an 8-bit level, or are NaN."""
    # Only on the CPU: elsewhere reading a value back would stall the device.
    if image.device.type != "cpu" or image.dtype == torch.uint8 or not image.numel():
        return
    low, high = (float(value) for value in torch.aminmax(image.detach()))
    if not (low >= -_HALF_LEVEL and high <= 1 + _HALF_LEVEL):
        if missing := int(image.isnan().sum()):
            raise ValueError(
                f"a float picture is in [0, 1], got NaN in {missing} of {image.numel()} values; correct it first"
            )
        raise ValueError(
            f"a float picture must be in [0, 1], got {low:.4g} to {high:.4g}; scale it, and normalise after rawaug"
        )


def _colourwise(hidden: int, outputs: int) -> nn.Sequential:
    """``hidden`` 1 x 1 convolutions to 32 features with ReLU, then one that is zero until it is trained."""
    last = nn.Conv2d(WIDTH, outputs, 1)
    nn.init.zeros_(last.weight)
    last.bias = nn.Parameter(torch.zeros(outputs))
    inputs = [3, *[WIDTH] * (hidden - 1)]
    layers = [layer for channels in inputs for layer in (nn.Conv2d(channels, WIDTH, 1), nn.ReLU())]
    return nn.Sequential(*layers, last)


class ToneNetwork(nn.Module):
    """f1: a residual 3-32-32-32-3 network of 1 x 1 convolutions with ReLU; the identity at first."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = _colourwise(hidden=3, outputs=3)

    def forward(self, x: Tensor) -> Tensor:
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
    """f2 reversed: display-referred to linear, ``max(x, eps) ** gamma``."""
    return x.clamp_min(EPS) ** gamma


def gamma_compress(x: Tensor, gamma: Tensor | float) -> Tensor:
    """f2: linear to display-referred, ``max(x, eps) ** (1 / gamma)``."""
    return x.clamp_min(EPS) ** (1.0 / gamma)


def correct_colour(x: Tensor, matrix: Tensor) -> Tensor:
    """f3 in either direction: ``matrix`` ``(B, 3, 3)`` acts on colour columns."""
    return torch.einsum("bij,bjhw->bihw", matrix, x)


def inverse_gains(x: Tensor, gains: Tensor, knee: float | None = HIGHLIGHT_KNEE) -> Tensor:
    """f4 reversed: divide by ``gains`` ``(B, 3)``, sparing highlights; ``knee=None`` divides plainly.

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
    """What sparing a highlight adds to ``floor``, one over the gains, where the mask is 1."""
    return torch.zeros_like(floor) if knee is None else (1.0 - floor).clamp_min(0.0)


def apply_gains(x: Tensor, gains: Tensor) -> Tensor:
    """f4: multiply by ``gains`` ``(B, 3)``."""
    return x * gains[:, :, None, None]


def frame_coordinates(
    height: int, width: int, offset: tuple[int, int] = (0, 0), frame: tuple[int, int] | None = None
) -> Tensor:
    """Coordinates ``(1, 2, H, W)`` (y, x) of a crop's pixels in its *full* frame: centre 0, half the diagonal 1."""
    full_height, full_width = frame or (height, width)
    half_diagonal = 0.5 * (full_height**2 + full_width**2) ** 0.5
    y = (torch.arange(height, dtype=torch.float32) + (offset[0] + 0.5 - full_height / 2)) / half_diagonal
    x = (torch.arange(width, dtype=torch.float32) + (offset[1] + 0.5 - full_width / 2)) / half_diagonal
    return torch.stack(torch.meshgrid(y, x, indexing="ij"))[None]


def coordinates_or_full(x: Tensor, place: Tensor | None) -> Tensor:
    """``place``, or that of a full frame, in the dtype of the image ``x``."""
    return (frame_coordinates(*x.shape[-2:]) if place is None else place).to(x)


class GaussianMask(nn.Module):
    """The sensor's fall-off ``G(p) = exp(-||L^T (p - mu)||^2 / 2)``, precision ``Sigma^-1 = L L^T``; flat at first.

    ``p`` are the coordinates of :func:`frame_coordinates`.
    """

    def __init__(self) -> None:
        super().__init__()
        self.mean = nn.Parameter(torch.zeros(2))
        self.factor = nn.Parameter(torch.zeros(3))  # L11, L21, L22

    @property
    def precision(self) -> Tensor:
        """Sigma^-1, ``(2, 2)``, positive semi-definite by construction."""
        factor = torch.zeros(2, 2, device=self.factor.device, dtype=self.factor.dtype)
        rows, columns = torch.tensor([0, 1, 1]), torch.tensor([0, 0, 1])
        factor = factor.index_put((rows, columns), self.factor)
        return factor @ factor.T

    def forward(self, place: Tensor) -> Tensor:
        """Mask ``(B, 1, H, W)`` in (0, 1] at coordinates ``(B, 2, H, W)``."""
        p = place - self.mean[None, :, None, None]
        return torch.exp(-0.5 * torch.einsum("bihw,ij,bjhw->bhw", p, self.precision, p))[:, None]

    @torch.no_grad()
    def set(self, mean: Tensor, precision: Tensor) -> None:
        """Start from a mean ``(2,)`` and a precision ``(2, 2)``; negative curvature is taken as none."""
        values, vectors = torch.linalg.eigh(precision)
        root = vectors @ torch.diag(values.clamp_min(0.0).sqrt())
        lower = torch.linalg.qr(root.T).R.T
        self.mean.copy_(mean)
        self.factor.copy_(torch.stack([lower[0, 0], lower[1, 0], lower[1, 1]]))


class AttentionMask(nn.Module):
    """A per-pixel gain ``A = 2 sigmoid(...)`` in (0, 2); the paper has no 2, with which it is the identity at first."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = _colourwise(hidden=2, outputs=1)

    def forward(self, x: Tensor) -> Tensor:
        """Mask ``(B, 1, H, W)`` of an image ``(B, 3, H, W)``."""
        return 2.0 * torch.sigmoid(self.layers(x))


class Tables(NamedTuple):
    """What the baked pass looks up, at the nodes of an N x N x N cube."""

    cube: Tensor
    x2: Tensor
    attention: Tensor | None = None


class BatchParams(NamedTuple):
    """What the baked pass takes from the settings of a batch."""

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
    """In ``ISPConfig.stages`` and in files."""
    makes: ClassVar[int]
    """k of ``x_k``, the image that the reverse pass makes: the stage's position in the usual order."""

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.config = config

    @abstractmethod
    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        """``x_(k-1)`` to ``x_k``."""

    @abstractmethod
    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        """``x_k`` to ``x_(k-1)``, arguments as in :meth:`reverse`."""

    def bake(self, tables: Tables) -> Tables:
        """The tables of the reverse pass with what this stage does to every picture alike."""
        return tables._replace(x2=self.reverse(tables.x2, None)) if self.makes <= 2 else tables

    def bake_forward(self, tables: Tables) -> Tables:
        """The tables of the forward pass, whose ``x2`` becomes sRGB, likewise."""
        return tables._replace(x2=self.forward(tables.x2, None)) if self.makes <= 2 else tables

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """``batch`` with what this stage does to these pictures of ``size``; ``place`` ``(B, 4 to 6)`` or None."""
        return batch

    def describe(self) -> str:
        """The stage's parameters in one line; empty if the settings hold them all."""
        return ""

    # -- fitting ----------------------------------------------------------------------------------------------------

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The few numbers of :meth:`coarse`."""
        return {}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        """The reverse pass in a few numbers, from which a fit starts; the identity if each frame has its own."""
        return x

    def start_coarse(self, gamma: float, toe: float) -> None:
        """Start as the curve ``(x + toe (1 - x))^gamma``."""

    def start_fine(self) -> None:
        """Start :meth:`reverse` from :meth:`coarse`."""

    def start_forward(self) -> None:
        """Start :meth:`forward` from :meth:`reverse`."""

    def parameters_of(self, forward: bool) -> dict[str, Tensor]:
        """The parameters that the forward or the reverse pass is fitted by, with the stage's name before theirs."""
        named = self.named_parameters()
        return {f"{self.name}.{key}": p for key, p in named if key.startswith("forward_") == forward}


def node_colours(nodes: int) -> Tensor:
    """The colours ``(1, 3, N, N * N)`` at the nodes of a table, axes B, G, R."""
    axis = torch.linspace(0.0, 1.0, nodes, dtype=torch.float32)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).flip(0).reshape(1, 3, nodes, nodes**2)


@STAGES.register("tone")
class ToneMap(Stage):
    """f1: a tone network for each direction."""

    name, makes = "tone", 1
    toe: Tensor

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_network = ToneNetwork()
        self.forward_network = ToneNetwork()
        self.register_buffer("toe", torch.zeros(()), persistent=False)

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return self.reverse_network(x)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return self.forward_network(x)

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {"toe": self.toe}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return x + self.toe * (1.0 - x)

    def start_coarse(self, gamma: float, toe: float) -> None:
        self.toe.fill_(toe)

    def start_fine(self) -> None:
        self.reverse_network.start_from(float(self.toe))


@STAGES.register("gamma")
class Gamma(Stage):
    """f2: a power for each direction, 2.2 at first."""

    name, makes = "gamma", 2

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_gamma = nn.Parameter(torch.tensor(2.2))
        self.forward_gamma = nn.Parameter(torch.tensor(2.2))

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return gamma_expand(x, self.reverse_gamma)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return gamma_compress(x, self.forward_gamma)

    def describe(self) -> str:
        return f"gamma: {self.reverse_gamma.item():.3f} reverse, {self.forward_gamma.item():.3f} forward"

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {"gamma": self.reverse_gamma}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return self.reverse(x, None)

    @torch.no_grad()
    def start_coarse(self, gamma: float, toe: float) -> None:
        self.reverse_gamma.fill_(gamma)

    @torch.no_grad()
    def start_forward(self) -> None:
        self.forward_gamma.copy_(self.reverse_gamma)


@STAGES.register("colour")
class ColorCorrection(Stage):
    """f3: the picture's matrix."""

    name, makes = "colour", 3

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return correct_colour(x, require_params(params).matrix)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return correct_colour(x, torch.linalg.pinv(require_params(params).matrix))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        return batch._replace(matrix=params.matrix.to(batch.matrix))


@STAGES.register("gains")
class WhiteBalance(Stage):
    """f4: the picture's gains, with Brooks' care for highlights on the way back."""

    name, makes = "gains", 4

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return inverse_gains(x, require_params(params).gains, self.config.knee)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return apply_gains(x, require_params(params).gains)

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        return batch._replace(floor=1.0 / params.gains.to(batch.floor)[:, None])


@STAGES.register("shading")
class LensShading(Stage):
    """f5: a Gaussian mask over the frame and, with ``ISPConfig.attention``, an attention mask for each direction."""

    name, makes = "shading", 5

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.mask = GaussianMask()
        self.reverse_attention = AttentionMask() if config.attention else None
        self.forward_attention = AttentionMask() if config.attention else None

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        x = x * self.mask(coordinates_or_full(x, place))
        return x if self.reverse_attention is None else x * self.reverse_attention(x)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        x = x / self.mask(coordinates_or_full(x, place))
        return x if self.forward_attention is None else x * self.forward_attention(x)

    def bake(self, tables: Tables) -> Tables:
        return _bake_attention(tables, self.reverse_attention)

    def bake_forward(self, tables: Tables) -> Tables:
        return _bake_attention(tables, self.forward_attention)

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        centre = (float(self.mask.mean[0]), float(self.mask.mean[1]))
        places = [[0, 0, *size]] * len(batch.frame) if place is None else place.tolist()
        frame = batch.frame.new_tensor([mask_frame(p, *size, centre) for p in places]).reshape(len(batch.frame), 6)
        precision = self.mask.precision * (0.5 / math.log(2.0))
        shading = torch.stack([precision[0, 0], 2.0 * precision[0, 1], precision[1, 1]])
        return batch._replace(frame=frame, shading=shading)

    def describe(self) -> str:
        mean, precision = self.mask.mean.tolist(), self.mask.precision.flatten().tolist()
        return f"shading: mean {mean}, precision {[round(p, 3) for p in precision]}"

    def coarse_parameters(self) -> dict[str, Tensor]:
        return {f"mask.{key}": p for key, p in self.mask.named_parameters()}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        return x * self.mask(coordinates_or_full(x, place))


def _bake_attention(tables: Tables, mask: AttentionMask | None) -> Tables:
    return tables if mask is None else tables._replace(attention=mask(tables.cube))


def require_params(params: ISPParams | None) -> ISPParams:
    """``params``, which every stage after x2 needs."""
    if params is None:
        raise ValueError("this stage needs the pictures' parameters; choose them first")
    return params
