"""An ISP's configuration, the setting of a picture, the result of a pass, and what every ISP can do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from rawaug.bayer import CFA
from rawaug.registry import require_between

HIGHLIGHT_KNEE = 0.9
"""Mean linear value above which Brooks' inverse gains bend towards 1."""

# More are refused before anything is built: a few bytes of a file can ask for any amount of memory.
MOST_ATOMS, MOST_CAMERAS, MOST_FEATURES = 1024, 2**14, 256

POINTWISE_STAGES = ("tone", "gamma", "colour", "gains", "shading")
"""The stages of the paper between sRGB and the mosaic, in reverse order; the k-th makes x_k."""


@dataclass(frozen=True)
class ISPConfig:
    """Configuration of a :class:`DictionaryISP`, stored in the header of its file.

    Args:
        colour_atoms: N, colour correction matrices in the dictionary.
        gain_atoms: M, triplets of gains in the dictionary.
        encoder_widths: features of the encoders' three convolutions.
        cfa: pattern of the RAW it makes.
        stages: the stages in reverse order, of ``tone gamma colour gains shading`` and whatever else is registered in
            :data:`rawaug.registry.STAGES`; ``curve`` stands in place of ``tone gamma``.
        encoders: whether encoders look at the picture; if not, there are only learned constant weights.
        attention: whether the shading stage has its attention mask.
        knee: where Brooks' inverse gains start to spare highlights; null for gains that each channel divides by alone.
        tone_atoms: K, inverse tone curves in the dictionary of the stage ``curve``; 0 without it.
        cameras: P, published cameras that are mixtures of the colour atoms, whose gains follow from the light; 0 where
            the atoms are fitted.
    """

    colour_atoms: int = 16
    gain_atoms: int = 16
    encoder_widths: tuple[int, int, int] = (32, 64, 160)
    cfa: str = "RGGB"
    stages: tuple[str, ...] = POINTWISE_STAGES
    encoders: bool = False
    attention: bool = True
    knee: float | None = HIGHLIGHT_KNEE
    tone_atoms: int = 0
    cameras: int = 0

    def __post_init__(self) -> None:
        CFA(self.cfa)
        for key in ("stages", "encoder_widths"):  # a recipe or a file gives lists
            if not isinstance(getattr(self, key), (tuple, list)):
                raise ValueError(f"{key} must be a list, got {getattr(self, key)!r:.100}")
            object.__setattr__(self, key, tuple(getattr(self, key)))
        for key in ("encoders", "attention"):
            if not isinstance(getattr(self, key), bool):
                raise ValueError(f"{key} must be true or false, got {getattr(self, key)!r:.100}")
        limits = {"colour_atoms": (1, MOST_ATOMS), "gain_atoms": (1, MOST_ATOMS), "tone_atoms": (0, MOST_ATOMS)}
        for key, (least, most) in {**limits, "cameras": (0, MOST_CAMERAS)}.items():
            require_between(key, getattr(self, key), least, most)
        if len(self.encoder_widths) != 3:
            raise ValueError(f"encoder_widths must be three numbers, got {self.encoder_widths!r:.100}")
        for width in self.encoder_widths:
            require_between("encoder_widths", width, 1, MOST_FEATURES)
        if self.knee is not None:
            require_between("knee", self.knee, 0.0, 0.999)
        if (
            not self.stages
            or not all(isinstance(s, str) for s in self.stages)
            or len({*self.stages}) < len(self.stages)
        ):
            raise ValueError(f"stages must be one or more names, each at most once, got {self.stages!r:.100}")
        if (self.tone_atoms > 0) != ("curve" in self.stages):
            raise ValueError(f"tone_atoms must be at least 1 with the stage curve and 0 without, got {self.tone_atoms}")


SMALL = ISPConfig(colour_atoms=8, gain_atoms=8, encoder_widths=(16, 32, 64))
"""The size with at most 0.2 M parameters."""


class ISPParams(NamedTuple):
    """One camera setting per picture; replays a pass. Leading dimension B everywhere.

    Args:
        colour_weights: ``(B, N)`` weights of the colour atoms.
        gain_weights: ``(B, M)`` weights of the gain atoms; ``(B, 0)`` where the gains follow from a light.
        matrix: ``(B, 3, 3)`` sRGB to camera.
        gains: ``(B, 3)`` white balance times digital gain, forward direction.
        tone_weights: ``(B, K)`` weights of the tone curves; ``(B, 0)`` where the tone is learned.
    """

    colour_weights: Tensor
    gain_weights: Tensor
    matrix: Tensor
    gains: Tensor
    tone_weights: Tensor


@dataclass
class ISPResult:
    """Result of a pass: ``raw`` ``(B, 1, H, W)`` or ``srgb`` ``(B, 3, H, W)``, the parameters; x1 ... x5 on request."""

    image: Tensor
    params: ISPParams
    intermediates: dict[str, Tensor] = field(default_factory=dict)

    @property
    def raw(self) -> Tensor:
        return self.image

    @property
    def srgb(self) -> Tensor:
        return self.image


class ReverseISP(nn.Module, ABC):
    """A way from sRGB to RAW, and back where the method has one."""

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
        """sRGB ``(B, 3, H, W)``, uint8 or float in [0, 1], to the mosaic ``(B, 1, H, W)``."""

    def balanced(self, white_balance: tuple[float, float, float]) -> Any:
        """The setting with these as-shot multipliers R, G, B; None for a method that has no use for them."""
        return None

    def draw(self, srgb: Tensor, generator: torch.Generator) -> Tensor:
        """The mosaic under a setting drawn at random; the one of :meth:`make` where the method has no other."""
        return self.make(srgb)

    @abstractmethod
    def cycle(self, srgb: Tensor) -> Tensor:
        """sRGB to RAW and back, ``(B, 3, H, W)`` in [0, 1]."""

    def cycle_without_mosaic(self, srgb: Tensor) -> Tensor | None:
        """The same without the mosaic between the passes; None for methods that are not pointwise."""
        return None
