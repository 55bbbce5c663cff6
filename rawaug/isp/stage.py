r"""What a stage of the ISP is: one image to the next in both directions, and its share of the baked pass.

The baked pass (:mod:`rawaug.isp.fast`) is ``y_c = sum_k C[c, k] T_k(x) max(m + (1 - m) / g_c, 1 / g_c) G(p) A(x4)``.
A stage that is the same for every picture goes into the tables ``T`` and ``A`` once (:meth:`Stage.bake`); what depends
on a picture's setting or place goes into ``C``, ``1 / g`` and ``G`` batch by batch (:meth:`Stage.adjust`).

A new kind of stage is a class with :func:`register` above it, in a module that is imported before an ISP is made.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from rawaug.isp.config import ISPConfig
from rawaug.isp.setting import ISPParams


class Tables(NamedTuple):
    """What the baked pass looks up, at the nodes of an N x N x N cube.

    Args:
        cube: ``(1, 3, N, N * N)`` the nodes' colours.
        x2: ``(1, 3, N, N * N)`` what the stages so far make of them.
        attention: ``(1, 1, N, N * N)`` a gain for linear colours, or None.
    """

    cube: Tensor
    x2: Tensor
    attention: Tensor | None = None


class Dials(NamedTuple):
    """What the baked pass uses of a batch's settings.

    Args:
        matrix: ``(B, 3, 3)`` x2 to x3.
        floor: ``(B, 1, 3)`` one over the gains.
        frame: ``(B, 6)`` see :class:`rawaug.kernels.raw_torch.Camera`.
        curves: ``(B, 1021)`` x to x2, in place of the table; or ``(B, 0)``.
        shading: ``(3,)`` of the mask ``2^-(a y^2 + b x y + c x^2)``, or empty.
    """

    matrix: Tensor
    floor: Tensor
    frame: Tensor
    curves: Tensor
    shading: Tensor


class Stage(nn.Module, ABC):
    """A stage of the ISP; images are ``(B, 3, H, W)``.

    Parameters whose names start with ``forward_`` are those of the forward pass, all others are the reverse pass's.

    Args:
        config: of the ISP.

    Attributes:
        name: in ``ISPConfig.stages`` and in files.
        makes: k of ``x_k``, the image that the reverse pass makes: the stage's position in the usual order.
        config: of the ISP, kept up to date by it.
    """

    name: ClassVar[str]
    makes: ClassVar[int]

    def __init__(self, config: ISPConfig) -> None:
        super().__init__()
        self.config = config

    @abstractmethod
    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        """``x_(k-1)`` to ``x_k``.

        Args:
            x: the image.
            params: the pictures' settings; None where the setting is not chosen yet, for stages up to x2.
            place: coordinates in the full frame ``(1 or B, 2, H, W)``; ``x`` is a full frame by default.
        """

    @abstractmethod
    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        """``x_k`` to ``x_(k-1)``, arguments as in :meth:`reverse`."""

    @abstractmethod
    def bake(self, tables: Tables) -> Tables:
        """The tables with what this stage does to every picture alike."""

    def adjust(self, dials: Dials, params: ISPParams, place: Tensor | None, size: tuple[int, int]) -> Dials:
        """The dials with what this stage does to these pictures.

        Args:
            dials: as the stages before set them.
            params: the pictures' settings.
            place: ``(B, 4 or 5)`` as :class:`rawaug.isp.fast.BakedISP` takes it.
            size: height and width of the pictures.
        """
        return dials

    def describe(self) -> str:
        """The stage's parameters in one line; empty if the settings hold them all."""
        return ""

    # -- fitting ----------------------------------------------------------------------------------------------------

    def coarse_parameters(self) -> dict[str, Tensor]:
        """The few numbers of :meth:`coarse`."""
        return {}

    def coarse(self, x: Tensor, place: Tensor | None) -> Tensor:
        """The reverse pass in a few numbers, from which a fit starts; nothing for what each frame has of its own."""
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


STAGES: dict[str, type[Stage]] = {}
"""Name to class."""

Kind = TypeVar("Kind", bound=type[Stage])


def register(kind: Kind) -> Kind:
    """Let ISPs be made of stages of this class.

    Raises:
        ValueError: if another class has the name.
    """
    if STAGES.setdefault(kind.name, kind) is not kind:
        raise ValueError(f"stage {kind.name!r} is registered already, by {STAGES[kind.name].__qualname__}")
    return kind


def stage_class(name: str) -> type[Stage]:
    """The class of the stages called ``name``.

    Raises:
        ValueError: naming the known ones.
    """
    if name not in STAGES:
        raise ValueError(f"stages: {name!r} is unknown; choose of {' '.join(STAGES)}")
    return STAGES[name]


def node_colours(nodes: int) -> Tensor:
    """The colours ``(1, 3, N, N * N)`` at the nodes of a table, axes B, G, R."""
    axis = torch.linspace(0.0, 1.0, nodes, dtype=torch.float32)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij")).flip(0).reshape(1, 3, nodes, nodes**2)
