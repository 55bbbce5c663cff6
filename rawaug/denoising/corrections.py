"""Sensor errors that show in a frame itself and are taken out before it is denoised.

Smooth places show by how much the two greens of a Bayer sensor differ (:mod:`rawaug.bayer.greens`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

from rawaug import bayer
from rawaug.bayer import CFA, GreenDifference
from rawaug.io.raw import RawFrame

Correction = Literal["auto", "keep"]
"""This says when to correct an error: always, never, or if it is significant."""


@dataclass(frozen=True)
class Corrected:
    """The corrections that were made to a frame.

    Attributes:
        greens: by how much its greens differ; None if that cannot be measured.
        balanced: whether the difference was taken out.
    """

    greens: GreenDifference | None = None
    balanced: bool = False

    def __str__(self) -> str:
        if self.greens is None or not self.balanced:
            return ""
        return f", greens differed by {self.greens.share:.2%} +- {self.greens.error:.2%}, balanced"


@dataclass(frozen=True)
class Corrections:
    """The errors that are taken out if they are significant, and those that are kept.

    Args:
        greens: the difference of a Bayer frame's two greens.

    Raises:
        ValueError: if a setting is none of :data:`Correction`.
    """

    greens: Correction = "auto"

    def __post_init__(self) -> None:
        if self.greens not in get_args(Correction):
            raise ValueError(f"greens: {self.greens!r} is unknown; use one of {', '.join(get_args(Correction))}")

    def __call__(self, frame: RawFrame) -> tuple[RawFrame, Corrected]:
        """Correct a frame, and say what was corrected."""
        if frame.cfa not in CFA.__members__:
            return frame, Corrected()

        greens = bayer.measure_greens(frame.mosaic, frame.cfa)
        if greens is None or not greens.significant or self.greens == "keep":
            return frame, Corrected(greens)
        mosaic = bayer.balance_greens(frame.mosaic, frame.cfa, greens)
        return replace(frame, mosaic=mosaic), Corrected(greens, balanced=True)
