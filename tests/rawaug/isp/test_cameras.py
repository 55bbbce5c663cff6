"""Published cameras: white stays white, gains balance the light they are for, names are found."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rawaug.isp.cameras import colour_matrix, published_cameras, responses, white_balance
from rawaug.isp.light import D65, planckian, white_point


def test_white_stays_white_and_the_gains_make_its_raw_grey() -> None:
    cameras = published_cameras().xyz_to_camera
    white = torch.ones(3, dtype=torch.float64)
    torch.testing.assert_close(colour_matrix(cameras) @ white, torch.ones(len(cameras), 3, dtype=torch.float64))
    light = white_point(planckian(np.array(3200.0)))
    balance = white_balance(cameras[:5], light)
    grey = balance * responses(cameras[:5], light)
    torch.testing.assert_close(grey, grey[:, 1:2].expand(5, 3))
    torch.testing.assert_close(balance[:, 1], torch.ones(5, dtype=torch.float64))


def test_the_d65_balance_of_a_known_camera() -> None:
    """By hand: (0.902, -0.289, -0.0715) . (0.9504, 1, 1.0889) = 0.490, and 1.068 of green, 0.875 of blue."""
    red, _, blue = white_balance(published_cameras().named(["Nikon D750"])[0], white_point(D65)).tolist()
    assert red == pytest.approx(1.068 / 0.490, abs=0.01) and blue == pytest.approx(1.068 / 0.875, abs=0.01)


def test_tungsten_light_needs_less_red_and_more_blue() -> None:
    cameras = published_cameras().xyz_to_camera
    day = white_balance(cameras, white_point(D65))
    tungsten = white_balance(cameras, white_point((0.44758, 0.40745)))
    assert (tungsten[:, 0] < day[:, 0]).float().mean() > 0.99
    assert (tungsten[:, 2] > day[:, 2]).float().mean() > 0.99


def test_every_row_of_the_table_is_kept_or_counted() -> None:
    cameras = published_cameras()
    assert len(cameras.names) == len(cameras.xyz_to_camera)
    assert len(cameras.names) + sum(cameras.rejected.values()) == 1459
    assert cameras.rejected["four-colour sensor"] == 23
    assert cameras.xyz_to_camera.isfinite().all() and torch.linalg.det(cameras.xyz_to_camera).abs().min() > 1e-4
    assert 500 < len(cameras.distinct()) < len(cameras.names)


def test_names_are_found_whatever_their_case_and_similar_ones_suggested() -> None:
    cameras = published_cameras()
    torch.testing.assert_close(cameras.named(["nikon d750"]), cameras.named(["Nikon D750"]))
    assert cameras.named(["Nikon D750", "Sony ILCE-7M3"]).shape == (2, 3, 3)
    with pytest.raises(ValueError, match=r"'Nikon D705' is not listed; similar: .*Nikon D70"):
        cameras.named(["Nikon D705"])
