"""A turned and shifted exposure comes back to the reference, and what moved in the scene is recognised."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from rawaug.data.demo import demo_photographs
from rawaug.io.pictures import decode_srgb
from rawaug.isp.alignment import find_contradictions, find_motion, move_back
from rawaug.isp.config import ISPConfig
from rawaug.isp.exposures import merge_exposures
from rawaug.isp.model import DictionaryISP


@pytest.fixture(scope="module")
def scene() -> Tensor:
    """Linear light ``(3, 400, 600)``."""
    return decode_srgb(demo_photographs("test")["coffee"].float() / 255)


def moved(scene: Tensor, degrees: float, shift: tuple[float, float]) -> Tensor:
    """The scene as a camera sees it that was turned and shifted."""
    angle = math.radians(degrees)
    matrix = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    planes = [ndimage.affine_transform(plane, matrix, shift, order=3, mode="reflect") for plane in scene.numpy()]
    return torch.from_numpy(np.stack(planes)).clamp_min(0)


def test_a_turn_and_a_shift_are_found_in_spite_of_exposure_and_noise(scene: Tensor) -> None:
    generator = torch.Generator().manual_seed(0)
    noise = 0.02 * scene[1].sqrt() * torch.randn(scene[1].shape, generator=generator)
    light = moved(scene, 0.2, (3.4, -2.2)) + noise
    motion = find_motion(scene[1], light[1] * 1.15, torch.ones_like(scene[1]))

    back = move_back(moved(scene, 0.2, (3.4, -2.2))[None], motion)[0]
    inside = (slice(None), slice(20, -20), slice(20, -20))
    residual = (back - scene)[inside].square().mean()
    assert residual < 0.04 * (moved(scene, 0.2, (3.4, -2.2)) - scene)[inside].square().mean()
    left = find_motion(scene[1], back[1].clamp_min(0), torch.ones_like(scene[1]))
    assert left.pixels < 0.6


def test_what_moved_in_the_scene_contradicts_and_noise_does_not(scene: Tensor) -> None:
    generator = torch.Generator().manual_seed(0)
    noisy = scene + 0.03 * scene.sqrt() * torch.randn(scene.shape, generator=generator)
    walker = noisy.clone()
    walker[:, 100:160, 200:240] = torch.tensor([0.6, 0.1, 0.1])[:, None, None]
    clear = torch.ones(1, 1, *scene.shape[1:])

    assert find_contradictions(scene[None], noisy[None], clear).mean() < 0.01
    mask = find_contradictions(scene[None], walker[None], clear)[0, 0]
    assert mask[108:152, 208:232].mean() > 0.95
    mask[84:176, 184:256] = 0
    assert mask.mean() < 0.01


def test_a_merged_bracket_has_the_reference_where_nothing_else_saw_the_scene(scene: Tensor) -> None:
    isp = DictionaryISP(ISPConfig(attention=False))
    pictures = [scene[None] * 0.5, moved(scene, 0.0, (0.0, 60.0))[None] * 0.25]
    clear = torch.ones_like(scene[1])
    motions = [find_motion(scene[1], light[0, 1], clear) for light in pictures]
    merged = merge_exposures(isp, pictures, (0.0, -1.0), motions).image
    assert merged.isfinite().all()
    alone = merge_exposures(isp, pictures[:1], (0.0,)).image
    assert torch.allclose(merged[..., :50], alone[..., :50], atol=1e-4), "beyond the other one's frame"
