"""GLIDE: its filter is symmetric, keeps constants and has eigenvalues in [0, 1]; texture gains."""

from __future__ import annotations

import pytest
import torch

from denoisers.glide import GLIDE, affinities, eigenvectors, filter_plane


def noisy_edge() -> tuple[torch.Tensor, torch.Tensor]:
    """(clean, noisy) in deviations of the noise, ``(4, 20, 24)``."""
    i, j = torch.meshgrid(torch.arange(20.0), torch.arange(24.0), indexing="ij")
    clean = (10.0 + 8.0 * (i > j)).expand(4, 20, 24)
    return clean, clean + torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))


def test_the_filter_keeps_constants_and_contracts() -> None:
    clean, _ = noisy_edge()
    guide = clean + 0.1 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(2))
    vectors, values = eigenvectors(*affinities(guide))
    identity = torch.eye(len(values), dtype=vectors.dtype)
    torch.testing.assert_close(vectors.T @ vectors, identity, atol=1e-4, rtol=0)
    assert values[0] == pytest.approx(1.0, abs=1e-3) and values.max() < 1.001 and values.min() >= 0.0

    ones = torch.ones(len(vectors), dtype=vectors.dtype)
    filtered = vectors @ (values * (vectors.T @ ones))
    torch.testing.assert_close(filtered, ones, atol=1e-2, rtol=0)


def test_without_noise_all_that_the_eigenvectors_span_stays() -> None:
    generator = torch.Generator().manual_seed(0)
    vectors, _ = torch.linalg.qr(torch.randn(50, 6, generator=generator, dtype=torch.float64))
    values = torch.tensor([1.0, 0.9, 0.5, 0.2, 0.1, 0.05], dtype=torch.float64)
    plane = vectors @ torch.tensor([50.0, 20.0, 10.0, 4.0, 2.0, 1.0], dtype=torch.float64)
    quiet = filter_plane(plane, vectors, values, noise=1e-9)
    assert (quiet - plane).norm() < 0.2 * plane.norm()
    loud = filter_plane(plane, vectors, values, noise=30.0)
    assert loud.norm() < plane.norm()


def test_an_edge_gains() -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    clean, noisy = noisy_edge()
    cleaned = GLIDE()(noisy[None] * 0.01, torch.full((1, 4, 20, 24), 1e-4))[0] / 0.01
    assert (cleaned - clean).square().mean() < 0.3 * (noisy - clean).square().mean()


def test_a_picture_of_more_colours_than_samples_is_not_spoilt() -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    generator = torch.Generator().manual_seed(0)
    clean = 60.0 * torch.rand(4, 32, 32, generator=generator) ** 2
    noisy = clean + torch.randn(clean.shape, generator=generator)
    cleaned = GLIDE()(noisy[None] * 0.01, torch.full((1, 4, 32, 32), 1e-4))[0] / 0.01
    assert (cleaned - clean).square().mean() < 1.1 * (noisy - clean).square().mean()


def test_tiles_fit_together(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("skimage", reason="scikit-image is not installed")
    monkeypatch.setattr("denoisers.glide.TILE", 16)
    clean, noisy = noisy_edge()
    cleaned = GLIDE()(noisy[None] * 0.01, torch.full((1, 4, 20, 24), 1e-4))[0] / 0.01
    assert cleaned.shape == clean.shape
    assert (cleaned - clean).square().mean() < 0.5 * (noisy - clean).square().mean()
