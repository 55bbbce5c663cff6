"""Published cameras: white stays white, gains balance the light they are for, names are found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rawaug.camera.lights import (
    D65,
    LAMPS,
    PHOTOGRAPHS,
    Array,
    LightRange,
    daylight,
    move_off_locus,
    planckian,
    sample_lights,
    white_point,
)
from rawaug.camera.matrices import camera_from_srgb, gains_in_light, load_cameras, responses


def test_white_stays_white_and_the_gains_make_its_raw_grey() -> None:
    cameras = load_cameras().xyz_to_camera
    white = torch.ones(3, dtype=torch.float64)
    torch.testing.assert_close(camera_from_srgb(cameras) @ white, torch.ones(len(cameras), 3, dtype=torch.float64))
    light = white_point(planckian(np.array(3200.0)))
    balance = gains_in_light(cameras[:5], light)
    grey = balance * responses(cameras[:5], light)
    torch.testing.assert_close(grey, grey[:, 1:2].expand(5, 3))
    torch.testing.assert_close(balance[:, 1], torch.ones(5, dtype=torch.float64))


def test_the_d65_balance_of_a_known_camera() -> None:
    """By hand: (0.902, -0.289, -0.0715) . (0.9504, 1, 1.0889) = 0.490, and 1.068 of green, 0.875 of blue."""
    red, _, blue = gains_in_light(load_cameras().select(["Nikon D750"])[0], white_point(D65)).tolist()
    assert red == pytest.approx(1.068 / 0.490, abs=0.01) and blue == pytest.approx(1.068 / 0.875, abs=0.01)


def test_tungsten_light_needs_less_red_and_more_blue() -> None:
    cameras = load_cameras().xyz_to_camera
    day = gains_in_light(cameras, white_point(D65))
    tungsten = gains_in_light(cameras, white_point((0.44758, 0.40745)))
    assert (tungsten[:, 0] < day[:, 0]).float().mean() > 0.99
    assert (tungsten[:, 2] > day[:, 2]).float().mean() > 0.99


def test_the_plausible_rows_of_the_table_are_kept() -> None:
    cameras = load_cameras()
    assert len(cameras.names) == len(cameras.xyz_to_camera) == 1427
    assert cameras.xyz_to_camera.isfinite().all() and torch.linalg.det(cameras.xyz_to_camera).abs().min() > 1e-4


def test_names_are_found_whatever_their_case_and_similar_ones_suggested() -> None:
    cameras = load_cameras()
    torch.testing.assert_close(cameras.select(["nikon d750"]), cameras.select(["Nikon D750"]))
    assert cameras.select(["Nikon D750", "Sony ILCE-7M3"]).shape == (2, 3, 3)
    with pytest.raises(ValueError, match="D705"):
        cameras.select(["Nikon D705"])


def kelvin(*values: float) -> Array:
    return np.array(values)


def uv(xy: Array) -> Array:
    return np.stack([4 * xy[..., 0], 6 * xy[..., 1]], -1) / (-2 * xy[..., 0] + 12 * xy[..., 1] + 3)[..., None]


def mccamy(xy: Array) -> Array:
    """Colour temperature of a chromaticity (McCamy 1992): independent of the loci here."""
    n = (xy[:, 0] - 0.3320) / (xy[:, 1] - 0.1858)
    return -449 * n**3 + 3525 * n**2 - 6823.3 * n + 5520.33


def test_the_loci_pass_through_the_cie_illuminants() -> None:
    np.testing.assert_allclose(planckian(kelvin(2855.5)), kelvin(0.44758, 0.40745)[None], atol=5e-4, rtol=0)
    np.testing.assert_allclose(daylight(kelvin(6504.0)), kelvin(*D65)[None], atol=2e-4, rtol=0)
    np.testing.assert_allclose(daylight(kelvin(5003.0)), kelvin(0.34567, 0.35850)[None], atol=2e-4, rtol=0)
    np.testing.assert_allclose(daylight(kelvin(7504.0)), kelvin(0.29902, 0.31485)[None], atol=2e-4, rtol=0)


def test_a_step_off_the_locus_has_its_length_and_is_greener_when_positive() -> None:
    t, duv = kelvin(2500, 4000, 8000), kelvin(0.005, 0.005, 0.005)
    on = planckian(t)
    off = move_off_locus(on, t, duv)
    np.testing.assert_allclose(np.linalg.norm(uv(off) - uv(on), axis=1), duv, rtol=1e-6, atol=0)
    assert (off[:, 1] > on[:, 1]).all()
    np.testing.assert_allclose(mccamy(off), t, rtol=0.03, atol=0)


def test_tabulated_lamps_are_whites() -> None:
    xy = kelvin(*[value for pair in LAMPS.values() for value in pair]).reshape(-1, 2)
    t = mccamy(xy)
    assert len(LAMPS) == 21 and t.min() > 2600 and t.max() < 6700
    assert np.linalg.norm(uv(xy) - uv(planckian(t)), axis=1).max() < 0.012


def test_draws_are_uniform_in_mired_within_the_limits() -> None:
    white = sample_lights(20_000, torch.Generator().manual_seed(0), LightRange((2500.0, 8000.0), lamps=0.0))
    xy = white[:, :2] / white.sum(axis=1, keepdims=True)
    mired = 1e6 / mccamy(xy)
    assert abs(np.median(mired) - 0.5 * (1e6 / 2500 + 1e6 / 8000)) < 8
    assert (white[:, 1] == 1).all()


def test_both_loci_and_lamps_are_drawn() -> None:
    generator = torch.Generator().manual_seed(1)
    at_6500 = sample_lights(4000, generator, LightRange((6500.0, 6500.0), lamps=0.0))
    above = at_6500[:, 2] - white_point(planckian(kelvin(6500.0)))[0, 2].item()
    below = at_6500[:, 2] - white_point(D65)[2].item()
    assert (abs(above) < abs(below)).mean() == pytest.approx(0.5, abs=0.1)
    warm = sample_lights(4000, generator, LightRange((2000.0, 2000.0), lamps=0.25))
    assert (warm[:, 2] > 0.24).mean() == pytest.approx(0.25, abs=0.03)  # no 2000 K light is so blue


def test_most_photographs_are_lit_by_day() -> None:
    white = sample_lights(20_000, torch.Generator().manual_seed(0), PHOTOGRAPHS)
    kelvins = mccamy(white[:, :2] / white.sum(axis=1, keepdims=True))
    assert 0.75 < ((kelvins > 4000) & (kelvins < 6800)).mean() < 0.9
    assert (kelvins < 2857).mean() < 0.08 and kelvins.min() < 2300 and kelvins.max() > 8500
