"""What a denoiser is trained and scored on: packed noisy RAW, its clean version and the variance of its noise."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Sample(NamedTuple):
    """What a denoiser is trained on, packed ``(4, h, w)`` (in a batch ``(B, 4, h, w)``)."""

    noisy: Tensor
    clean: Tensor
    variance: Tensor
