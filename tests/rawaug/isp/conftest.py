"""A camera whose parameters are known, and pairs made by it."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair

MATRIX = torch.tensor([[0.6, 0.3, 0.1], [0.05, 0.75, 0.2], [0.02, 0.23, 0.75]])


def make_pair(name: str, white_balance: tuple[float, float, float], seed: int, fall_off: float = 0.0) -> Pair:
    """A pair of a gamma camera: RAW = CFA(fall-off x M x^2.2 / gains), quantised sRGB."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand(1, 3, 8, 10, generator=generator)
    picture = torch.nn.functional.interpolate(coarse, (96, 128), mode="bilinear").mul(0.8).add(0.08)[0]
    srgb = (picture * 255).round().to(torch.uint8)
    linear = torch.einsum("ij,jhw->ihw", MATRIX, (srgb / 255.0) ** 2.2)
    y, x = torch.meshgrid(torch.linspace(-1, 1, 96) * 0.6, torch.linspace(-1, 1, 128) * 0.8, indexing="ij")
    raw = linear / torch.tensor(white_balance)[:, None, None] * torch.exp(-0.5 * fall_off * (x**2 + y**2))
    mosaic = bayer.mosaic(raw, "GRBG")
    return Pair(name, srgb, mosaic, CFA.GRBG, white_balance, torch.linalg.inv(MATRIX))


@pytest.fixture(scope="session")
def camera_matrix() -> torch.Tensor:
    """sRGB to camera."""
    return MATRIX


@pytest.fixture(scope="session")
def exact_pair() -> Callable[..., Pair]:
    """Makes a pair from a name, white balance, seed and fall-off."""
    return make_pair


@pytest.fixture(scope="session")
def exact_pairs() -> list[Pair]:
    balances = [(1.6, 1.0, 1.5), (2.0, 1.0, 1.2), (1.8, 1.0, 1.9)]
    return [make_pair(f"shot{k}", balance, k) for k, balance in enumerate(balances)]
