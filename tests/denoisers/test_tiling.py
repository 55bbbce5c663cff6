"""Tiles give the untiled result, at any size, wherever the overlap covers the receptive radius."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from denoisers import DnCNN, SelfEnsemble, UNet, tiled
from denoisers.inference import _pieces


def pair(*shape: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(shape, generator=generator), torch.rand(shape, generator=generator) * 1e-2


def awake(model: DnCNN | UNet) -> DnCNN | UNet:
    model.initialise(3)
    return model.eval()


@given(
    size=st.integers(2, 400),
    stride=st.sampled_from([1, 4, 16]),
    tile=st.integers(3, 8),
    overlap=st.integers(0, 3),
)
@settings(max_examples=200, deadline=None)
def test_starts_are_aligned_and_leave_no_gap(size: int, stride: int, tile: int, overlap: int) -> None:
    tile, overlap = tile * stride, min(overlap, (tile - 1) // 2) * stride
    starts, side = _pieces(size, tile, overlap, stride)
    assert side <= tile and side % stride == 0 and side > 2 * overlap
    assert starts[0] == 0 and all(start % stride == 0 for start in starts)
    assert starts[-1] + side >= size and (starts == [0] or size - starts[-1] > side - stride)
    # The part of a tile that is kept begins where the one before still had its context.
    assert all(b + overlap <= a + side - overlap for a, b in pairwise(starts))
    assert starts == sorted(set(starts))


@pytest.mark.parametrize("size", [(70, 41), (33, 90), (16, 16), (7, 100), (2, 2)])
def test_convolutions_are_seamless(size: tuple[int, int]) -> None:
    model = awake(DnCNN(width=6, depth=5, batch_norm=False))
    noisy, variance = pair(2, 4, *size)
    whole = model(noisy, variance)
    assert (tiled(model, noisy, variance, tile=24, overlap=5) - whole).abs().max() < 1e-5
    assert min(size) < 24 or (tiled(model, noisy, variance, tile=24, overlap=2) - whole).abs().max() > 1e-4


def test_no_seam_at_any_size_around_that_of_a_tile() -> None:
    model = awake(DnCNN(width=4, depth=3, batch_norm=False))
    with torch.no_grad():
        for side in range(2, 40):  # tiles of 16 with an overlap of 3: one tile, just more than one, up to four
            noisy, variance = pair(1, 4, side, 5)
            for turned in (lambda x: x, lambda x: x.transpose(-1, -2)):
                whole = model(turned(noisy), turned(variance))
                pieces = tiled(model, turned(noisy), turned(variance), tile=16, overlap=3)
                assert (pieces - whole).abs().max() < 1e-5, f"a seam at a side of {side}"


@pytest.mark.parametrize("side", [383, 384, 385, 387, 400, 513, 640, 2000])
def test_equal_tiles_are_no_more_than_needed(side: int) -> None:
    starts, length = _pieces(side, 384, 64, 16)
    assert len(starts) == max(1, -(-(side - 128) // 256))
    assert len(starts) == 1 or len(starts) * (length - 128) - (side - 128) < 16 * len(starts)


@pytest.mark.parametrize("size", [(100, 61), (64, 128), (35, 30), (63, 65), (80, 81), (129, 127)])
def test_pooling_grids_fall_together(size: tuple[int, int]) -> None:
    model = awake(UNet(width=4, scales=2))  # receptive radius below 24
    noisy, variance = pair(1, 4, *size)
    whole = model(noisy, variance)
    assert (tiled(model, noisy, variance, tile=64, overlap=24) - whole).abs().max() < 1e-5


def test_every_piece_is_at_most_a_tile_and_no_gradient_is_kept() -> None:
    sizes = []

    class Note(nn.Module):
        def forward(self, noisy: Tensor, variance: Tensor | None) -> Tensor:
            assert variance is None and not torch.is_grad_enabled()
            sizes.append(tuple(noisy.shape[-2:]))
            return noisy

    noisy, _ = pair(1, 4, 300, 130)
    assert torch.equal(tiled(Note(), noisy.requires_grad_(), tile=64, overlap=8), noisy)
    assert set(sizes) == {(64, 54)}  # seven equal tiles by three


def test_tiles_of_an_ensemble_align_with_its_network() -> None:
    noisy, variance = pair(1, 4, 40, 56)
    ensemble = SelfEnsemble(UNet(width=4, scales=3), "RGGB")
    assert torch.equal(tiled(ensemble, noisy, variance, tile=32, overlap=8), noisy)
    with pytest.raises(ValueError, match="multiples of the model's stride 4"):
        tiled(ensemble, noisy, variance, tile=32, overlap=6)


def test_a_tile_is_at_least_two_strides() -> None:
    with pytest.raises(ValueError, match="tile must be at least 16"):
        tiled(UNet(width=4, scales=4), torch.zeros(1, 4, 17, 17), tile=8, overlap=0)


@pytest.mark.parametrize("overlap", [-1, 16, 20])
def test_an_overlap_that_leaves_nothing_is_refused(overlap: int) -> None:
    with pytest.raises(ValueError, match="less than half the tile"):
        tiled(nn.Identity(), torch.zeros(1, 4, 8, 8), tile=32, overlap=overlap)


def test_tiles_are_gone_through_one_by_one_for_whoever_counts() -> None:
    seen, noisy = [], torch.rand(1, 4, 100, 60)

    def each(parts: Sequence[Any]) -> Iterator[Any]:
        for part in parts:
            yield part
            seen.append(len(parts))

    assert torch.equal(tiled(lambda y, _: y, noisy, tile=64, overlap=8, each=each), noisy)
    assert seen == [2, 2]
    SelfEnsemble(lambda y, _: y, "RGGB", each=each)(noisy)
    assert len(seen) > 4 and set(seen[2:]) == {len(seen) - 2}
