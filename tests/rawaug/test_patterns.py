"""X-Trans and Quad-Bayer: what the cells are, geometry that keeps them, and RAW in them from the augmentation."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import PATTERNS, Pattern, pattern
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.noise import ColourBias
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.dataset import RawPairs
from rawaug.plugin.draw import Draw

XTRANS = pattern("XTRANS")
patterns = st.sampled_from(list(PATTERNS.values()))
cells = st.integers(2, 4)
views = st.integers(0, bayer.N_VIEWS - 1)


def colour_map(cfa: Pattern, height: int, width: int) -> Tensor:
    """A mosaic that holds at every site the index of its own colour."""
    return cfa.mosaic(torch.arange(3.0)[:, None, None].expand(3, height, width))


def test_x_trans_has_20_green_sites_and_all_colours_in_every_row_and_column() -> None:
    cell = XTRANS.channels(6, 6)
    assert torch.bincount(cell.flatten()).tolist() == [8, 20, 8]
    for line in (*cell, *cell.T):
        assert set(line.tolist()) == {0, 1, 2}
    wrapped = torch.nn.functional.pad(cell[None, None].float(), (0, 1, 0, 1), mode="circular")[0, 0]
    greens = torch.nn.functional.avg_pool2d((wrapped == 1).float()[None, None], 2, 1)[0, 0]
    assert int((greens == 1).sum()) == 4, "squares of four green sites"


@settings(deadline=None)
@given(patterns, st.integers(4, 9), st.integers(4, 9))
def test_demosaicing_keeps_what_was_measured_and_flat_colours(cfa: Pattern, rows: int, columns: int) -> None:
    size = (2 * rows, 2 * columns)
    flat = torch.tensor([0.2, 0.5, 0.9])[None, :, None, None].expand(1, 3, *size)
    torch.testing.assert_close(cfa.demosaic(cfa.mosaic(flat)), flat)
    raw = torch.rand(1, 1, *size, generator=torch.Generator().manual_seed(rows))
    assert torch.equal(cfa.mosaic(cfa.demosaic(raw)), raw)


@pytest.mark.parametrize("cfa", list(bayer.CFA))
def test_bayer_is_a_case_and_quad_bayer_is_bayer_of_2_x_2_pixels(cfa: bayer.CFA) -> None:
    raw = torch.rand(1, 1, 12, 16, generator=torch.Generator().manual_seed(0))
    ours, theirs = pattern(cfa.value).demosaic(raw), bayer.demosaic(raw, cfa)
    torch.testing.assert_close(ours[..., 1:-1, 1:-1], theirs[..., 1:-1, 1:-1])
    rgb = torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(1))
    assert torch.equal(pattern(cfa.value).mosaic(rgb), bayer.mosaic(rgb, cfa))
    quad = pattern(f"QUAD-{cfa}").channels(8, 12)
    assert torch.equal(quad, pattern(cfa.value).channels(4, 6).repeat_interleave(2, 0).repeat_interleave(2, 1))


@given(patterns, st.integers(1, 15), st.integers(1, 15))
def test_planes_are_one_hot_and_say_what_the_mosaic_keeps(cfa: Pattern, height: int, width: int) -> None:
    planes = cfa.planes(height, width)
    assert torch.equal(planes.sum(0), torch.ones(height, width))
    rgb = torch.rand(3, height, width, generator=torch.Generator().manual_seed(height * width))
    assert torch.equal((rgb * planes).sum(0, keepdim=True), cfa.mosaic(rgb))


@given(patterns, views, cells, cells)
def test_turns_and_crops_keep_the_pattern_and_the_picture(cfa: Pattern, view: int, rows: int, columns: int) -> None:
    height, width = rows * cfa.period, columns * cfa.period
    turned = cfa.turn_keeping(colour_map(cfa, height, width), view)
    assert torch.equal(turned, colour_map(cfa, *turned.shape[-2:]))
    lost = [side - kept for side, kept in zip(sorted((height, width)), sorted(turned.shape[-2:]), strict=True)]
    assert all(sites in (0, cfa.period) for sites in lost)
    top, left = cfa.shift_after(view)
    numbered = torch.arange(float(height * width)).reshape(1, height, width)
    expected = bayer.turn(numbered, view)[..., top:, left:][..., : turned.shape[-2], : turned.shape[-1]]
    assert torch.equal(cfa.turn_keeping(numbered, view), expected)
    cropped = cfa.crop(colour_map(cfa, height, width), cfa.period, 0, height - cfa.period, width - 1)
    assert torch.equal(cropped, colour_map(cfa, *cropped.shape[-2:]))


def test_what_would_move_the_pattern_is_refused() -> None:
    mosaic = torch.zeros(1, 12, 18)
    with pytest.raises(ValueError, match="XTRANS"):
        XTRANS.crop(mosaic, 2, 6, 6, 6)
    with pytest.raises(ValueError, match="beyond"):
        XTRANS.crop(mosaic, 6, 6, 7, 6)
    with pytest.raises(ValueError, match="XTRANS"):
        XTRANS.turn_keeping(mosaic[:, 2:], 1)
    with pytest.raises(ValueError, match="too small"):
        XTRANS.turn_keeping(torch.zeros(1, 6, 6), 1)
    with pytest.raises(ValueError, match="'X-TRANS'"):
        pattern("X-TRANS")


@pytest.fixture(scope="module")
def isp() -> DictionaryISP:
    return DictionaryISP(ISPConfig(colour_atoms=3, gain_atoms=3))


@pytest.fixture(scope="module")
def srgb() -> Tensor:
    return torch.randint(256, (2, 3, 26, 38), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@pytest.mark.parametrize("name", ["XTRANS", "QUAD-GRBG"])
def test_clean_raw_is_that_of_bayer_wherever_both_keep_the_same_colour(
    isp: DictionaryISP, srgb: Tensor, name: str
) -> None:
    drawn = RawAugment(isp)(srgb, torch.Generator().manual_seed(1))
    other = RawAugment(isp, cfa=name)(srgb, torch.Generator().manual_seed(1))
    assert other.noisy.shape == other.clean.shape == other.variance.shape == (2, 1, 26, 38)
    same = pattern("RGGB").channels(26, 38) == pattern(name).channels(26, 38)
    assert 0.2 < same.float().mean() < 0.8
    assert torch.equal(other.clean[:, 0, same], bayer.unpack(drawn.clean, "RGGB")[:, 0, same])
    assert not torch.equal(other.clean[:, 0, ~same], bayer.unpack(drawn.clean, "RGGB")[:, 0, ~same])


def test_the_noise_obeys_its_law_at_every_site_of_the_mosaic(isp: DictionaryISP) -> None:
    augment = RawAugment(isp, noise=(1e-3, 1e-5), draw=Draw(sampling="chosen"), cfa="XTRANS")
    pair = augment(torch.full((1, 3, 516, 516), 128, dtype=torch.uint8))
    for plane in XTRANS.planes(516, 516):
        here = plane.bool()[None, None]
        law = (1e-3 * pair.clean[here] + 1e-5).mean()
        assert (pair.noisy - pair.clean)[here].var().item() == pytest.approx(law.item(), rel=0.02)
    torch.testing.assert_close(pair.variance, 1e-3 * pair.noisy.clamp(min=0) + 1e-5)
    assert torch.equal(
        augment.apply(torch.full((1, 3, 516, 516), 128, dtype=torch.uint8), pair.params).noisy, pair.noisy
    )


def test_a_dataset_of_x_trans_pairs_begins_every_crop_at_the_cell(isp: DictionaryISP, srgb: Tensor) -> None:
    pairs = RawPairs(list(srgb), RawAugment(isp, noise=(0.0, 0.0), cfa="XTRANS"), crop=24)
    pair = pairs[0]
    assert pair.noisy.shape == (1, 24, 24)
    assert torch.equal(pairs.replay(0, pair.params).clean, pair.clean)
    red = torch.tensor([255, 0, 0], dtype=torch.uint8)[:, None, None].expand(3, 24, 24)
    reds = RawPairs([red], RawAugment(isp, noise=(0.0, 0.0), draw=Draw(sampling="chosen"), cfa="XTRANS"), crop=24)
    clean, sites = reds[0].clean[0], XTRANS.planes(24, 24).bool()
    assert clean[sites[0]].min() > clean[sites[1]].max(), "red is not at the red sites"


def test_noise_of_four_planes_is_refused_without_them_and_another_bayer_pattern_is_one_of_its_own(
    isp: DictionaryISP,
) -> None:
    with pytest.raises(ValueError, match="planes"):
        RawAugment(isp, noise=ColourBias(1e-3), cfa="XTRANS")
    augment = RawAugment(isp, cfa="BGGR")
    assert (str(augment.isp.cfa), str(isp.cfa)) == ("BGGR", "RGGB"), "the caller's ISP stays as it is"
