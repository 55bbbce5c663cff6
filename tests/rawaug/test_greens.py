from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rawaug.bayer import CFA, balance_greens, measure_greens, mosaic, pack, unpack
from rawaug.noise import GreenImbalance, SensorNoise
from rawaug.seeding import keyed_generator

LEVELS = (1e-3, 1e-5)


def a_scene(height: int = 512, width: int = 640) -> Tensor:
    """Smooth patches whose colours vary on their own, ``(3, H, W)`` from 0.05 to 0.7."""
    coarse = torch.rand(1, 3, height // 64, width // 64, generator=keyed_generator(0, "patches"))
    return interpolate(0.05 + 0.65 * coarse, (height, width), mode="bilinear")[0]


def a_zone_plate(side: int, highest: float = 1.0) -> Tensor:
    """Rings that get finer outwards, up to ``highest`` of what the mosaic's sites can hold, ``(3, H, W)``."""
    line = torch.linspace(-1, 1, side, dtype=torch.float64)
    radius = line.square()[:, None] + line.square()
    return (0.4 + 0.3 * torch.cos(highest * math.pi * side / 4 * radius)).float().expand(3, -1, -1)


def noisy(clean: Tensor, *key: int | str, levels: tuple[float, float] = LEVELS) -> Tensor:
    noise = torch.randn(clean.shape, generator=keyed_generator(0, *key))
    return clean + noise * (levels[0] * clean + levels[1]).sqrt()


def gap(raw: Tensor, clean: Tensor, cfa: CFA) -> float:
    """How far Gr - Gb is from what it is without an imbalance: its root mean square as a part of green."""
    got, true = pack(raw, cfa), pack(clean, cfa)
    off = (got[1] - got[2]) - (true[1] - true[2])
    blocks = off[: len(off) // 16 * 16, : off.shape[1] // 16 * 16].unfold(0, 16, 16).unfold(1, 16, 16).mean((-1, -2))
    return float(blocks.square().mean().sqrt() / true[1:3].mean())


@pytest.mark.parametrize("cfa", list(CFA))
def test_an_imbalance_that_is_drawn_is_found_and_taken_out(cfa: CFA) -> None:
    clean = mosaic(a_scene(), cfa)
    noise = SensorNoise(LEVELS, green_imbalance=0.01)
    params = noise.sample(1, keyed_generator(11, "greens"))
    drawn = abs(float(params["green_imbalance"]))
    raw = unpack(noise.apply(pack(clean[None], cfa), params), cfa)[0]
    found = measure_greens(raw, cfa)
    assert drawn > 0.003 and found is not None and found.significant
    assert abs(found.share - drawn) < 3 * found.error and found.error < drawn / 5
    again = measure_greens(balance_greens(raw, cfa, found), cfa)
    assert again is not None and not again.significant
    without_noise = GreenImbalance(0.01).apply(pack(clean[None], cfa), params)
    left = balance_greens(unpack(without_noise, cfa)[0], cfa, found)
    assert gap(left, clean, cfa) < 0.25 * drawn


def test_light_that_leaks_from_red_is_told_from_a_gain() -> None:
    scene = a_scene()
    clean, cfa = mosaic(scene, CFA.RGGB), CFA.RGGB
    leaking = clean.clone()
    leaking[:, 0::2, 1::2] += 0.01 * scene[0, 0::2, 1::2]
    found = measure_greens(leaking, cfa)
    assert found is not None and found.significant
    assert found.gains[:, 0, 0].tolist() == pytest.approx([0.01, 0, 0], abs=1e-3)
    assert gap(balance_greens(leaking, cfa, found), clean, cfa) < 0.02 * gap(leaking, clean, cfa)


def test_greens_that_agree_are_left() -> None:
    clean = mosaic(a_scene(), CFA.GRBG)
    for seed in range(12):
        for levels in ((1e-2, 1e-4), (1e-4, 1e-7)):
            found = measure_greens(noisy(clean, seed, levels=levels), CFA.GRBG)
            assert found is not None and not found.significant, (seed, levels)


@pytest.mark.parametrize("highest", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("with_noise", [False, True])
def test_fine_patterns_are_no_imbalance(highest: float, with_noise: bool) -> None:
    clean = mosaic(a_zone_plate(512, highest), CFA.RGGB)
    found = measure_greens(noisy(clean, "zone") if with_noise else clean, CFA.RGGB)
    assert found is not None and not found.significant


@pytest.mark.parametrize("frequency", [0.5, 0.49, 0.4])
def test_stripes_across_the_frame_are_no_imbalance(frequency: float) -> None:
    wave = 0.4 + 0.1 * torch.cos(2 * math.pi * frequency * torch.arange(512.0))
    for stripes in (wave.expand(3, 512, 512), wave[:, None].expand(3, 512, 512)):
        found = measure_greens(mosaic(stripes, CFA.RGGB), CFA.RGGB)
        assert found is not None and not found.significant


def test_a_zone_plate_keeps_its_detail() -> None:
    scene = torch.cat([a_scene(512, 512), a_zone_plate(512)], dim=-1)
    clean = mosaic(scene, CFA.RGGB)
    raw = clean.clone()
    raw[:, 0::2, 1::2] *= 1.005
    raw[:, 1::2, 0::2] *= 0.995
    found = measure_greens(raw, CFA.RGGB)
    assert found is not None and found.significant
    off = (balance_greens(raw, CFA.RGGB, found) - clean).abs() / clean
    assert off.max() < 0.005 and off.mean() < 2e-4  # every other site was off by 0.005


def test_only_greens_that_are_not_clipped_change() -> None:
    scene = a_scene()
    scene[:, 200:300, 200:300] = 2.0
    raw = mosaic(scene, CFA.RGGB).clamp(max=1)
    raw[:, 0::2, 1::2] = (raw[:, 0::2, 1::2] * 1.02).clamp(max=1)
    found = measure_greens(raw, CFA.RGGB)
    assert found is not None and found.significant and found.share == pytest.approx(0.02, rel=0.1)
    before, after = pack(raw, CFA.RGGB), pack(balance_greens(raw, CFA.RGGB, found), CFA.RGGB)
    assert torch.equal(before[::3], after[::3])
    assert torch.equal(before[before == 1], after[before == 1])
    assert (after <= 1).all() and not torch.equal(before[1:3], after[1:3])


def test_a_small_or_clipped_frame_tells_nothing() -> None:
    assert measure_greens(torch.rand(1, 254, 512), "RGGB") is None
    assert measure_greens(torch.ones(1, 512, 512), "RGGB") is None
