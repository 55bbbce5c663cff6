"""Classical denoisers: less noise on a picture with edges, none is the identity, scale-free, shot noise stabilised."""

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from skimage.restoration import denoise_nl_means
from torch import Tensor

from denoisers import BM3D, NonLocalMeans, Stabilised, TotalVariation, Wavelet
from denoisers.classical import STRIP, Classical

SIGMA = 0.03
OWN = [NonLocalMeans, Wavelet, TotalVariation]


def scene() -> tuple[Tensor, Tensor]:
    """(clean, noisy) of a slope with a disc on it, each plane with a gain of its own."""
    i, j = torch.meshgrid(torch.arange(64.0), torch.arange(48.0), indexing="ij")
    shape = 0.2 + i / 200 + 0.3 * ((i - 30) ** 2 + (j - 20) ** 2 < 200)
    clean = (torch.tensor([0.5, 1.0, 1.0, 0.7]).reshape(4, 1, 1) * shape).expand(2, 4, 64, 48)
    return clean, clean + SIGMA * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))


def mse(a: Tensor, b: Tensor) -> float:
    return (a - b).square().mean().item()


@pytest.mark.parametrize(("method", "psnr"), [(NonLocalMeans, 41.38), (Wavelet, 40.79), (TotalVariation, 36.99)])
def test_most_of_the_noise_goes(method: type[Classical], psnr: float) -> None:
    """30.44 dB before. The figures are pinned: published tables rest on these settings."""
    clean, noisy = scene()
    denoised = method()(noisy, torch.full_like(noisy, SIGMA**2))
    assert denoised.shape == noisy.shape and denoised.dtype == noisy.dtype
    assert -10 * math.log10(mse(denoised, clean)) == pytest.approx(psnr, abs=0.1)
    assert (denoised - clean).mean().abs() < 1e-3


@pytest.mark.parametrize("method", OWN)
def test_only_the_ratio_of_signal_to_noise_counts(method: type[Classical]) -> None:
    _, noisy = scene()
    once = method()(noisy, torch.full_like(noisy, SIGMA**2))
    torch.testing.assert_close(method()(8 * noisy, torch.full_like(noisy, (8 * SIGMA) ** 2)) / 8, once)


@pytest.mark.parametrize("method", OWN)
def test_each_picture_has_its_own_noise_level(method: type[Classical]) -> None:
    _, noisy = scene()
    variance = torch.tensor([0.0, SIGMA**2]).reshape(2, 1, 1, 1)
    both = method()(noisy, variance)
    assert torch.equal(both[0], noisy[0])
    assert torch.equal(both[1:], method()(noisy[1:], variance[1:]))


@pytest.mark.parametrize("method", [*OWN, BM3D])
def test_small_and_wrong_inputs(method: type[Classical]) -> None:
    least = method.smallest
    with pytest.raises(ValueError, match=r"strength.*positive"):
        method(0)
    if method is not BM3D:
        noisy = torch.rand(1, 4, least, least + 1, generator=torch.Generator().manual_seed(0))
        assert method()(noisy, torch.full_like(noisy, 1e-3)).isfinite().all()
    with pytest.raises(ValueError, match="packed"):
        method()(torch.zeros(1, 4, least - 1, 32), torch.zeros(1))
    with pytest.raises(ValueError, match="variance"):
        method()(torch.zeros(1, 4, 32, 32))


def test_bm3d_says_how_to_get_it_and_under_which_licence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "bm3d", None)
    with pytest.raises(ImportError, match=r"pip install '(?!rawaug).*\[bm3d\]'"):  # a checkout
        BM3D()(torch.zeros(1, 4, 16, 16), torch.ones(1))


def test_bm3d_filters_luminance_first_and_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[np.ndarray] = []

    def keep(planes: np.ndarray, sigma_psd: list[float]) -> np.ndarray:
        given.append(planes)
        return planes

    library = SimpleNamespace(bm3d=keep)
    monkeypatch.setitem(sys.modules, "bm3d", library)
    for channels in (3, 4):
        planes = np.random.default_rng(0).normal(size=(16, 16, channels)).astype(np.float32)
        method = BM3D()
        monkeypatch.setattr(method, "library", lambda name: library)
        assert np.allclose(method.denoise(planes), planes, atol=1e-6)
        assert np.allclose(given[-1][..., 0], planes.mean(-1) * channels**0.5, atol=1e-5)
        assert np.allclose(given[-1].std((0, 1)), 1.0, atol=0.15)  # white noise stays white


def test_bm3d_where_installed() -> None:
    pytest.importorskip("bm3d", reason="the bm3d wheel (non-commercial) is not installed")
    clean, noisy = scene()
    denoised = BM3D()(noisy[:1], torch.full_like(noisy[:1], SIGMA**2))
    assert mse(denoised, clean[:1]) < 0.2 * mse(noisy[:1], clean[:1])


def test_stabilised_beats_the_mean_level_under_shot_noise() -> None:
    clean, _ = scene()
    clean = clean**3 + 0.002
    shot_var, read_var = torch.tensor([0.01, 0.02]), torch.tensor([1e-5, 1e-5])
    variance = shot_var.reshape(2, 1, 1, 1) * clean + read_var.reshape(2, 1, 1, 1)
    noisy = clean + variance.sqrt() * torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    levels = {"shot_var": shot_var, "read_var": read_var}
    denoised = Stabilised(NonLocalMeans())(noisy, **levels)
    assert mse(denoised, clean) < 0.9 * mse(NonLocalMeans()(noisy, variance), clean)
    expected_variance = read_var.reshape(2, 1, 1, 1) + shot_var.reshape(2, 1, 1, 1) * noisy.clamp(min=0)
    assert mse(Stabilised(NonLocalMeans())(noisy, expected_variance), denoised) < 1e-4 * mse(denoised, clean)
    with pytest.raises(ValueError, match="is not shot_var"):
        Stabilised(NonLocalMeans())(noisy, torch.rand_like(noisy))
    white = Stabilised(TotalVariation())(noisy, shot_var=0.0, read_var=1e-3)
    assert torch.equal(white, TotalVariation()(noisy, torch.full_like(noisy, 1e-3))), "without shot noise, as it is"


def test_strips_of_non_local_means_are_those_of_the_whole() -> None:
    planes = np.random.default_rng(0).normal(10.0, 1.0, (2 * STRIP + 1, 20, 4)).astype(np.float32)
    planes += np.linspace(0.0, 50.0, 20, dtype=np.float32)[:, None]
    settings = {"patch_size": 5, "patch_distance": 6, "fast_mode": True, "channel_axis": -1}
    whole = denoise_nl_means(planes, h=0.8, sigma=1.0, **settings)
    np.testing.assert_allclose(NonLocalMeans().denoise(planes), whole, atol=1e-4)
