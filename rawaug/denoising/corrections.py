r"""Errors of a sensor that a frame tells of itself, taken out before it is denoised.

Masked pixels tell the black level, y' = 1 - (1 - y) (white - black) / (white - masked), after which the file's level is
the true one; smooth places tell by how much the greens differ (:mod:`rawaug.bayer.greens`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal, get_args

from rawaug import bayer
from rawaug.bayer import CFA, GreenDifference
from rawaug.io.masked import MaskedPixels
from rawaug.io.raw import RawFrame

Correction = Literal["auto", "keep"]
"""Take an error out where it is significant, or keep it."""


@dataclass(frozen=True)
class Corrected:
    """What a frame told of its sensor's errors, each None if it cannot be told, and whether they were taken out."""

    greens: GreenDifference | None = None
    balanced: bool = False
    masked: MaskedPixels | None = None
    black_moved: bool = False

    def __str__(self) -> str:
        said = ""
        if self.masked is not None:
            levels = ", ".join(f"{level:.2f}" for level in self.masked.black)
            said += f", masked pixels at {levels} ({'used' if self.black_moved else 'not used'} as black level)"
        if self.greens is not None and self.balanced:
            said += f", greens differed by {self.greens.share:.2%} +- {self.greens.error:.2%}, balanced"
        return said


@dataclass(frozen=True)
class Corrections:
    """Which errors are taken out where they are significant, and which are kept.

    Args:
        greens: the difference of a Bayer frame's two greens.
        black: a black level other than that of the masked pixels.

    Raises:
        ValueError: if a setting is none of :data:`Correction`.
    """

    greens: Correction = "auto"
    black: Correction = "auto"

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value not in get_args(Correction):
                raise ValueError(f"{name}: {value!r} is unknown; use one of {', '.join(get_args(Correction))}")

    def __call__(self, frame: RawFrame) -> tuple[RawFrame, Corrected]:
        """Correct a frame, and say what was found in it."""
        moved = self.black == "auto" and frame.masked is not None and frame.masked.corrects(frame.black, frame.white)
        if frame.masked is not None and moved:
            frame = _with_black(frame, frame.masked)
        greens = bayer.measure_greens(frame.mosaic, frame.cfa) if frame.cfa in CFA.__members__ else None
        balanced = greens is not None and greens.significant and self.greens == "auto"
        if greens is not None and balanced:
            frame = replace(frame, mosaic=bayer.balance_greens(frame.mosaic, frame.cfa, greens))
        return frame, Corrected(greens, balanced, frame.masked, moved)


def _with_black(frame: RawFrame, masked: MaskedPixels) -> RawFrame:
    """The frame as if its file stated the level of the masked pixels."""
    mosaic, kinds = frame.mosaic.clone(), bayer.plane_indices(frame.cfa)
    for i, j in product(range(len(kinds)), repeat=2):
        sites, kind = mosaic[0, i :: len(kinds), j :: len(kinds)], int(kinds[i, j])
        factor = (frame.white - frame.black[kind]) / (frame.white - masked.black[kind])
        sites.sub_(1).mul_(factor).add_(1)
    return replace(frame, mosaic=mosaic)
