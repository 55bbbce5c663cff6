"""Noise profiles by camera: interpolation hits the rows, every camera counts alike, broken rows are left out."""

from __future__ import annotations

import math

import pytest
import torch

from rawaug.noise import noise_model
from rawaug.noise.cameras import READ_ON_MOSAIC, SHOT_ON_MOSAIC, ProfileLevels, published_profiles


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("iso", "shot", "read"), [(100, 1.392e-06, 7.017e-11), (6400, 5.747e-05, 1.727e-07)])
def test_a_row_of_the_file_is_hit(iso: int, shot: float, read: float) -> None:
    """The green figures of the Sony ILCE-7M3, as they stand in profiles.tsv."""
    shot_var, read_var = ProfileLevels("Sony ILCE-7M3", iso=iso).sample(3, generator())
    torch.testing.assert_close(shot_var, torch.full((3,), shot * SHOT_ON_MOSAIC), rtol=1e-5, atol=0)
    torch.testing.assert_close(read_var, torch.full((3,), read * READ_ON_MOSAIC), rtol=1e-5, atol=0)


def test_between_two_rows_the_logarithms_are_interpolated() -> None:
    profiles = published_profiles()
    index = profiles.names.index("Sony ILCE-7M3")
    (x0, x1), (s0, s1), _ = profiles.table[:, index, 2:4].tolist()
    iso = math.exp(0.25 * x0 + 0.75 * x1)
    shot_var, _ = ProfileLevels("sony ilce-7m3", iso=iso).sample(1, generator())
    assert shot_var.item() == pytest.approx(math.exp(0.25 * s0 + 0.75 * s1), rel=1e-5)


def test_levels_stay_within_the_profile_and_replay() -> None:
    profiles = published_profiles()
    levels = ProfileLevels("Nikon D750")
    shot_var, read_var = levels.sample(2000, generator(3))
    index = profiles.names.index("Nikon D750")
    shot = profiles.table[1, index, : profiles.rows[index]].exp()
    assert shot.min() * 0.999 <= shot_var.min() <= shot.min() * 1.1
    assert shot.max() * 0.9 <= shot_var.max() <= shot.max() * 1.001
    assert all(torch.equal(a, b) for a, b in zip(levels.sample(2000, generator(3)), (shot_var, read_var), strict=True))


def test_any_camera_draws_each_camera_alike() -> None:
    levels = ProfileLevels("any camera")
    assert len(levels.cameras) == len(published_profiles().names) == 369
    one_row = published_profiles().rows == 1
    fixed = published_profiles().table[1, one_row, 0].exp().float()
    shot_var, _ = levels.sample(200_000, generator())
    hits = torch.isclose(shot_var[:, None], fixed, rtol=1e-6, atol=0).float().mean(dim=0)
    torch.testing.assert_close(hits, torch.full_like(hits, 1 / 369), atol=5e-4, rtol=0)


def test_limits_of_iso_leave_out_the_cameras_without_a_share() -> None:
    profiles = published_profiles()
    high = ProfileLevels("any camera", iso=(51_200, 102_400))
    ends = profiles.limits()[:, 1].exp()
    assert len(high.cameras) == int((ends > 51_199).sum()) < 150
    assert (
        high.sample(500, generator())[0].median()
        > 20 * ProfileLevels("any camera", iso=400).sample(500, generator())[0].median()
    )


def test_names_reach_the_noise_model() -> None:
    params = noise_model("any camera").sample(4, generator())
    clean = torch.full((4, 4, 8, 8), 0.2)
    assert torch.equal(noise_model("any camera").apply(clean, params), noise_model("Any Camera").apply(clean, params))
    with pytest.raises(ValueError, match="similar: Nikon D750"):
        noise_model("Nikon D 750")
    with pytest.raises(ValueError, match=r"ISO 50 is outside the measured range of Sony ILCE-7M3"):
        noise_model("Sony ILCE-7M3", iso=50)
