"""ReverseISP: what every method of making RAW from sRGB can do, the dictionary ISP and the baselines alike."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from rawaug.bayer import CFA


class ReverseISP(nn.Module, ABC):
    """A way from sRGB to RAW, and back where the method has one.

    Attributes:
        name: of the method.
        bidirectional: whether it renders RAW as well, so that there is a :meth:`cycle`.
        info: how it was fitted.
    """

    name: ClassVar[str]
    bidirectional: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__()
        self.info: dict[str, Any] = {}

    @property
    @abstractmethod
    def cfa(self) -> CFA:
        """Pattern of the RAW that it makes and takes."""

    @property
    @abstractmethod
    def reverse_parameters(self) -> int:
        """Number of parameters of the reverse pass."""

    @abstractmethod
    def make(self, srgb: Tensor, setting: Any = None, place: Tensor | None = None) -> Tensor:
        """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], to the mosaic ``(B, 1, H, W)``.

        Args:
            srgb: pictures with even sides.
            setting: of the camera, as the method takes it; its own choice by default.
            place: coordinates in the full frame ``(1 or B, 2, H, W)``, for methods that depend on them.
        """

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        """The mosaic under a setting drawn at random; the one of :meth:`make` where the method has no other."""
        return self.make(srgb)

    @abstractmethod
    def cycle(self, srgb: Tensor) -> Tensor:
        """sRGB to RAW and back, ``(B, 3, H, W)`` in [0, 1]."""

    def cycle_without_mosaic(self, srgb: Tensor) -> Tensor | None:
        """The same without the mosaic between the passes; None for methods that are not pointwise."""
        return None
