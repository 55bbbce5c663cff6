"""Frames of published cameras in many lights: what they are made of, and that no scene is in both parts."""

from __future__ import annotations

import pytest
import torch
from skimage.color import rgb2gray

from rawaug.bayer import CFA
from rawaug.data import demo_photographs
from rawaug.data.pairs import Pair
from rawaug.isp.cameras import camera_from_srgb, load_cameras
from rawaug.paper.ablation import synthetic_frames
from rawaug.paper.reconstruction import overexpose, retouch

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


def grey(value: int) -> Pair:
    return Pair("g", torch.full((3, 2, 2), value, dtype=torch.uint8), torch.full((1, 2, 2), 0.3), CFA.RGGB)


def test_a_stop_doubles_the_light_of_raw_and_picture_up_to_white() -> None:
    pair = overexpose(grey(128))
    assert torch.equal(pair.raw, torch.full((1, 2, 2), 0.6))
    linear = ((128 / 255 + 0.055) / 1.055) ** 2.4  # IEC 61966-2-1
    expected = 255 * (1.055 * (2 * linear) ** (1 / 2.4) - 0.055)
    assert pair.srgb[0, 0, 0].item() == round(expected)
    bright = overexpose(overexpose(grey(200)))
    assert bright.srgb.min() == 255 and bright.raw.max() == 1.0


def test_retouching_leaves_the_raw_and_adds_contrast_and_colour() -> None:
    assert torch.equal(retouch(grey(128)).raw, grey(128).raw)
    assert retouch(grey(64)).srgb[0, 0, 0] < 64 and retouch(grey(192)).srgb[0, 0, 0] > 192
    x = 64 / 255
    assert retouch(grey(64)).srgb[1, 1, 1].item() == round(255 * (x + 0.5 * (3 * x**2 - 2 * x**3 - x)))
    colour = torch.tensor([140, 120, 110], dtype=torch.uint8).reshape(3, 1, 1).expand(3, 2, 2).contiguous()
    edited = retouch(Pair("c", colour, torch.zeros(1, 2, 2), CFA.RGGB)).srgb[:, 0, 0] / 255.0
    before = colour[:, 0, 0] / 255.0
    toned = before + 0.5 * (3 * before**2 - 2 * before**3 - before)
    luma = rgb2gray(toned.reshape(1, 1, 3).numpy()).item()  # BT.709 to four digits
    assert edited.tolist() == pytest.approx((luma + 1.3 * (toned - luma)).tolist(), abs=0.003)
