r"""The stages of the ISP between sRGB and the mosaic, each with its inverse, and its part in the baked pass.

======  ===============  ==============================================  ==============================================
stage   name             reverse (sRGB to RAW)                           forward (RAW to sRGB)
======  ===============  ==============================================  ==============================================
f1      tone mapping     x1 = x + phi(x; theta_r)                        x = x1 + phi(x1; theta_f)
f2      gamma            x2 = max(x1, eps) ** gamma                      x1 = max(x2, eps) ** (1 / gamma)
f3      colour           x3 = C x2                                       x2 = pinv(C) x3
f4      white balance    x4 = h(x3; g), Brooks' highlight-safe 1/g       x3 = g x4
f5      lens shading     x5 = x4 G(p) A(x4, p), or x5 = x4 S(p)          x4 = x5 / G(p) A'(x5, p), or x4 = x5 / S(p)
f6      mosaic           y = one channel a site                          x5 = bilinear demosaic of y
======  ===============  ==============================================  ==============================================

Source: Conde et al., "Model-Based Image Signal Processors via Learnable Dictionaries", AAAI 2022, eqs. 3 to 9 and
figure 2; the highlight-safe inverse gains are eq. 4 of Brooks et al., "Unprocessing Images for Learned Raw Denoising",
CVPR 2019. f6 is in :mod:`rawaug.bayer`; :class:`rawaug.isp.tone.ToneCurve` can replace f1 and f2. Images are
``(B, 3, H, W)``, linear from x2 on, white at 1.

Everything but f6 is pointwise, given the parameters: a set of pixels ``(B, 3, 1, P)`` is as good as a picture.

The baked pass (:mod:`rawaug.isp.fast`) is ``y_c = sum_k C[c, k] T_k(x) max(m + (1 - m) / g_c, 1 / g_c) G(p) A(x4)``.
The part of a stage that is the same for every picture goes into the tables ``T`` and ``A`` once (:meth:`Stage.bake`).
The part that depends on a picture's setting or place goes into ``C``, ``1 / g`` and ``G`` for each batch
(:meth:`Stage.adjust`). A place-dependent gain that no table holds multiplies the RAW (:meth:`Stage.place_gain`): that
of the attention mask, and S, the shading that the sheets of one's own cameras state.

A new kind of stage is a class with ``@STAGES.register(name)`` above it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple, TypeVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from rawaug.isp.config import ISPConfig, ISPParams
from rawaug.isp.functional import (
    apply_gains,
    coordinates_or_full,
    correct_colour,
    gamma_compress,
    gamma_expand,
    inverse_gains,
)
from rawaug.isp.layers import AttentionMask, GaussianMask, ToneNetwork
from rawaug.kernels.reference import mask_frame
from rawaug.registry import Registry

FALLOFF_NODES = 33
"""Number of nodes along each side of a table of stated shading."""
_LEAST_SHARE = 0.01
"""Less light arrives nowhere in a frame."""
STAGES = Registry("stage", "rawaug.stages", "rawaug.isp")
"""The stages of an ISP by name: subclasses of :class:`Stage`."""


PlaceGain = Callable[[Tensor, Tensor, ISPParams], Tensor]
"""What :meth:`Stage.place_gain` returns."""


class Tables(NamedTuple):
    """The tables of the baked pass, at the nodes of an N x N x N cube.

    Args:
        cube: the colours of the nodes, ``(1, 3, N, N * N)``.
        x2: the colours after the stages up to x2, of the same shape.
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
        frame: ``(B, 6)``, where the picture lies; see :class:`rawaug.kernels.reference.Unprocessing`.
        curves: ``(B, T)``, inverse tone curves, or ``(B, 0)`` if the tone is in the tables.
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

        ``params`` are the settings of the pictures, which stages up to x2 do not need, and ``coordinates``
        ``(1 or B, 2, H, W)`` those of the pixels in the full frame.
        """

    @abstractmethod
    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute ``x_(k-1)`` from ``x_k``, both ``(B, 3, H, W)``; arguments as in :meth:`reverse`."""

    def bake(self, tables: Tables, forward: bool = False) -> Tables:
        """Add the part of this stage that is the same for every picture to the tables of a pass.

        The x2 of the forward pass's tables becomes sRGB.
        """
        if self.makes > 2:
            return tables
        convert = self.forward if forward else self.reverse
        return tables._replace(x2=convert(tables.x2, None))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Add the part of this stage that depends on these pictures to ``batch``.

        Args:
            batch: the numbers from the stages before this one.
            params: the settings of the pictures.
            place: where each picture lies in its frame, ``(B, 4 to 6)``: top, left, height and width of the frame, and,
                if the crop was turned or enlarged, its view and how many rows of the frame it has; None for full
                frames.
            size: height and width of the pictures.
        """
        return batch

    def place_gain(self, forward: bool) -> PlaceGain | None:
        """The gains of this stage that depend on place and setting, and that no table holds; they multiply RAW.

        Args:
            forward: True for the forward pass, which multiplies RAW before everything else; False for the reverse pass,
                which does so after everything else.

        Returns:
            A function of coordinates ``(B, 2, H, W)`` of pixels in the full frame, coordinates ``(B, 2)`` of the
            frame's bottom and right edge, and the settings, which gives ``(B, 1, H, W)``, or ``(B, 3, H, W)`` for R, G
            and B. None without any.
        """
        return None


S = TypeVar("S", bound=Stage)


class Stages(nn.ModuleDict):
    """The stages of an ISP by name, in reverse order. Everything but the mosaic happens here.

    Images are ``(B, 3, H, W)``, or P pixels of them ``(B, 3, 1, P)``, as the stages are pointwise.
    """

    @property
    def ordered(self) -> list[Stage]:
        """The stages in reverse order."""
        return [cast(Stage, stage) for stage in self.values()]

    def find(self, kind: type[S]) -> S | None:
        """The stage of this class, or None."""
        for stage in self.ordered:
            if isinstance(stage, kind):
                return stage
        return None

    def reverse(
        self, x: Tensor, params: ISPParams, coordinates: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """Run the reverse pass without its mosaic.

        Args:
            x: sRGB as float ``(B, 3, H, W)``.
            params: the settings of the pictures.
            coordinates: ``(1 or B, 2, H, W)`` of the pixels in the full frame; by default the picture is the frame.
            seen: a dict to fill with x1 ... x5 by name.

        Returns:
            Linear camera colour x5, of the shape of ``x``.
        """
        for stage in self.ordered:
            x = stage.reverse(x, params, coordinates)
            if seen is not None:
                seen[f"x{stage.makes}"] = x
        return x

    def forward(
        self, x: Tensor, params: ISPParams, coordinates: Tensor | None = None, seen: dict[str, Tensor] | None = None
    ) -> Tensor:
        """Run the forward pass after demosaicing; the result is not clipped.

        Args:
            x: linear camera colour x5 ``(B, 3, H, W)``.
            params: the settings of the pictures.
            coordinates: as in :meth:`reverse`.
            seen: a dict to fill with x4 ... x1 by name.

        Returns:
            sRGB, of the shape of ``x``.
        """
        for stage in reversed(self.ordered):
            x = stage.forward(x, params, coordinates)
            if seen is not None and stage.makes > 1:
                seen[f"x{stage.makes - 1}"] = x
        return x

    def linear(self, x: Tensor) -> Tensor:
        """Compute x2 from sRGB, both ``(B, 3, H, W)``, by the stages in their usual order; it needs no setting."""
        for stage in sorted(self.ordered, key=lambda stage: stage.makes):
            if stage.makes <= 2:
                x = stage.reverse(x, None)
        return x

    def remove_shading(self, x: Tensor, coordinates: Tensor | None) -> Tensor:
        """Compute x4 from x5, both ``(B, 3, H, W)``; the forward encoders look at x4."""
        for stage in reversed(self.ordered):
            if stage.makes >= 5:
                x = stage.forward(x, None, coordinates)
        return x


def node_colours(nodes: int) -> Tensor:
    """The colours at the nodes of a table, float32 ``(1, 3, N, N * N)``; the axes of the cube are B, G, R."""
    axis = torch.linspace(0.0, 1.0, nodes, dtype=torch.float32)
    cube = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"))
    return cube.flip(0).reshape(1, 3, nodes, nodes**2)


@STAGES.register("tone")
class ToneMap(Stage):
    """f1: one tone network for each direction."""

    name, makes = "tone", 1

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.reverse_network = ToneNetwork()
        self.forward_network = ToneNetwork()
        self.toe: Tensor | None = None
        """a of ``x1 = x + a (1 - x)``, a scalar, which is the reverse pass at the start of a fit; None else."""

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x1 from sRGB, both ``(B, 3, H, W)``, by the reverse network."""
        if self.toe is not None:
            return x + self.toe * (1.0 - x)
        return self.reverse_network(x)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute sRGB from x1, both ``(B, 3, H, W)``, by the forward network."""
        return self.forward_network(x)


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

    def extra_repr(self) -> str:
        """Describe both powers."""
        return f"{self.reverse_gamma.item():.3f} reverse, {self.forward_gamma.item():.3f} forward"


@STAGES.register("colour")
class ColorCorrection(Stage):
    """f3: each picture's own matrix C."""

    name, makes = "colour", 3

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x3 = C x2, both ``(B, 3, H, W)``."""
        return correct_colour(x, _require_params(params).matrix)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x2 = pinv(C) x3, both ``(B, 3, H, W)``."""
        return correct_colour(x, torch.linalg.pinv(_require_params(params).matrix))

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put the matrices ``(B, 3, 3)`` of ``params`` into ``batch``; ``place`` and ``size`` do not matter."""
        return batch._replace(matrix=params.matrix.to(batch.matrix))


@STAGES.register("gains")
class WhiteBalance(Stage):
    """f4: each picture's own gains, with Brooks' protection of highlights in the reverse pass."""

    name, makes = "gains", 4

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x4 from x3, both ``(B, 3, H, W)``, by :func:`inverse_gains`."""
        return inverse_gains(x, _require_params(params).gains, self.config.knee)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x3 = g x4, both ``(B, 3, H, W)``."""
        return apply_gains(x, _require_params(params).gains)

    def adjust(self, batch: BatchParams, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> BatchParams:
        """Put one over the gains ``(B, 3)`` of ``params`` into ``batch``; ``place`` and ``size`` do not matter."""
        return batch._replace(floor=params.gains.to(batch.floor).reciprocal()[:, None])


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
        coordinates = coordinates_or_full(x, coordinates)
        x = x * self.mask(coordinates)

        if self.reverse_attention is None:
            return x
        return x * self.reverse_attention(x, coordinates)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x4 from x5, both ``(B, 3, H, W)``: divide by the mask, then apply the forward attention.

        The attention's place-dependent gains come first, its colour-dependent ones last.
        """
        coordinates = coordinates_or_full(x, coordinates)
        if self.forward_attention is None:
            return x / self.mask(coordinates)

        x = x * self.forward_attention.of_place(coordinates) / self.mask(coordinates)
        return x * self.forward_attention.of_colour(x)

    def bake(self, tables: Tables, forward: bool = False) -> Tables:
        """Put the colour-dependent attention mask of the requested direction into the tables."""
        attention = self.forward_attention if forward else self.reverse_attention
        if attention is None:
            return tables
        return tables._replace(attention=attention.of_colour(tables.cube))

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

    def place_gain(self, forward: bool) -> PlaceGain | None:
        """The attention's place-dependent gains ``(B, 1, H, W)`` in the requested direction."""
        attention = self.forward_attention if forward else self.reverse_attention
        if attention is None:
            return None
        return lambda coordinates, edge, params: attention.of_place(coordinates)

    def extra_repr(self) -> str:
        """Describe the mask by its mean and precision."""
        mean = self.mask.mean.tolist()
        precision = [round(entry, 3) for entry in self.mask.precision.flatten().tolist()]
        return f"mean {mean}, precision {precision}"


@STAGES.register("falloff")
class FallOff(Stage):
    """f5 of cameras whose sheets state it: tables of the light that arrives, mixed by the colour atoms' weights.

    An atom is a camera in a light, so the shading changes with the light. A table lies over the whole frame, whatever
    its shape is; its outermost nodes are the frame's edges.
    """

    name, makes = "falloff", 5
    tables: Tensor

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.register_buffer("tables", torch.ones(config.colour_atoms, 3, FALLOFF_NODES, FALLOFF_NODES))

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x5 from x4, both ``(B, 3, H, W)``; the frame of given ``coordinates`` has sides of 3 and 4."""
        return x * self._shares(x, params, coordinates)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        """Compute x4 from x5, both ``(B, 3, H, W)``."""
        return x / self._shares(x, params, coordinates)

    def _shares(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None) -> Tensor:
        sides = (3.0, 4.0)
        if coordinates is None:
            sides = (float(x.shape[-2]), float(x.shape[-1]))
        edge = x.new_tensor([sides]) / math.hypot(*sides)

        weights = x.new_full((1, len(self.tables)), 1.0 / len(self.tables))  # before a setting is chosen
        if params is not None:
            weights = params.colour_weights
        return self._look_up(coordinates_or_full(x, coordinates), edge, weights)

    def place_gain(self, forward: bool) -> PlaceGain:
        """Look up the shares of light ``(B, 3, H, W)``, or one over them for the forward pass."""

        def gain(coordinates: Tensor, edge: Tensor, params: ISPParams) -> Tensor:
            shares = self._look_up(coordinates, edge, params.colour_weights)
            return 1.0 / shares if forward else shares

        return gain

    def _look_up(self, coordinates: Tensor, edge: Tensor, weights: Tensor) -> Tensor:
        """Mix the tables by weights ``(B, N)``, and look up ``coordinates`` ``(1 or B, 2, H, W)``: ``(B, 3, H, W)``."""
        tables = torch.einsum("bn,nchw->bchw", weights.to(self.tables), self.tables)
        grid = (coordinates / edge[:, :, None, None]).flip(1).permute(0, 2, 3, 1)  # grid_sample takes (x, y)
        grid = grid.expand(len(tables), -1, -1, -1)
        return F.grid_sample(tables, grid, padding_mode="border", align_corners=True)

    def extra_repr(self) -> str:
        """Describe the tables by the light that they leave in the corners."""
        corners = self.tables[:, 1, :: FALLOFF_NODES - 1, :: FALLOFF_NODES - 1].mean()
        return f"tables of {len(self.tables)} atoms, {float(corners):.2f} of the light in the corners"


def interpolate_shares(shares: Tensor) -> Tensor:
    """Interpolate shares of light ``(3, rows, columns)``, of cells over the frame, to the nodes of a table.

    Returns:
        float32 ``(3, 33, 33)``.
    """
    for axis in (1, 2):  # half a cell further to the edges of the frame, as it goes on
        lines = list(shares.unbind(axis))
        lines = [2 * lines[0] - lines[1], *lines, 2 * lines[-1] - lines[-2]]
        shares = torch.stack(lines, dim=axis).clamp_min(_LEAST_SHARE)

    rows, columns = shares.shape[1] - 2, shares.shape[2] - 2
    y = torch.linspace(-rows / (rows + 2), rows / (rows + 2), FALLOFF_NODES)
    x = torch.linspace(-columns / (columns + 2), columns / (columns + 2), FALLOFF_NODES)
    nodes = torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))], dim=-1)[None]
    return F.grid_sample(shares.float()[None], nodes, align_corners=False)[0]


def _require_params(params: ISPParams | None) -> ISPParams:
    """Return the settings, which every stage after x2 needs; ValueError if there are none yet."""
    if params is None:
        raise ValueError("this stage needs the pictures' parameters; choose them first")
    return params
