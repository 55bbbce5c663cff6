r"""What the methods that the dictionary ISP is compared with have in common: ``y = mosaic(u(x))``, u being the method.

sRGB ``x`` ``(B, 3, H, W)`` becomes linear camera colour of the same size, of which the mosaic keeps one channel a site.
Whatever a method predicts, RAW and sRGB leave it within [0, 1]; training sees the values as they are.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.isp.fit.samples import FramePair
from rawaug.isp.reverse import ReverseISP
from rawaug.isp.stages import as_float


class BaselineISP(ReverseISP):
    """A method that the dictionary ISP is compared with.

    Args:
        cfa: pattern of the RAW that it makes and takes.

    Attributes:
        name: as in :data:`rawaug.isp.baselines.BASELINES`.
        trainable: whether :func:`rawaug.isp.baselines.fit_baseline` changes anything in it.
    """

    trainable: ClassVar[bool]

    def __init__(self, cfa: CFA | str = "RGGB") -> None:
        super().__init__()
        self._cfa = CFA(cfa)

    @property
    def cfa(self) -> CFA:
        return self._cfa

    @property
    def reverse_network(self) -> nn.Module:
        """The part that the reverse pass uses: what the published numbers of parameters count."""
        return self

    @property
    def reverse_parameters(self) -> int:
        return sum(parameter.numel() for parameter in self.reverse_network.parameters())

    @abstractmethod
    def unprocess(self, srgb: Tensor) -> Tensor:
        """Float sRGB ``(B, 3, H, W)`` to linear camera colour ``(B, 3, H, W)``, not clipped."""

    def render(self, raw: Tensor) -> Tensor:
        """Mosaic ``(B, 1, H, W)`` to sRGB ``(B, 3, H, W)``, not clipped; overridden where the method has it."""
        raise ValueError(
            f"{self.name} only converts sRGB to RAW; rawaug.isp.baselines lists the methods that also render RAW"
        )

    def reverse(self, srgb: Tensor) -> Tensor:
        """sRGB to RAW.

        Args:
            srgb: ``(B, 3, H, W)``, uint8 or float in [0, 1], even sides.

        Returns:
            The mosaic ``(B, 1, H, W)`` in :attr:`cfa`, within [0, 1].

        Raises:
            ValueError: if the shape or the type is another, or a side is odd.
        """
        return self.to_mosaic(self.unprocess(checked_srgb(srgb)))

    def make(self, srgb: Tensor, setting: Any = None, place: Tensor | None = None) -> Tensor:
        return self.reverse(srgb)

    def forward(self, raw: Tensor) -> Tensor:
        """RAW mosaic ``(B, 1, H, W)`` in :attr:`cfa` to sRGB ``(B, 3, H, W)`` in [0, 1].

        Raises:
            ValueError: if the method has no forward pass, the shape is another or a side is odd.
        """
        return self.render(checked_raw(raw)).clamp(0.0, 1.0)

    def cycle(self, srgb: Tensor) -> Tensor:
        return self.forward(self.reverse(srgb))

    def to_mosaic(self, linear: Tensor) -> Tensor:
        """Linear colour ``(B, 3, H, W)`` to the mosaic ``(B, 1, H, W)``, clipped to [0, 1]."""
        return bayer.mosaic(linear.clamp(0.0, 1.0), self.cfa)


class Crops(NamedTuple):
    """A training batch, in the CFA of the model that is trained.

    Args:
        srgb: ``(B, 3, h, w)`` in [0, 1].
        raw: ``(B, 1, h, w)``.
        white_balance: ``(B, 3)`` as-shot multipliers, green 1.
    """

    srgb: Tensor
    raw: Tensor
    white_balance: Tensor


class CropTrainedISP(BaselineISP):
    """A network that learns by gradient descent on random crops."""

    trainable = True
    learning_rate: ClassVar[float]
    """For Adam, at the start."""

    def prepare(self, pairs: Sequence[FramePair]) -> None:
        """Take from the pairs what is no matter of descent; called once, before training."""

    @abstractmethod
    def loss(self, crops: Crops, both: bool) -> Tensor:
        """The method's own loss, a scalar; ``both``: of the two directions where it has them, else of the reverse."""


def checked_srgb(srgb: Tensor) -> Tensor:
    """``(B, 3, H, W)``, uint8 or float, as float in [0, 1]."""
    if srgb.ndim != 4 or srgb.shape[1] != 3:
        raise ValueError(f"sRGB must have shape (B, 3, H, W), got {tuple(srgb.shape)}")
    if srgb.dtype != torch.uint8 and not srgb.is_floating_point():
        raise ValueError(f"sRGB must be uint8 or float in [0, 1], got {srgb.dtype}")
    if srgb.shape[2] % 2 or srgb.shape[3] % 2:
        raise ValueError(
            f"a Bayer mosaic must have even sides, got sRGB of {tuple(srgb.shape[2:])}; crop a row or column"
        )
    return as_float(srgb)


def checked_raw(raw: Tensor) -> Tensor:
    """``(B, 1, H, W)`` with even sides."""
    if raw.ndim != 4 or raw.shape[1] != 1:
        raise ValueError(f"a mosaic must have shape (B, 1, H, W), got {tuple(raw.shape)}")
    if raw.shape[2] % 2 or raw.shape[3] % 2:
        raise ValueError(
            f"a Bayer mosaic must have even sides, got {tuple(raw.shape[2:])}; crop the last row or column"
        )
    return raw
