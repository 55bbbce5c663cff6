"""The self-ensemble keeps the CFA, and turns every view back."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from denoisers import SelfEnsemble, UNet
from denoisers.ensemble import from_view, to_view
from rawaug import bayer

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
