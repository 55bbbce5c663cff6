"""What is drawn from a pair: readings at their own sites, and blocks where sRGB and RAW do not meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit.samples import BLOCK, block_averages, find_shift, sample_pixels
from rawaug.isp.functional import frame_coordinates

WB = (1.6, 1.0, 1.5)
SHIFTS = [(0, 0), (4, -6), (-3, 5), (7, 2), (-8, -1)]


def displaced(exact_pair: Callable[..., Pair], dy: int, dx: int, seed: int = 2) -> Pair:
    """A textured pair whose sRGB lies ``dy`` down and ``dx`` right of its RAW."""
    texture = torch.nn.functional.avg_pool2d(
        torch.rand(1, 3, 164, 196, generator=torch.Generator().manual_seed(seed)), 5, 1
    )
    texture = 0.1 + 0.8 * (texture - texture.amin()) / (texture.amax() - texture.amin())
    whole = exact_pair("whole", WB, 0, picture=texture[0])
    raw, srgb = whole.clean.mosaic[:, 16:144, 16:176], whole.srgb[:, 16 - dy : 144 - dy, 16 - dx : 176 - dx]
    return replace(whole, clean=replace(whole.clean, mosaic=raw), srgb=srgb, registered=False)


def test_readings_stand_at_their_sites_in_their_channel(exact_pairs: list[Pair]) -> None:
    samples, shots = sample_pixels(exact_pairs, 500, seed=0)
    assert samples.srgb.shape == samples.target.shape == (3, 3, 1, 500)
    assert torch.equal(samples.site.sum(1), torch.ones(3, 1, 500))
    assert ((samples.target > 0) == (samples.site > 0)).all()
    pair, coordinates = exact_pairs[1], samples.coordinates[1, :, 0]
    where = (
        (frame_coordinates(*pair.clean.mosaic.shape[-2:])[0].flatten(1).T[None] - coordinates.T[:, None])
        .abs()
        .sum(2)
        .argmin(1)
    )
    assert torch.equal(pair.clean.mosaic.flatten()[where], samples.target[1].sum(0)[0])
    assert torch.equal(pair.srgb.flatten(1)[:, where] / 255.0, samples.srgb[1, :, 0])
    assert [shot.name for shot in shots] == ["shot0", "shot1", "shot2"] and shots[1].white_balance == (2.0, 1.0, 1.2)


def test_clipped_pixels_are_drawn_but_not_known(exact_pairs: list[Pair]) -> None:
    pair = exact_pairs[0]
    raw, srgb = pair.clean.mosaic.clone(), pair.srgb.clone()
    raw[:, :40], srgb[:, 60:] = 1.0, 255
    samples, _ = sample_pixels([replace(pair, clean=replace(pair.clean, mosaic=raw), srgb=srgb)], 2000, seed=0)
    clipped = (samples.target.sum(1) >= 0.98) | (samples.srgb.amax(1) >= 0.98)
    assert 0.6 < clipped.float().mean() < 0.9
    assert torch.equal(samples.known.sum(1) == 0, clipped)
    assert (samples.cell_weight[:, 0][clipped] == 0).all()


def test_a_draw_hangs_on_seed_and_name_alone(exact_pairs: list[Pair]) -> None:
    both, _ = sample_pixels(exact_pairs, 100, seed=3)
    alone, _ = sample_pixels(exact_pairs[2:], 100, seed=3)
    other, _ = sample_pixels(exact_pairs[2:], 100, seed=4)
    assert torch.equal(both.target[2:], alone.target)
    assert not torch.equal(other.target, alone.target)


def test_noisy_readings_are_taken_only_where_they_are(exact_pair: Callable[..., Pair]) -> None:
    pair = exact_pair("noisy", WB, 0, shot_var=1e-2)
    clean, _ = sample_pixels([pair], 100, seed=0)
    noisy, _ = sample_pixels([pair], 100, seed=0, noisy=True)
    assert torch.equal(clean.srgb, noisy.srgb) and not torch.allclose(clean.target, noisy.target)
    with pytest.raises(ValueError, match=r"shot: .*noisy"):
        sample_pixels([exact_pair("shot", WB, 0)], 100, seed=0, noisy=True)


@pytest.mark.parametrize(("dy", "dx"), SHIFTS)
def test_a_shift_is_found_in_both_directions(exact_pair: Callable[..., Pair], dy: int, dx: int) -> None:
    pair = displaced(exact_pair, dy, dx)
    found = find_shift(pair.srgb, pair.clean.mosaic, pair.cfa)
    assert abs(found[0] - dy) <= 1 and abs(found[1] - dx) <= 1  # half the resolution: odd ones to a pixel
    assert (dy % 2, dx % 2) != (0, 0) or found == (dy, dx)


@pytest.mark.parametrize(("dy", "dx"), SHIFTS)
def test_blocks_show_the_same_and_know_their_place(
    exact_pair: Callable[..., Pair], camera_matrix: torch.Tensor, dy: int, dx: int
) -> None:
    pair = displaced(exact_pair, dy, dx)
    srgb, raw, clipped, places = block_averages(pair.srgb, pair.clean.mosaic, pair.cfa)
    expected = torch.einsum("ij,jhw->ihw", camera_matrix, srgb**2.2) / torch.tensor(WB)[:, None, None]
    off = ((raw - expected) / expected).abs()
    assert off.mean() < 0.03 and not clipped.any()
    found = find_shift(pair.srgb, pair.clean.mosaic, pair.cfa)
    top, left = (-min(d, 0) + 1 >> 1 << 1 for d in found)  # even, so that the pattern stays
    window = (slice(top, top + BLOCK), slice(left, left + BLOCK))
    reds = pair.clean.mosaic[0][window][0::2, 1::2]
    torch.testing.assert_close(raw[0, 0, 0], reds.mean())
    coordinates = frame_coordinates(*pair.clean.mosaic.shape[-2:])[0, :, window[0], window[1]].mean((1, 2))
    torch.testing.assert_close(places[0, :, 0, 0], coordinates)


def test_a_picture_of_another_shot_is_refused(exact_pair: Callable[..., Pair]) -> None:
    pair = displaced(exact_pair, 2, -4)
    sample_pixels([pair], 100, seed=0)
    mixed_up = replace(pair, srgb=displaced(exact_pair, 2, -4, seed=7).srgb)
    for wrong in (mixed_up, replace(pair, srgb=pair.srgb.flip(-1))):
        with pytest.raises(ValueError, match=f"{pair.name}.*correlate"):
            sample_pixels([wrong], 100, seed=0)


def test_a_block_with_one_clipped_site_is_clipped(exact_pair: Callable[..., Pair]) -> None:
    pair = displaced(exact_pair, 0, 0)
    raw = pair.clean.mosaic.clone()
    raw[0, 20, 40] = 1.0
    _, _, clipped, _ = block_averages(pair.srgb, raw, pair.cfa)
    assert clipped.nonzero().tolist() == [[20 // BLOCK, 40 // BLOCK]]
