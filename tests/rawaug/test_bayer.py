"""Mosaics: packing and unpacking, and geometry that keeps or moves the pattern as it says."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rawaug import bayer
from rawaug.bayer import CFA

cfas = st.sampled_from(list(CFA))
views = st.integers(0, bayer.N_VIEWS - 1)
sides = st.integers(2, 8).map(lambda n: 2 * n)


def colour_map(cfa: CFA, height: int, width: int) -> torch.Tensor:
    """A mosaic that holds at every site the index of its own colour."""
    rgb = torch.arange(3.0)[:, None, None].expand(3, height, width)
    return bayer.mosaic(rgb, cfa)


def test_sites_follow_the_letters() -> None:
    assert CFA("GBRG").sites == ((1, 0), (1, 1), (0, 0), (0, 1))
    assert CFA("RGGB").channels == ((0, 1), (1, 2))


def test_unknown_pattern_names_the_known_ones() -> None:
    with pytest.raises(ValueError, match="RGGB, BGGR, GRBG, GBRG"):
        CFA("RGBG")


@given(cfas, sides, sides)
def test_pack_orders_planes_by_colour_and_unpack_inverts(cfa: CFA, height: int, width: int) -> None:
    rgb = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(height * width))
    mosaic = bayer.mosaic(rgb, cfa)
    packed = bayer.pack(mosaic, cfa)
    assert torch.equal(bayer.unpack(packed, cfa), mosaic)
    assert torch.equal(packed, bayer.pack_rgb(rgb, cfa))
    row, column = cfa.sites[1]
    assert torch.equal(packed[:, 1], rgb[:, 1, row::2, column::2])
    red_row, _ = cfa.sites[0]
    assert row == red_row  # Gr shares its row with red


@given(cfas, views, sides, sides)
def test_turn_keeping_cfa_keeps_it(cfa: CFA, view: int, height: int, width: int) -> None:
    turned = bayer.turn_keeping_cfa(colour_map(cfa, height, width), cfa, view)
    assert torch.equal(turned, colour_map(cfa, *turned.shape[-2:]))


@given(cfas, views, sides, sides)
def test_turned_names_the_pattern_of_a_bare_turn(cfa: CFA, view: int, height: int, width: int) -> None:
    turned = bayer.turn(colour_map(cfa, height, width), view)
    assert torch.equal(turned, colour_map(cfa.turned(view), *turned.shape[-2:]))


@given(views)
def test_turn_back_inverts_turn(view: int) -> None:
    image = torch.arange(24.0).reshape(1, 4, 6)
    assert torch.equal(bayer.turn_back(bayer.turn(image, view), view), image)


def test_the_eight_views_differ() -> None:
    image = torch.arange(16.0).reshape(1, 4, 4)
    assert len({tuple(bayer.turn(image, view).flatten().tolist()) for view in range(bayer.N_VIEWS)}) == bayer.N_VIEWS


@given(cfas, cfas)
def test_shift_to_reaches_the_other_pattern(a: CFA, b: CFA) -> None:
    rows, columns = a.shift_to(b)
    shifted = colour_map(a, 8, 8)[..., rows : 8 - rows, columns : 8 - columns]
    assert torch.equal(shifted, colour_map(b, *shifted.shape[-2:]))


@pytest.mark.parametrize("cfa", list(CFA))
def test_demosaic_is_exact_on_a_linear_ramp(cfa: CFA) -> None:
    y, x = torch.meshgrid(torch.arange(12.0), torch.arange(16.0), indexing="ij")
    rgb = torch.stack([0.01 * x + 0.02 * y, 0.3 + 0.01 * y, 0.5 - 0.02 * x])[None]
    out = bayer.demosaic(bayer.mosaic(rgb, cfa), cfa)
    torch.testing.assert_close(out[..., 2:-2, 2:-2], rgb[..., 2:-2, 2:-2])


def test_crop_refuses_to_move_the_pattern() -> None:
    mosaic = torch.zeros(1, 8, 8)
    assert bayer.crop(mosaic, 2, 4, 4, 4).shape == (1, 4, 4)
    with pytest.raises(ValueError, match="even"):
        bayer.crop(mosaic, 1, 0, 4, 4)
    with pytest.raises(ValueError, match="leaves the mosaic"):
        bayer.crop(mosaic, 6, 0, 4, 4)


@pytest.mark.parametrize("shape", [(1, 5, 4), (1, 4, 5)])
def test_odd_sides_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="even sides"):
        bayer.pack(torch.zeros(shape), "RGGB")
