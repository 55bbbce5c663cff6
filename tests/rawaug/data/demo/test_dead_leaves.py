from __future__ import annotations

import numpy as np
import pytest
import torch

from rawaug.data import dead_leaves

BLACK, WHITE = torch.zeros(3, 72, 72, dtype=torch.uint8), torch.full((3, 72, 72), 255, dtype=torch.uint8)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(seed: int) -> torch.Tensor:
    return torch.randint(0, 256, (3, 80, 90), dtype=torch.uint8, generator=generator(seed))


def test_the_same_generator_gives_the_same_picture() -> None:
    first, again = (dead_leaves(50, 71, [noise(1), noise(2)], generator(5)) for _ in range(2))
    assert first.shape == (3, 50, 71) and first.dtype == torch.uint8
    assert torch.equal(first, again)
    assert not torch.equal(first, dead_leaves(50, 71, [noise(1), noise(2)], generator(6)))


def test_everything_is_covered_by_the_sources() -> None:
    sources = [torch.full((3, 64, 64), level, dtype=torch.uint8) for level in (100, 140)]
    picture = dead_leaves(64, 96, sources, generator())
    assert picture.min() == 100 and picture.max() == 140
    assert 105 < picture.float().mean() < 135


def test_edges_are_smooth() -> None:
    picture = dead_leaves(64, 96, [BLACK, WHITE], generator())
    assert set(picture.unique().tolist()) == {0, 64, 128, 191, 255}


def test_pixels_share_a_leaf_as_often_as_the_model_says() -> None:
    """P(same leaf at distance h) = g(h) / (2 g(0) - g(h)), g the mean area of a disk and its copy moved by h."""
    r = np.linspace(4.0, 17.5, 20001)  # sources of side 72 allow (72 / 2 - 1) / 2
    weight = r**-3 / (r**-3).sum()

    def overlap(h: int) -> float:
        half = np.clip(h / (2 * r), 0, 1)
        return float((weight * 2 * r**2 * (np.arccos(half) - half * np.sqrt(1 - half**2))).sum())

    signs = torch.stack([dead_leaves(192, 192, [BLACK, WHITE], generator(seed))[0] for seed in range(8)]) / 127.5 - 1
    for lag in (4, 8, 16):
        expected = overlap(lag) / (2 * overlap(0) - overlap(lag))
        for axis in (1, 2):
            near, far = signs.narrow(axis, 0, 192 - lag), signs.narrow(axis, lag, 192 - lag)
            assert (near * far).mean().item() == pytest.approx(expected, abs=0.03)


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match=r"dead leaves need sources \(0\)"):
        dead_leaves(64, 64, [], generator())
    with pytest.raises(
        ValueError, match=r"a source must be uint8 \(3, h, w\) with sides of at least 32, got torch.float32"
    ):
        dead_leaves(64, 64, [torch.rand(3, 64, 64)], generator())
    with pytest.raises(ValueError, match=r"sides of at least 16 \(64 x 15\)"):
        dead_leaves(64, 15, [WHITE], generator())
