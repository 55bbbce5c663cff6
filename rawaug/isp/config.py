"""What a dictionary ISP is made of: the configuration in the header of its file."""

from __future__ import annotations

from dataclasses import dataclass

from rawaug.bayer import CFA
from rawaug.isp.stages import HIGHLIGHT_KNEE

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
        stages: the stages in reverse order, of ``tone gamma colour gains shading`` and whatever else is registered
            (:func:`rawaug.isp.stage.register`); ``curve`` stands in place of ``tone gamma``.
        encoders: whether encoders look at the picture; if not, there are only learned constant weights.
        attention: whether the shading stage has its attention mask.
        knee: where Brooks' inverse gains start to spare highlights.
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
    knee: float = HIGHLIGHT_KNEE
    tone_atoms: int = 0
    cameras: int = 0

    def __post_init__(self) -> None:
        CFA(self.cfa)
        for key in ("stages", "encoder_widths"):  # a recipe or a file gives lists
            object.__setattr__(self, key, tuple(getattr(self, key)))
        wrong = [stage for stage in self.stages if self.stages.count(stage) > 1]
        if wrong or not self.stages:
            raise ValueError(f"stages: {wrong or 'none'}; choose one or more, each at most once")
        if len(self.encoder_widths) != 3 or min(self.colour_atoms, self.gain_atoms, *self.encoder_widths) < 1:
            raise ValueError("encoder_widths must be three numbers; they and the numbers of atoms must be at least 1")
        if (self.tone_atoms > 0) != ("curve" in self.stages):
            raise ValueError(f"tone_atoms must be at least 1 with the stage curve and 0 without, got {self.tone_atoms}")
        if not 0.0 <= self.knee < 1.0:
            raise ValueError(f"knee must be in [0, 1), got {self.knee}")


SMALL = ISPConfig(colour_atoms=8, gain_atoms=8, encoder_widths=(16, 32, 64))
"""The size with at most 0.2 M parameters."""
