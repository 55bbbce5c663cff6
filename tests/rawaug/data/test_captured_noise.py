from __future__ import annotations

import numpy as np
import pytest

from rawaug.data.pairs import captured_noise


@pytest.mark.parametrize(("shot_var", "read_var"), [(1e-2, 4e-4), (2e-3, 1e-6), (1e-5, 1e-3)])
@pytest.mark.parametrize("clipped", [False, True])
def test_both_levels_are_found(shot_var: float, read_var: float, clipped: bool) -> None:
    rng = np.random.default_rng(0)
    clean = rng.random((400, 500)) ** 2
    noisy = clean + rng.normal(size=clean.shape) * np.sqrt(shot_var * clean + read_var)
    found = captured_noise(clean, noisy.clip(0, 1) if clipped else noisy)
    for y in (0.05, 0.3, 0.8):
        assert found[0] * y + found[1] == pytest.approx(shot_var * y + read_var, rel=0.15 if clipped else 0.05)


def test_levels_are_positive_whatever_is_given() -> None:
    flat = np.full((8, 8), 0.5)
    assert min(captured_noise(flat, flat)) > 0 and min(captured_noise(flat, flat + 0.1)) > 0
    rng = np.random.default_rng(0)
    falling = rng.random((300, 300))
    assert min(captured_noise(falling, falling + rng.normal(size=falling.shape) * (1.1 - falling))) > 0
