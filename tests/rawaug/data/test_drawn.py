"""Drawn pictures: the statistics of dead leaves, and shapes by seed and index."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.data import Shapes, dead_leaves, open_pictures
from rawaug.data.drawn import KINDS
from rawaug.data.folders import reports
from rawaug.data.frames import Cached

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
    with pytest.raises(ValueError, match="sources"):
        dead_leaves(64, 64, [], generator())
    with pytest.raises(ValueError, match="float32"):
        dead_leaves(64, 64, [torch.rand(3, 64, 64)], generator())
    with pytest.raises(ValueError, match="sides"):
        dead_leaves(64, 15, [WHITE], generator())


def test_a_picture_depends_on_seed_and_index_alone() -> None:
    first, again = Shapes(3, side=48), Shapes(2, side=48)
    assert first[1].shape == (3, 48, 48) and first[1].dtype == torch.uint8
    assert torch.equal(first[1], again[1])
    assert not torch.equal(first[1], first[0])
    assert not torch.equal(first[1], Shapes(3, side=48, seed=1)[1])
    assert torch.equal(first[-1], first[2])
    with pytest.raises(IndexError):
        first[3]


@pytest.mark.parametrize("kind", KINDS)
def test_a_shape_lies_around_its_centre_in_few_colours(kind: str) -> None:
    canvas = Image.new("RGB", (400, 400), (7, 7, 7))
    KINDS[kind](canvas, np.array([200.0, 180.0]), 40.0, np.random.default_rng(5))
    changed = (np.asarray(canvas) != 7).any(-1)
    rows, columns = np.nonzero(changed)
    assert abs((rows.min() + rows.max()) / 2 - 180) < 30 and abs((columns.min() + columns.max()) / 2 - 200) < 30
    colours = np.unique(np.asarray(canvas)[changed], axis=0)
    assert len(colours) <= {"stripes": 2, "lettering": 256}.get(kind, 1)


def test_the_power_spectrum_falls_as_that_of_photographs() -> None:
    pictures = torch.stack([Shapes(4, side=128)[k].float().mean(0) for k in range(4)])
    window = torch.hann_window(128)
    tiles = (pictures - pictures.mean((1, 2), keepdim=True)) * window[:, None] * window
    power = torch.fft.fft2(tiles).abs().square().mean(0)
    place = torch.fft.fftfreq(128)
    radius = (place[:, None] ** 2 + place**2).sqrt()
    low, high = (power[(radius >= a) & (radius < 2 * a)].mean().log2() for a in (0.03, 0.24))
    assert -3.2 < (high - low).item() / 3 < -1.4  # octaves


def test_sources_come_one_after_the_other(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        Image.new("RGB", (40, 30), (9, 9, 9)).save(tmp_path / name)
    pictures = open_pictures([str(tmp_path), "shapes:3"], min_side=8)
    assert len(pictures) == 5
    assert pictures[1].shape == (3, 30, 40)
    assert torch.equal(pictures[3], Shapes(2)[1])
    assert open_pictures("shapes:1", min_side=700).side == 700


def test_a_damaged_file_is_reported_behind_a_cache_and_among_others(tmp_path: Path) -> None:
    for k in range(30):
        Image.new("RGB", (40, 30), (9, 9, 9)).save(tmp_path / f"{k:02}.png")
    (tmp_path / "07.png").write_bytes(b"no picture")
    pictures = Cached(open_pictures(["shapes:1", str(tmp_path)]), megabytes=1)
    assert reports(pictures) == []
    assert pictures[8].shape == (3, 30, 40)
    (report,) = reports(pictures)
    assert "1 of 30 pictures skipped" in report and "07.png" in report


@pytest.mark.parametrize("spec", ["shapes:", "shapes:many", "shapes:0", "shapes:-1"])
def test_a_number_of_pictures_is_required(spec: str) -> None:
    with pytest.raises(ValueError, match=r"shapes:"):
        open_pictures(spec)
