"""Poisson counts against their distribution."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from rawaug.noise.models import INVERSION_LIMIT, _walked, poisson

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
N = 400_000


def draw(rate: float, device: str, n: int = N) -> torch.Tensor:
    normals = torch.empty(n, device=device).normal_(generator=torch.Generator(device).manual_seed(7))
    return poisson(torch.full((n,), rate, device=device), normals).double().cpu()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("rate", [0.02, 0.5, 3.0, 9.99, 10.0, 12.5, 40.0, 300.0])
def test_counts_follow_the_distribution(rate: float, device: str) -> None:
    counts = draw(rate, device)
    assert torch.equal(counts, counts.round()) and counts.min() >= 0
    low, high = int(stats.poisson.ppf(1e-4, rate)), int(stats.poisson.ppf(1 - 1e-4, rate))
    edges = range(low, high + 1)
    observed = (
        [int((counts <= low).sum())] + [int((counts == k).sum()) for k in edges[1:]] + [int((counts > high).sum())]
    )
    expected = [stats.poisson.cdf(low, rate), *stats.poisson.pmf(edges[1:], rate), stats.poisson.sf(high, rate)]
    assert stats.chisquare(observed, [N * p for p in expected], sum_check=False).pvalue > 1e-3


@pytest.mark.parametrize("rate", [10.0, 10.5, 14.3, 40.0])
def test_expansion_gives_the_exact_quantiles(rate: float) -> None:
    uniform = (torch.arange(50_000, dtype=torch.float64) + 0.5) / 50_000
    counts = poisson(torch.full_like(uniform, rate), torch.special.ndtri(uniform)).numpy()
    assert (counts != stats.poisson.ppf(uniform, rate)).mean() < 1e-3


@pytest.mark.parametrize("rate", [INVERSION_LIMIT, 1e3, 1e5, 1e7])
def test_high_rates_have_the_right_mean_and_variance(rate: float) -> None:
    deviation = draw(rate, "cpu") - rate
    assert abs(deviation.mean()) < 3 * (rate / N) ** 0.5
    assert deviation.var() == pytest.approx(rate, rel=0.01)


def test_far_tail_is_neither_cut_nor_endless() -> None:
    counts = draw(0.1, "cpu", 4_000_000)
    assert stats.poisson.isf(1e-5, 0.1) <= counts.max() <= stats.poisson.isf(1e-11, 0.1)
    w = torch.tensor([-5.9, -3.0, 0.0, 3.0, 4.5, 5.2, 5.6, 5.9])
    for rate in (0.1, 2.0, 9.9):
        exact = stats.poisson.isf(stats.norm.sf(w.double().numpy()), float(torch.tensor(rate)))
        assert _walked(torch.full_like(w, rate), w).tolist() == exact.tolist()
        assert _walked(torch.tensor([rate]), torch.tensor([40.0])) < stats.poisson.isf(1e-15, rate)
