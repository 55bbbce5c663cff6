"""Full colour of packed RAW: what D is, where the network starts, and that tiles, views and patterns fit together."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import denoisers
from denoisers import DRUNet, JointDRUNet, SelfEnsemble, denoise_tiles
from denoisers.domains import DOMAINS, fit_levels
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.denoising.denoiser import Noisy, RawDenoiser
from rawaug.training.config import DenoiserConfig
from rawaug.training.state import first_network

SMALL: dict[str, Any] = {"width": 4, "scales": 2, "mend": False}


def noisy_raw(height: int, width: int) -> tuple[Tensor, Tensor]:
    noisy = 0.02 + 0.9 * torch.rand(1, 4, height, width, generator=torch.Generator().manual_seed(0))
    return noisy, 1e-3 * noisy + 1e-5


def malvar(noisy: Tensor, variance: Tensor, cfa: CFA = CFA.RGGB, denoised: Tensor | None = None) -> Tensor:
    """Malvar's interpolation, where the noise is white, of noisy RAW or of what became of it."""
    levels, root = fit_levels(noisy, variance), DOMAINS["anscombe"]
    packed = noisy if denoised is None else denoised
    mosaic = bayer.unpack(root.forward(packed, *levels), cfa)
    return root.inverse(bayer.demosaic(mosaic, cfa, "malvar"), *levels)


def trained(**settings: Any) -> JointDRUNet:
    """A network whose last layers do something."""
    net = JointDRUNet(**SMALL, **settings)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for layer in (net.tail, net.detail):
            layer.weight.copy_(0.3 * torch.randn(layer.weight.shape, generator=generator))
    return net.eval()


@pytest.mark.parametrize("size", [(2, 2), (17, 22)])
def test_an_untrained_network_is_the_interpolation(size: tuple[int, int]) -> None:
    noisy, variance = noisy_raw(*size)
    rgb = JointDRUNet(**SMALL)(noisy, variance)
    assert rgb.shape == (1, 3, 2 * size[0], 2 * size[1])
    torch.testing.assert_close(rgb, malvar(noisy, variance), rtol=0, atol=2e-5)
    assert not torch.allclose(trained()(noisy, variance), rgb, atol=1e-3)


def test_it_starts_from_a_denoiser_as_that_followed_by_the_interpolation(tmp_path: Path) -> None:
    first = DRUNet(**SMALL, blocks=1, limits=True, variance_map=False, domain="anscombe")
    torch.nn.init.normal_(first.tail.weight, std=0.3, generator=torch.Generator().manual_seed(2))
    denoisers.save(first, tmp_path / "first.safetensors", {})
    start = str(tmp_path / "first.safetensors")
    noisy, variance = noisy_raw(16, 16)
    joint = first_network(DenoiserConfig("JointDRUNet", SMALL, start), seed=0)
    expected = malvar(noisy, variance, denoised=first(noisy, variance))
    torch.testing.assert_close(joint(noisy, variance), expected, rtol=0, atol=1e-4)
    assert (malvar(noisy, variance) - expected).abs().max() > 0.05
    for other in ({**SMALL, "width": 8}, {**SMALL, "limits": False}):
        with pytest.raises(ValueError, match=r"denoiser\.start: .*JointDRUNet"):
            first_network(DenoiserConfig("JointDRUNet", other, start), seed=0)


def test_tiles_of_full_colour_join() -> None:
    net, (noisy, variance) = trained(), noisy_raw(120, 90)
    with torch.no_grad():
        whole = net(noisy, variance)
    torch.testing.assert_close(denoise_tiles(net, noisy, variance, tile=80, overlap=32), whole, rtol=0, atol=1e-4)


def test_views_are_turned_back() -> None:
    """Bilinear interpolation commutes with flips and turns, so that its average is itself."""

    def bilinear(packed: Tensor, _: Tensor | None) -> Tensor:
        return bayer.demosaic(bayer.unpack(packed, CFA.RGGB), CFA.RGGB)

    noisy, variance = noisy_raw(10, 14)
    mean = SelfEnsemble(bilinear, CFA.RGGB)(noisy, variance)
    torch.testing.assert_close(mean, bilinear(noisy, None), rtol=0, atol=1e-6)


@pytest.mark.parametrize("cfa", list(CFA))
def test_any_pattern_is_full_colour_where_it_stands(cfa: CFA) -> None:
    noisy, variance = noisy_raw(12, 16)
    rgb = RawDenoiser.of(JointDRUNet(**SMALL))(Noisy(noisy, variance, cfa=cfa))
    expected = malvar(noisy, variance, cfa)
    inner = (..., slice(4, -4), slice(4, -4))
    torch.testing.assert_close(rgb[inner], expected[inner], rtol=0, atol=2e-3)


def test_half_precision_in_a_file_is_single_precision_in_memory(tmp_path: Path) -> None:
    net = trained()
    denoisers.save(trained().half(), tmp_path / "half.safetensors", {})
    loaded, _ = denoisers.load(tmp_path / "half.safetensors")
    assert {weights.dtype for weights in loaded.parameters()} == {torch.float32}
    assert torch.equal(loaded.get_parameter("tail.weight"), net.tail.weight.half().float())
    assert (tmp_path / "half.safetensors").stat().st_size < 2.2 * sum(w.numel() for w in net.parameters()) + 4000
    noisy, variance = noisy_raw(8, 8)
    torch.testing.assert_close(loaded(noisy, variance), net(noisy, variance), rtol=0, atol=1e-2)


def test_the_interpolation_keeps_its_digits_in_mixed_precision() -> None:
    noisy, variance = noisy_raw(8, 8)
    net = partial(JointDRUNet(**SMALL), noisy, variance)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = net()
    torch.testing.assert_close(mixed, net(), rtol=0, atol=1e-5)
