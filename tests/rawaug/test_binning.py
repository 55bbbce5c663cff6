"""Mosaics of any pattern at half their sides: the place of a new site, what is left of the noise, and the way back."""

from __future__ import annotations

import pytest
import torch

from rawaug.bayer import Halving, bin_mosaic, pack, pattern, to_bayer

NAMES = ("RGGB", "GRBG", "XTRANS", "XTRANS+1+4", "QUAD-GBRG")


@pytest.mark.parametrize("name", NAMES)
def test_new_sites_are_means_around_their_places(name: str) -> None:
    columns = torch.arange(96.0).expand(1, 72, 96)
    for ramp, axis in ((columns, -1), (torch.arange(72.0)[:, None].expand(1, 72, 96), -2)):
        halved = to_bayer(ramp, name)
        assert halved.shape == (1, 36, 48)
        places = 2 * torch.arange(float(halved.shape[axis])) + 0.5
        found = halved if axis == -1 else halved.transpose(-2, -1)
        # inside; of X-Trans, whose pixels lie unevenly, within 0.03 pixels
        assert (found - places)[0, 6:-6, 6:-6].abs().max() < (0.03 if "XTRANS" in name else 1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_noise_is_left_as_stated_and_colours_do_not_mix(name: str) -> None:
    height = width = 960
    noise = torch.randn(1, height, width, generator=torch.Generator().manual_seed(0))
    sites = Halving(pattern(name).planes(48, 48)[None]).variance(torch.ones(1, 1, 1, 1))[..., 2:-2, 2:-2]
    per_plane = pack(to_bayer(noise, name)[..., 4:-4, 4:-4], "RGGB").square().mean((1, 2))
    assert torch.allclose(sites.mean((0, 2, 3)), per_plane, rtol=0.04)
    red = pattern(name).mosaic(torch.tensor([0.7, 0.0, 0.0])[:, None, None].expand(3, 48, 48))
    assert torch.allclose(pack(to_bayer(red, name), "RGGB")[0], torch.tensor(0.7))
    assert not pack(to_bayer(red, name), "RGGB")[1:].any()


def test_red_and_blue_of_bayer_are_binned_as_by_bin_mosaic() -> None:
    raw = torch.rand(1, 48, 64, generator=torch.Generator().manual_seed(0))
    found, expected = (pack(x, "RGGB")[[0, 3], 1:-1, 1:-1] for x in (to_bayer(raw, "RGGB"), bin_mosaic(raw, "RGGB", 2)))
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("name", NAMES)
def test_the_way_back_puts_every_colour_in_its_place(name: str) -> None:
    halving = Halving(pattern(name).planes(72, 96)[None])
    rows, columns = torch.arange(72.0)[:, None], torch.arange(96.0)
    scene = torch.stack([rows + columns, 2 * rows + 0 * columns, 3 * columns - rows])
    back = halving.back(halving(pattern(name).mosaic(scene)[None]))
    assert (back - scene)[..., 12:-12, 12:-12].abs().max() < (0.15 if "XTRANS" in name else 1e-3)


def test_squares_of_a_colour_stay_whole() -> None:
    raw = torch.rand(1, 49, 65, generator=torch.Generator().manual_seed(0))
    assert torch.equal(to_bayer(raw, "QUAD-RGGB+1+1"), to_bayer(raw[:, 1:, 1:], "QUAD-BGGR"))


def test_what_is_too_small_is_refused() -> None:
    with pytest.raises(ValueError, match="small"):
        to_bayer(torch.zeros(1, 3, 8), "XTRANS")
