"""Frames of published cameras in many lights: what they are made of, and that no scene is in both parts."""

from __future__ import annotations

import pytest
import torch

from rawaug.data import demo_photographs
from rawaug.isp.cameras import camera_from_srgb, load_cameras
from rawaug.paper.ablation import synthetic_frames

CAMERAS = ["Nikon D750", "Canon EOS 5D Mark III"]


@pytest.fixture(scope="module")
def pictures() -> list[torch.Tensor]:
    photograph = demo_photographs("train")["astronaut"]
    grey = torch.full((3, 600, 900), 128, dtype=torch.uint8)
    return [grey, photograph, photograph, grey]


def test_a_frame_is_its_cameras_and_its_lights(pictures: list[torch.Tensor]) -> None:
    frames = synthetic_frames(pictures, CAMERAS, 0, "train")
    names = ["Nikon-D750", "Canon-EOS-5D-Mark-III"] * 2
    assert [frame.name for frame in frames] == [f"train_{k:03d}_{name}" for k, name in enumerate(names)]
    assert {frame.raw.shape for frame in frames} == {(1, 288, 448)}
    matrices = camera_from_srgb(load_cameras().select(CAMERAS)).float()
    for k, frame in enumerate(frames):
        assert torch.allclose(torch.linalg.inv(frame.color_matrix), matrices[k % 2], atol=1e-4)
        assert min(frame.white_balance) == 1.0
    red, green, blue = (frames[0].raw[0, 144 + i, 224 + j] for i, j in ((0, 1), (0, 0), (1, 0)))  # GRBG
    gains = frames[0].white_balance
    assert (green / red).item() == pytest.approx(gains[0] / gains[1], rel=0.02), "grey shows the light"
    assert (green / blue).item() == pytest.approx(gains[2] / gains[1], rel=0.02)


def test_draws_go_by_seed_part_and_place(pictures: list[torch.Tensor]) -> None:
    once, again = (synthetic_frames(pictures[:2], CAMERAS, 3, "train") for _ in range(2))
    assert all(torch.equal(a.raw, b.raw) for a, b in zip(once, again, strict=True))
    lights = [synthetic_frames(pictures[:1], CAMERAS, seed, part)[0].white_balance for seed, part in SEEDS]
    assert len(set(lights)) == len(SEEDS)


SEEDS = ((3, "train"), (4, "train"), (3, "left-out"))
