"""Tiles are as good as the whole picture."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from denoisers import DnCNN, UNet, denoise_tiles


def pair(*shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator) * 1e-2


def awake(model: DnCNN | UNet) -> DnCNN | UNet:
    model.initialise(3)
    return model.eval()


@pytest.mark.parametrize("size", [(70, 41), (33, 90), (16, 16), (7, 100), (2, 2)])
def test_convolutions_are_seamless(size: tuple[int, int]) -> None:
    model = awake(DnCNN(width=6, depth=5, batch_norm=False))
    noisy, variance = pair(2, 4, *size)
    whole = model(noisy, variance)
    assert (denoise_tiles(model, noisy, variance, tile=24, overlap=5) - whole).abs().max() < 1e-5
    assert min(size) < 24 or (denoise_tiles(model, noisy, variance, tile=24, overlap=2) - whole).abs().max() > 1e-4


def test_no_seam_at_any_size_around_that_of_a_tile() -> None:
    model = awake(DnCNN(width=4, depth=3, batch_norm=False))
    with torch.no_grad():
        for side in range(2, 40):  # tiles of 16 with an overlap of 3: one tile, just more than one, up to four
            noisy, variance = pair(1, 4, side, 5)
            for turned in (lambda x: x, lambda x: x.transpose(-1, -2)):
                whole = model(turned(noisy), turned(variance))
                pieces = denoise_tiles(model, turned(noisy), turned(variance), tile=16, overlap=3)
                assert (pieces - whole).abs().max() < 1e-5, f"a seam at a side of {side}"


@pytest.mark.parametrize("size", [(100, 61), (64, 128), (35, 30), (63, 65), (80, 81), (129, 127)])
def test_pooling_grids_fall_together(size: tuple[int, int]) -> None:
    model = awake(UNet(width=4, scales=2))  # receptive radius below 24
    noisy, variance = pair(1, 4, *size)
    whole = model(noisy, variance)
    assert (denoise_tiles(model, noisy, variance, tile=64, overlap=24) - whole).abs().max() < 1e-5


def test_every_piece_is_at_most_a_tile_and_no_gradient_is_kept() -> None:
    sizes = []

    class Note(nn.Module):
        def forward(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
            assert variance is None and not torch.is_grad_enabled()
            sizes.append(tuple(noisy.shape[-2:]))
            return noisy

    noisy, _ = pair(1, 4, 300, 130)
    assert torch.equal(denoise_tiles(Note(), noisy.requires_grad_(), tile=64, overlap=8), noisy)
    assert set(sizes) == {(64, 54)}  # seven equal tiles by three


def test_tiles_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="tile"):
        denoise_tiles(UNet(width=4, scales=4), torch.zeros(1, 4, 17, 17), tile=8, overlap=0)
    for overlap in (-1, 16, 20):
        with pytest.raises(ValueError, match="less"):
            denoise_tiles(nn.Identity(), torch.zeros(1, 4, 8, 8), tile=32, overlap=overlap)


def test_a_model_that_changes_the_size_is_refused() -> None:
    with pytest.raises(ValueError, match="model"):
        denoise_tiles(lambda noisy, variance: noisy[..., ::2, ::2], torch.zeros(1, 4, 32, 32))
