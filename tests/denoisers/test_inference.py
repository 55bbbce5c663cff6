"""Around a denoiser: tiles are as good as the whole, and the self-ensemble keeps the CFA."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

from denoisers import DnCNN, SelfEnsemble, UNet, denoise_tiles
from denoisers.ensemble import from_view, to_view
from rawaug import bayer


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


CFAS = list(bayer.CFA)
SIZES = [(6, 6), (5, 8), (2, 3)]


def picture(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed)) - 0.1


def identity(noisy: Tensor, variance: Tensor | None) -> Tensor:
    return noisy


@given(st.sampled_from(CFAS), st.sampled_from([4, 8]), st.integers(2, 9), st.integers(2, 9), st.integers(0, 99))
@settings(max_examples=40)
def test_identity_to_the_last_bit(cfa: bayer.CFA, views: int, height: int, width: int, seed: int) -> None:
    noisy = picture(2, 4, height, width, seed=seed)
    assert torch.equal(SelfEnsemble(identity, cfa, views)(noisy), noisy)


@pytest.mark.parametrize("cfa", CFAS)
@pytest.mark.parametrize("view", range(8))
def test_a_view_shows_the_turned_scene_through_the_same_cfa(cfa: bayer.CFA, view: int) -> None:
    # A scene whose colours differ in size: red 10, green 20, blue 30, plus small detail.
    rgb = torch.tensor([10.0, 20.0, 30.0]).reshape(1, 3, 1, 1) + picture(1, 3, 12, 16)
    seen = to_view(bayer.pack_rgb(rgb, cfa), cfa, view)
    assert torch.equal((seen / 10).round(), torch.tensor([1.0, 2.0, 2.0, 3.0]).reshape(4, 1, 1).expand_as(seen))
    # Inside the added lines it is the mosaic of the turned scene.
    mosaic = bayer.unpack(seen, cfa)
    turned = bayer.turn(bayer.mosaic(rgb, cfa), view)
    rows, columns = ((a - b) // 2 for a, b in zip(mosaic.shape[-2:], turned.shape[-2:], strict=True))
    assert torch.equal(mosaic[..., rows : rows + turned.shape[-2], columns : columns + turned.shape[-1]], turned)
    # The lines themselves are the second next to the edge: the nearest that has their colours.
    for added, axis in ((rows, -2), (columns, -1)):
        lines = [mosaic.select(axis, k) for k in (0, 2, -1, -3)]
        assert not added or (torch.equal(lines[0], lines[1]) and torch.equal(lines[2], lines[3]))
    assert torch.equal(from_view(seen, cfa, view), bayer.pack_rgb(rgb, cfa))


@pytest.mark.parametrize("cfa", CFAS)
@pytest.mark.parametrize("size", SIZES)
def test_planes_are_never_mixed(cfa: bayer.CFA, size: tuple[int, int]) -> None:
    gains = torch.tensor([2.0, 3.0, 5.0, 7.0]).reshape(4, 1, 1)
    noisy = picture(2, 4, *size)
    torch.testing.assert_close(SelfEnsemble(lambda y, _: gains * y, cfa, 4)(noisy), gains * noisy)
    # A quarter turn makes the green of the red row that of the blue row: half of the eight views use the other's gain.
    expected = torch.tensor([2.0, 4.0, 4.0, 7.0]).reshape(4, 1, 1) * noisy
    torch.testing.assert_close(SelfEnsemble(lambda y, _: gains * y, cfa, 8)(noisy), expected)


@pytest.mark.parametrize("cfa", CFAS)
def test_the_variance_map_is_turned_alike(cfa: bayer.CFA) -> None:
    noisy, variance = picture(2, 4, 5, 6), picture(2, 4, 5, 6, seed=1)

    def multiply(y: Tensor, v: Tensor | None) -> Tensor:
        assert v is not None
        return y * v

    product = SelfEnsemble(multiply, cfa)(noisy, variance)
    torch.testing.assert_close(product, noisy * variance)


def test_a_network_with_a_noise_map_passes_and_bad_settings_are_refused() -> None:
    noisy = picture(1, 4, 9, 12)
    ensemble = SelfEnsemble(UNet(width=4, scales=2), "GRBG")
    assert torch.equal(ensemble(noisy, torch.full_like(noisy, 1e-3)), noisy)
    assert ensemble.stride == 2
    with pytest.raises(ValueError, match="views must be 4"):
        SelfEnsemble(identity, "RGGB", views=2)
    with pytest.raises(ValueError, match="not a Bayer pattern"):
        SelfEnsemble(identity, "RGBG")


def test_a_model_that_changes_the_size_is_refused() -> None:
    with pytest.raises(ValueError, match="model"):
        denoise_tiles(lambda noisy, variance: noisy[..., ::2, ::2], torch.zeros(1, 4, 32, 32))
