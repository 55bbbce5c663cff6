"""Points of light: their flux, colour, sharpness and density, and that a picture is the same every time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.data import open_pictures, points
from rawaug.data.points import draw_lights


def linear(picture: torch.Tensor) -> np.ndarray:
    return (picture.numpy() / 255.0) ** 2.2


def night(side: int = 96) -> torch.Tensor:
    return torch.zeros(3, side, side, dtype=torch.uint8)


def test_as_many_lights_fall_as_the_density_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of lights of one flux that are seldom on top of each other, the total is flux x density x pixels."""
    monkeypatch.setattr(points, "FLUX", (0.5, 0.5))
    monkeypatch.setattr(points, "DENSITY", (1e-3, 1e-3))
    monkeypatch.setattr(points, "_colour", lambda rng: np.ones(3))
    totals = [linear(draw_lights(night(200), np.random.default_rng(seed))).sum() / 3 for seed in range(6)]
    assert np.mean(totals) == pytest.approx(0.5 * 1e-3 * 200**2, rel=0.2)


def test_a_light_is_wider_than_a_hot_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sharpest light in the middle of a pixel leaves an eighth of its peak in each of the four beside it."""
    peak = np.outer(points._profile(5.5, 0.4), points._profile(5.5, 0.4))
    assert peak.sum() == pytest.approx(1.0, abs=1e-6)
    assert peak[5, 6] / peak[5, 5] == pytest.approx(0.133, abs=0.01)


def test_pictures_of_any_kind_get_lights_and_keep_them(tmp_path: Path) -> None:
    plain, lit = open_pictures("shapes:2"), open_pictures("lights:shapes:2")
    assert len(lit) == 2
    assert torch.equal(lit[1], lit[1])
    assert lit[1].shape == plain[1].shape and not torch.equal(lit[1], plain[1])
    with pytest.raises(FileNotFoundError):
        open_pictures(f"lights:{tmp_path / 'nothing'}")
