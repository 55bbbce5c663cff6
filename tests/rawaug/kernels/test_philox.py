"""The counting generator against its published answers, and its normals against the normal distribution."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats
from torch import Tensor

from rawaug.kernels import cpu
from rawaug.kernels.reference import normals, philox

KEY = 0x299F31D0A4093822


def drawn(key: int, height: int, width: int) -> Tensor:
    """The compiled normals ``(4, height, width)``."""
    zero = torch.zeros(1, 4, height, width)
    return cpu.shot_read(zero, torch.tensor([[0.0, 1.0]]), [key], math.inf, mapped=False)[0][0]


@pytest.fixture(scope="module")
def sample() -> Tensor:
    return drawn(KEY, 1024, 1024)


def test_published_answer() -> None:
    # Random123's known answers for counter 0 and key 0; and for one counter under one key of 64 bits.
    assert philox(0, torch.tensor([0]))[:, 0].tolist() == [0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8]
    assert len(set(philox(KEY, torch.arange(1000)).flatten().tolist())) > 3998


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (7, 511), (2, 1025)])
def test_compiled_normals_are_the_defined_ones(size: tuple[int, int]) -> None:
    assert (drawn(KEY, *size) - normals(KEY, *size)).abs().max() < 4e-6


def test_distribution(sample: Tensor) -> None:
    for plane in sample:
        assert stats.kstest(plane.flatten().numpy(), "norm").pvalue > 1e-3


def test_tails_past_four_sigma(sample: Tensor) -> None:
    for sigma in (2.0, 3.0, 4.0, 4.5):
        for count in ((sample > sigma).sum().item(), (sample < -sigma).sum().item()):
            expected = sample.numel() * stats.norm.sf(sigma)
            assert abs(count - expected) < 4 * math.sqrt(expected)
    assert sample.abs().max() > 4.7


def test_nothing_is_correlated(sample: Tensor) -> None:
    other = drawn(KEY + 1, 1024, 1024)
    limit = 4.5 / 1024
    planes = torch.corrcoef(torch.cat([sample, other, sample.square(), other.square()]).flatten(1))
    assert (planes - torch.eye(16)).abs().max() < limit
    for rows, columns in ((0, 1), (1, 0), (1, 1), (0, 2), (0, 512)):
        moved = sample.roll((rows, columns), (1, 2))
        assert (sample * moved).mean((1, 2)).abs().max() < limit
