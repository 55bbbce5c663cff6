"""InvISP's figure, against its formula written out with NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.paper.metrics import balanced_psnr

BALANCE = (2.0, 1.0, 1.6)


def frame(height: int, width: int) -> Pair:
    generator = torch.Generator().manual_seed(0)
    raw = torch.rand(1, height, width, generator=generator) * 0.9
    srgb = (255 * torch.rand(3, height, width, generator=generator)).to(torch.uint8)
    return Pair("f", srgb, raw, CFA.GRBG, BALANCE)


def seen(mosaic: torch.Tensor) -> np.ndarray:
    colour = bayer.demosaic(mosaic[None, None], CFA.GRBG)[0].numpy()
    return (colour * np.array([1.0, 0.5, 0.8], np.float32)[:, None, None]) ** (1 / 2.2)


def test_it_is_the_mean_over_nine_pieces_of_balanced_compressed_raw() -> None:
    pair = frame(26, 36)  # thirds at rows 0, 8, 16, 26 and columns 0, 12, 24, 36
    made = (pair.raw * 0.8 + 0.4).clamp(max=1.5)

    def make(srgb: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        found = [
            (top, left)
            for top in (0, 8, 16)
            for left in (0, 12, 24)
            if torch.equal(srgb[0], pair.srgb[:, top : top + srgb.shape[-2], left : left + srgb.shape[-1]])
        ]
        ((top, left),) = found
        assert place.shape[-2:] == srgb.shape[-2:]
        return made[None, :, top : top + srgb.shape[-2], left : left + srgb.shape[-1]]

    expected = []
    for rows in (slice(0, 8), slice(8, 16), slice(16, 26)):
        for columns in (slice(0, 12), slice(12, 24), slice(24, 36)):
            error = seen(made[0, rows, columns].clamp(max=1.0)) - seen(pair.raw[0, rows, columns])
            expected.append(-10 * np.log10((error**2).mean()))
    assert balanced_psnr(make, pair) == pytest.approx(np.mean(expected), abs=1e-3)


def test_an_unregistered_pair_is_refused() -> None:
    with pytest.raises(ValueError, match="f: is not registered pixel by pixel"):
        balanced_psnr(lambda srgb, place: srgb[:, :1].float(), replace(frame(12, 12), registered=False))
