"""Camera-consistent settings: replay, physics of white and grey, and how the hull is filled."""

from __future__ import annotations

import pytest
import torch

from rawaug.isp.camera_sampling import PLAUSIBLE_GAINS, CameraSampler, sparse_weights, unprocess
from rawaug.isp.cameras import colour_matrix, published_cameras


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_the_same_seed_draws_the_same_bits() -> None:
    sampler = CameraSampler()
    first, again, other = (sampler.sample(4, generator(seed)) for seed in (1, 1, 2))
    picture = torch.randint(256, (4, 3, 8, 8), dtype=torch.uint8)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert torch.equal(unprocess(picture, first), unprocess(picture, again))
    assert not torch.equal(first.gains, other.gains)


def test_white_fills_the_sensor_and_grey_is_divided_by_the_gains() -> None:
    setting = CameraSampler(exposure=(0.0, 0.0)).sample(8, generator())
    white = unprocess(torch.full((8, 3, 2, 2), 255, dtype=torch.uint8), setting)
    torch.testing.assert_close(white, torch.ones_like(white))
    grey = unprocess(torch.full((8, 3, 2, 2), 100, dtype=torch.uint8), setting)
    torch.testing.assert_close(grey[:, :, 0, 0] * setting.gains, setting.tone[:, 100 * 8, None].expand(8, 3))


def test_exposure_scales_what_is_not_a_highlight() -> None:
    setting = CameraSampler(exposure=(-1.0, -1.0)).sample(3, generator())
    picture = torch.full((3, 3, 2, 2), 90, dtype=torch.uint8)
    bright = unprocess(picture, setting._replace(exposure=torch.zeros(3)))
    torch.testing.assert_close(unprocess(picture, setting) * 2, bright)


def test_settings_are_of_cameras_that_can_be() -> None:
    setting = CameraSampler().sample(2000, generator())
    balance = setting.gains / setting.gains[:, 1:2]
    torch.testing.assert_close(setting.gains.amin(dim=1), torch.ones(2000))
    assert balance.min() >= PLAUSIBLE_GAINS[0] - 1e-6 and balance.max() <= PLAUSIBLE_GAINS[1] + 1e-5
    torch.testing.assert_close(setting.matrix.sum(dim=2), torch.ones(2000, 3))
    assert (setting.tone.diff(dim=1) >= 0).all()
    assert -1 <= setting.exposure.min() < -0.95 and 0.15 < setting.exposure.max() <= 0.2


def test_gains_follow_the_light() -> None:
    """Light that needs more blue needs less red: gains drawn on their own would not correlate."""
    gains = CameraSampler().sample(2000, generator()).gains
    red, blue = (gains[:, c].div(gains[:, 1]).log() for c in (0, 2))
    assert torch.corrcoef(torch.stack([red, blue]))[0, 1] < -0.5


def test_one_named_camera_has_its_own_matrix() -> None:
    setting = CameraSampler(cameras=["Nikon D750"]).sample(5, generator())
    own = colour_matrix(published_cameras().named(["Nikon D750"])).float()
    torch.testing.assert_close(setting.matrix, own.expand(5, 3, 3))
    assert setting.gains.std(dim=0).max() > 0.1


def test_weights_are_sparse_and_reach_the_corners() -> None:
    weights = sparse_weights(4000, 20, 3, generator())
    torch.testing.assert_close(weights.sum(dim=1), torch.ones(4000, dtype=torch.float64))
    assert (weights > 0).sum(dim=1).max() <= 3 and (weights >= 0).all()
    assert (weights.amax(dim=1) > 0.95).double().mean() > 0.08  # flat weights of 20 atoms: never
    torch.testing.assert_close(weights.mean(dim=0), torch.full((20,), 0.05).double(), atol=0.015, rtol=0)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(lowest, highest\)"):
        CameraSampler(exposure=(0.2, -1.0))
    with pytest.raises(ValueError, match="not listed"):
        CameraSampler(cameras=["Box Brownie"])
    green_only = torch.tensor([[[0.01, 0, 0], [0, 1.0, 0], [0, 0, 0.01]]])
    with pytest.raises(ValueError, match="gains within"):
        CameraSampler(cameras=green_only).sample(1, generator())
