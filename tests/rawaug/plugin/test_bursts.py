"""Bursts: one scene, moved, with noise of its own in every frame."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.data import DataLoader

from rawaug import Burst, DictionaryISP, Draw, RawAugment, RawPairs, Srgb
from rawaug.bayer import pack_rgb
from rawaug.isp.config import ISPConfig
from rawaug.isp.stages import LensShading
from rawaug.metrics import psnr
from rawaug.noise import DefectPixels, RowNoise
from rawaug.plugin.targets import move

N = 8


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def srgb() -> Tensor:
    coarse = torch.rand(2, 3, 12, 16, generator=seeded())
    return (F.interpolate(coarse, size=(96, 128), mode="bicubic").clamp(0, 1) * 255).to(torch.uint8)


def test_the_mean_of_still_frames_gains_ten_log_n(universal: DictionaryISP, srgb: Tensor) -> None:
    pair = RawAugment(universal, noise=(1e-4, 1e-4), burst=Burst(N, motion=(0, 0)))(srgb, seeded())
    assert pair.noisy.shape == pair.variance.shape == (2, N, 4, 48, 64) and pair.clean.shape == (2, 4, 48, 64)
    one, mean = psnr(pair.noisy[:, 0], pair.clean), psnr(pair.noisy.mean(1), pair.clean)
    assert (mean - one).mean().item() == pytest.approx(10 * math.log10(N), abs=0.2)


def test_the_first_frame_is_the_single_one(universal: DictionaryISP, srgb: Tensor) -> None:
    single, pair = RawAugment(universal)(srgb, seeded()), RawAugment(universal, burst=3)(srgb, seeded())
    assert torch.equal(pair.clean, single.clean)
    assert not torch.equal(pair.noisy[:, 0] - pair.clean, pair.noisy[:, 1] - pair.clean)


def test_defects_of_the_sensor_stay_and_its_noise_does_not(universal: DictionaryISP, srgb: Tensor) -> None:
    for noise, same in ((DefectPixels(dead=0.02, hot=0.02), True), (RowNoise(1e-4), False)):
        pair = RawAugment(universal, noise=noise, burst=Burst(2, motion=(0, 0)))(srgb, seeded())
        assert not torch.equal(pair.noisy[:, 0], pair.clean)
        assert torch.equal(pair.noisy[:, 0], pair.noisy[:, 1]) == same


@pytest.mark.parametrize("attention", [False, True])
def test_the_shading_of_the_lens_does_not_move_with_the_scene(attention: bool) -> None:
    isp = DictionaryISP(ISPConfig(attention=attention))
    lens = isp.stages.find(LensShading)
    assert lens is not None
    lens.mask.set(torch.tensor([0.1, 0.0]), torch.tensor([[9.0, 2.0], [2.0, 5.0]]))
    if lens.reverse_attention is not None:
        for layers in (lens.reverse_attention.layers, lens.reverse_attention.place_layers):
            list(layers.parameters())[-2].data.normal_(std=0.1, generator=seeded())
    wall = torch.full((1, 3, 64, 96), 0.5)
    pair = RawAugment(isp, noise=(0.0, 0.0), burst=Burst(3, motion=(8.0, 4.0)))(wall, seeded())
    still = RawAugment(isp, noise=(0.0, 0.0))(wall, seeded())
    assert still.clean.std() > 0.05 * still.clean.mean()
    torch.testing.assert_close(pair.noisy, still.clean[:, None].expand_as(pair.noisy), atol=1e-4, rtol=0)


def undone(frames: Tensor, motion: Tensor) -> Tensor:
    """Frames ``(B, N, 3, H, W)`` where the first one is, without their margins."""
    dy, dx, angle = motion.flatten(0, 1).unbind(1)
    back = torch.stack([angle.sin() * dx - angle.cos() * dy, -angle.sin() * dy - angle.cos() * dx, -angle], dim=1)
    return move(frames.flatten(0, 1), back).unflatten(0, frames.shape[:2])[..., 16:-16, 16:-16]


def test_a_frame_shows_the_scene_where_its_motion_says() -> None:
    """``R(angle) (p - c) + c + (dy, dx)`` in rows that go down: after a quarter turn what was below is on the right."""
    scene = torch.rand(1, 3, 24, 24, generator=seeded())
    turned = move(scene, torch.tensor([[0.0, 0.0, math.pi / 2]]))
    torch.testing.assert_close(turned, torch.rot90(scene, 1, (-2, -1)), atol=1e-3, rtol=0)
    both = move(scene, torch.tensor([[3.0, -2.0, math.pi / 2]]))
    inner = (..., slice(6, 18), slice(6, 18))
    torch.testing.assert_close(
        both[inner], torch.rot90(scene.roll((-3, 2), (-2, -1)), 1, (-2, -1))[inner], atol=1e-3, rtol=0
    )


@pytest.mark.parametrize("target", ["raw", "rgb"])
def test_a_moved_frame_is_not_darker_than_black(universal: DictionaryISP, target: Any) -> None:
    stripes = torch.zeros(1, 3, 64, 96)
    stripes[..., ::8] = stripes[..., 1::8] = 1.0
    pair = RawAugment(universal, noise=(0.0, 0.0), burst=Burst(4, motion=(2.0, 2.0)), target=target)(stripes, seeded())
    assert pair.noisy.min() >= 0.0 and pair.clean.min() >= 0.0 and pair.noisy.max() > 0.3


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_undoing_the_saved_motion_gives_the_scene_back(universal: DictionaryISP, noise: float) -> None:
    coarse = torch.rand(2, 3, 3, 4, generator=seeded())
    smooth = F.interpolate(coarse, size=(96, 128), mode="bicubic").clamp(0.1, 0.9)
    settings: dict[str, Any] = {"noise": (noise, noise), "target": Srgb(demosaicing="bilinear")}
    still = RawAugment(universal, burst=Burst(N, motion=(0, 0)), **settings)(smooth, seeded())
    pair = RawAugment(universal, burst=Burst(N, motion=(3.0, 1.0)), **settings)(smooth, seeded())
    motion, clean = pair.params.extras["motion"], pair.clean[..., 16:-16, 16:-16]
    assert not motion[:, 0].any() and motion[:, 1:, :2].abs().max() <= 3 and motion[..., 2].abs().max() < 0.0175
    reached = psnr(undone(pair.noisy, motion).mean(1), clean)
    if noise:
        assert (reached > psnr(still.noisy.mean(1)[..., 16:-16, 16:-16], clean) - 0.3).all()
    else:
        assert (reached > psnr(pair.noisy.mean(1)[..., 16:-16, 16:-16], clean) + 6).all() and reached.min() > 40


def test_brackets_change_light_and_replay(universal: DictionaryISP, srgb: Tensor) -> None:
    bracket = Burst(3, motion=(0, 0), stops=(0, -2, 1))
    augment = RawAugment(universal, noise=(1e-4, 1e-6), burst=bracket, draw=Draw(exposure=-1))
    pair = augment(srgb, seeded())
    low = (pair.noisy[:, 1].mean() / pair.noisy[:, 0].mean()).item()
    assert low == pytest.approx(0.25, rel=0.02) and pair.noisy.max() <= 1
    again = augment.apply(srgb, pair.params)
    assert torch.equal(again.noisy, pair.noisy) and torch.equal(again.clean, pair.clean)
    one = augment.apply(srgb[1], pair.params.map(lambda t: t[1]))
    assert torch.equal(one.noisy, pair.noisy[1])


@pytest.mark.parametrize(
    ("target", "noisy", "clean"),
    [("raw", (4, 16, 16), (4, 16, 16)), ("rgb", (4, 16, 16), (3, 32, 32)), ("srgb", (3, 32, 32), (3, 32, 32))],
)
def test_every_target_has_bursts_in_datasets(
    universal: DictionaryISP, srgb: Tensor, target: Any, noisy: tuple[int, ...], clean: tuple[int, ...]
) -> None:
    pairs = RawPairs(list(srgb), RawAugment(universal, burst=2, target=target), crop=32)
    batch = next(iter(DataLoader(pairs, batch_size=2)))
    assert batch.noisy.shape == (2, 2, *noisy) and batch.clean.shape == (2, *clean)
    assert batch.params.extras["motion"].shape == (2, 2, 3)


def test_linear_rgb_is_the_first_frame_s(universal: DictionaryISP, srgb: Tensor) -> None:
    pair = RawAugment(universal, noise=(0.0, 0.0), burst=2, target="rgb")(srgb, seeded())
    assert torch.equal(pack_rgb(pair.clean, universal.cfa), pair.noisy[:, 0])


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"frames": 0}, "at least 1, got 0"),
        ({"frames": 2, "motion": (-1, 0)}, "motion must be"),
        ({"frames": 2, "stops": (0,)}, "2 frames"),
    ],
)
def test_bursts_without_meaning_are_refused(universal: DictionaryISP, settings: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Burst(**settings)
    with pytest.raises(ValueError, match="burst"):
        RawAugment(universal, burst=0)
