"""A camera whose parameters are known, pairs made by it, and the universal ISP."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.io import RawFrame
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.model import DictionaryISP

MATRIX = torch.tensor([[0.6, 0.3, 0.1], [0.05, 0.75, 0.2], [0.02, 0.23, 0.75]])
BALANCES = [(1.6, 1.0, 1.5), (2.0, 1.0, 1.2), (1.8, 1.0, 1.9)]


def plain_gamma(x: torch.Tensor) -> torch.Tensor:
    """What an ISP starts from."""
    return x**2.2


def make_pair(
    name: str,
    white_balance: tuple[float, float, float],
    seed: int,
    fall_off: float = 0.0,
    matrix: torch.Tensor = MATRIX,
    camera: str = "unknown",
    curve: Callable[[torch.Tensor], torch.Tensor] = plain_gamma,
    size: tuple[int, int] = (96, 128),
    picture: torch.Tensor | None = None,
    shot_var: float | None = None,
) -> Pair:
    """A pair of a camera: RAW = CFA(fall-off x M curve(x) / gains), quantised sRGB; noisy as well, given ``shot_var``.

    Its content is coarse random colours, or ``picture`` ``(3, H, W)``.
    """
    generator = torch.Generator().manual_seed(seed)
    if picture is None:
        coarse = torch.rand(1, 3, 8, 10, generator=generator)
        picture = torch.nn.functional.interpolate(coarse, size, mode="bilinear").mul(0.8).add(0.08)[0]
    srgb = (picture * 255).round().to(torch.uint8)
    height, width = srgb.shape[-2:]
    linear = torch.einsum("ij,jhw->ihw", matrix, curve(srgb / 255.0))
    y, x = torch.meshgrid(torch.linspace(-1, 1, height) * 0.6, torch.linspace(-1, 1, width) * 0.8, indexing="ij")
    raw = linear / torch.tensor(white_balance)[:, None, None] * torch.exp(-0.5 * fall_off * (x**2 + y**2))
    mosaic = bayer.mosaic(raw, "GRBG")
    inverse = torch.linalg.inv(matrix)
    clean = RawFrame(mosaic, CFA.GRBG, white_balance=white_balance, color_matrix=inverse, camera=camera)
    if shot_var is None:
        return Pair(name, clean, srgb)
    noisy = mosaic + (shot_var * mosaic).sqrt() * torch.randn(mosaic.shape, generator=generator)
    return Pair(name, clean, srgb, replace(clean, mosaic=noisy, noise_profile=(shot_var, 0.0)))


@pytest.fixture(scope="session")
def camera_matrix() -> torch.Tensor:
    """sRGB to camera."""
    return MATRIX


@pytest.fixture(scope="session")
def exact_pair() -> Callable[..., Pair]:
    """Makes a pair from a name, white balance, seed and fall-off; see :func:`make_pair`."""
    return make_pair


@pytest.fixture(scope="session")
def exact_pairs() -> list[Pair]:
    """Three shots, each in a light of its own."""
    return [make_pair(f"shot{k}", balance, k) for k, balance in enumerate(BALANCES)]


@pytest.fixture(scope="session")
def fitted(exact_pairs: list[Pair]) -> DictionaryISP:
    """Fitted to the three shots."""
    return fit_isp(exact_pairs, FitConfig(steps=60, pixels=4096, batch=1024, prior_steps=100), progress=False)


@pytest.fixture(scope="session")
def universal() -> DictionaryISP:
    """As shipped."""
    return DictionaryISP.from_pretrained("universal")
