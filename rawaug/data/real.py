"""``real:``, nine RAW frames of three cameras that travel with the package: references, and a fit's first material.

They are photographs of colour charts, a printed strip and a product's box by a Canon PowerShot S40 and G2 and a GoPro
HERO7, binned 4 x 4 by colour site (``python -m benchmarks.real_frames`` makes them). ``train`` has three scenes of the
S40, ``validation`` the G2, ``test`` two other scenes of the S40 and the HERO7: no scene of a camera is in two splits.
There is no noisy frame, so that noise is added; the picture of a pair is a plain development, without the camera's tone
curve. ``real_frames/LICENCE.md`` names source and licence (CC0).
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rawaug.bayer import CFA, unpack
from rawaug.data.development import develop_mosaic
from rawaug.data.pairs import LazyPairs, Pair, require_split
from rawaug.io.pictures import read_plane
from rawaug.registry import DATASETS

FRAMES = Path(__file__).with_name("real_frames")
FACTOR = 4
BLACK, WHITE = 512, 16383
"""Of the PNGs. Below black lies what is left of the noise there."""


@DATASETS.register("real")
class RealFrames(LazyPairs):
    """The frames of a split; ``own_noise`` of each pair is what is left of the noise of its reference.

    Args:
        path: the split, as in ``real:train``; by default ``split``.
        split: ``"train"``, ``"validation"`` or ``"test"``.

    Raises:
        ValueError: if there is no such split.

    Example:
        >>> pair = RealFrames(split="test")[0]
        >>> pair.name, pair.camera, pair.raw.shape
        ('s40_0117', 'Canon PowerShot S40', torch.Size([1, 430, 578]))
    """

    def __init__(self, path: str = "", split: str = "test") -> None:
        split = path or split
        require_split("real", split, ("train", "validation", "test"))
        super().__init__([name for name, frame in _frames().items() if frame["split"] == split])

    def read(self, index: int) -> Pair:
        name = self.names[index]
        known = _frames()[name]
        cfa, gains, matrix = CFA(known["cfa"]), tuple(known["white_balance"]), torch.tensor(known["color_matrix"])
        numbers = read_plane(FRAMES / f"{name}.png").astype(np.float32)
        planes = torch.from_numpy((numbers - BLACK) / (WHITE - BLACK)).reshape(4, -1, numbers.shape[-1])
        raw = unpack(planes, cfa)
        return Pair(
            name=name,
            srgb=develop_mosaic(raw, cfa, gains, matrix),
            raw=raw,
            cfa=cfa,
            white_balance=gains,
            color_matrix=matrix,
            camera=known["camera"],
            iso=known["iso"],
            own_noise=tuple(known["own_noise"]),
        )


@cache
def _frames() -> dict[str, dict[str, Any]]:
    frames: dict[str, dict[str, Any]] = json.loads((FRAMES / "frames.json").read_text(encoding="utf-8"))
    return frames
