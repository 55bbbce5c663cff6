"""WNNM: singular values shrink by the published rule, groups of low rank come back, texture gains."""

from __future__ import annotations

import math

import pytest
import torch

from denoisers.wnnm import EPS, WEIGHT, WNNM, denoise_groups, shrink


def test_shrunk_values_solve_the_weighted_problem() -> None:
    """x + C / (x + eps) = s, whose weight falls with x; values below 2 sqrt(C) vanish."""
    values = torch.tensor([300.0, 50.0, 30.0, 20.0, 5.0])
    shrunk = shrink(values, torch.tensor(1.0), patches=64)
    constant = 2.0 * WEIGHT * math.sqrt(64)
    kept = values > 2.0 * math.sqrt(constant)
    assert kept.tolist() == [True, True, True, True, False]
    torch.testing.assert_close((shrunk + constant / (shrunk + EPS))[kept], values[kept], rtol=1e-4, atol=0)
    assert shrunk[4] == 0.0
    assert (values - shrunk)[0] < (values - shrunk)[1] < (values - shrunk)[2], "large values shrink less"


def test_a_group_of_rank_one_comes_back() -> None:
    generator = torch.Generator().manual_seed(0)
    clean = torch.randn(1, 36, 1, generator=generator) * torch.randn(1, 1, 70, generator=generator) * 20.0
    noisy = clean + torch.randn(clean.shape, generator=generator)
    cleaned = denoise_groups(noisy, torch.ones(1))
    assert (cleaned - clean).square().mean() < 0.1 * (noisy - clean).square().mean()
    torch.testing.assert_close(denoise_groups(clean, torch.zeros(1)), clean, atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("channels", [3, 4])
def test_stripes_gain(channels: int) -> None:
    i, j = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
    texture = 0.3 + 0.1 * torch.sin(1.3 * i + 0.7 * j)
    clean = texture.expand(channels, 24, 24)
    noisy = clean + 0.03 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    planes = (noisy / 0.03).permute(1, 2, 0).numpy()
    cleaned = 0.03 * torch.from_numpy(WNNM().denoise(planes)).permute(2, 0, 1)
    assert (cleaned - clean).square().mean() < 0.2 * (noisy - clean).square().mean()
