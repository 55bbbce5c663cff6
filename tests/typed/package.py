"""A network, a noise model, a reader and a command, as another package brings them; mypy reads it, nobody runs it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Unpack

import torch
from torch import Tensor

from denoisers.network import Denoiser, Shared, conv
from rawaug.bayer import CFA
from rawaug.data import Pair, open_pairs
from rawaug.io import RawFrame
from rawaug.noise import Compose, RowNoise, ShotReadNoise, noise_levels


class Shallow(Denoiser):
    def __init__(self, width: int = 16, **shared: Unpack[Shared]) -> None:
        super().__init__({"width": width}, **shared)
        self.first, self.last = conv(self.inputs, width), conv(width, self.channels)
        self.initialise(self.seed, self.last)

    def residual(self, features: Tensor) -> Tensor:
        hidden: Tensor = self.first(features)
        correction: Tensor = self.last(hidden.relu())
        return correction


class Banded(Compose):
    def __init__(self, levels: str = "cycleisp_sidd", row_var: float = 1e-6) -> None:
        super().__init__([ShotReadNoise(noise_levels(levels)), RowNoise(row_var)])


def read_frames(path: str, split: str) -> Sequence[Pair]:
    raw = torch.load(Path(path), weights_only=True)
    return [Pair("frame", RawFrame(raw, CFA.RGGB), torch.zeros(3, *raw.shape[-2:], dtype=torch.uint8))]


def count(data: str) -> None:
    """Count the frames of a dataset."""
    print(len(open_pairs(data)))
