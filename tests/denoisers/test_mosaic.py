"""The network of every mosaic: where it starts, that borders and tiles fit together, defects, and its own limits."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from denoisers import DRUNet, MosaicDRUNet, denoise_tiles
from denoisers.defects import mend_mosaic
from denoisers.mosaic import BayerAdapter, denoise_mosaic, entry_pattern, with_planes
from rawaug import bayer
from rawaug.bayer import pattern
from rawaug.training.config import DenoiserConfig
from rawaug.training.state import first_network

SMALL: dict[str, Any] = {"width": 4, "scales": 2}
NAMES = ("RGGB", "GBRG", "XTRANS", "XTRANS+3+2", "QUAD-BGGR", "QUAD-RGGB+1+2")


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noisy_mosaic(name: str, height: int = 48, width: int = 60) -> tuple[Tensor, Tensor]:
    """A mosaic ``(1, 1, H, W)`` of smooth colour with noise, and its variance."""
    rows, columns = torch.linspace(0.2, 0.6, height)[:, None], torch.linspace(0.0, 0.3, width)
    rgb = torch.stack([rows + columns, 0.9 * rows + 0.1 * columns, 0.5 * rows.expand(height, width)])
    clean = pattern(name).mosaic(rgb)[None]
    noisy = clean + (1e-3 * clean + 1e-5).sqrt() * torch.randn(clean.shape, generator=seeded())
    return noisy, bayer.noise_variance(noisy, 1e-3, 1e-5)


def trained(**settings: Any) -> MosaicDRUNet:
    """A network whose last layer does something."""
    net = MosaicDRUNet(**SMALL, **settings)
    torch.nn.init.normal_(net.tail.weight, std=0.3, generator=seeded(1))
    return net.eval()


@pytest.mark.parametrize("name", NAMES)
def test_an_untrained_network_is_the_identity(name: str) -> None:
    noisy, variance = noisy_mosaic(name)
    given = with_planes(noisy, pattern(name))
    torch.testing.assert_close(MosaicDRUNet(**SMALL, mend=False, pyramid=2)(given, variance), noisy, rtol=0, atol=2e-5)
    assert not torch.allclose(trained()(given, variance), noisy, atol=1e-3)


def test_it_starts_from_a_network_of_packed_raw_as_that_network() -> None:
    packed = DRUNet(**SMALL, blocks=1, limits=True, variance_map=False, domain="anscombe")
    torch.nn.init.normal_(packed.tail.weight, std=0.3, generator=seeded(2))
    own = MosaicDRUNet(**SMALL, mend=False)
    own.start_from(packed)
    noisy, variance = (bayer.pack(x, "RGGB") for x in noisy_mosaic("RGGB", 128, 128))
    expected, found = packed(noisy, variance), BayerAdapter(own)(noisy, variance)
    assert (expected - noisy).square().mean() > 1e-5
    # but for the mean light of a cell, which is one for both greens
    assert (found - expected).square().mean() < 0.01 * (expected - noisy).square().mean()


def test_a_recipe_starts_it_from_shipped_weights_and_goes_on_from_its_own(tmp_path: Any) -> None:
    from denoisers import save

    started = first_network(DenoiserConfig("MosaicDRUNet", {"pyramid": 2}, "rawaug-base"), seed=0)
    assert isinstance(started, MosaicDRUNet) and started.tail.weight.abs().max() > 0
    save(started, tmp_path / "own.safetensors", {})
    again = first_network(DenoiserConfig(start=str(tmp_path / "own.safetensors")), seed=0)
    assert isinstance(again, MosaicDRUNet) and torch.equal(again.tail.weight, started.tail.weight)
    grown = first_network(DenoiserConfig("MosaicDRUNet", {"pyramid": 2, "blocks": 2}, "rawaug-base"), seed=0)
    assert isinstance(grown, MosaicDRUNet) and torch.equal(grown.tail.weight, started.tail.weight)
    with pytest.raises(ValueError, match="rawaug"):
        first_network(DenoiserConfig("MosaicDRUNet", {"width": 16}, "rawaug-base"), seed=0)


@pytest.mark.parametrize("name", NAMES)
def test_tiles_are_the_whole_mosaic(name: str) -> None:
    net = trained(mend=False)
    noisy, variance = noisy_mosaic(name, 160, 96)
    given = with_planes(noisy, pattern(name))
    whole = net(given, variance)
    torch.testing.assert_close(denoise_tiles(net, given, variance, tile=64, overlap=16), whole, rtol=0, atol=2e-5)


@pytest.mark.parametrize("name", [*bayer.PATTERNS, "XTRANS+1+0", "XTRANS+2+5", "QUAD-RGGB+1+2"])
def test_a_network_meets_every_pattern_where_it_is_trained_to(name: str) -> None:
    met = entry_pattern(pattern(name))
    squares = bayer.pack(met.channels(12, 12)[None], "RGGB").flatten(1).T
    counts = torch.stack([(squares == colour).sum(1) for colour in range(3)])
    whole = (counts == torch.tensor([1, 2, 1])[:, None]).all(0).float().mean().item()
    assert whole == pytest.approx(8 / 9 if "XTRANS" in name else 1.0)
    noisy, variance = noisy_mosaic(name)

    def run(given: Tensor, told: Tensor) -> Tensor:
        assert torch.equal(given[0, 1:, 1:, 1:].argmax(0), met.channels(*told.shape[-2:])[1:, 1:])
        return given[:, :1]

    assert torch.equal(denoise_mosaic(run, noisy, variance, name), noisy)


@pytest.mark.parametrize("name", NAMES)
def test_hot_and_dead_pixels_are_mended_and_nothing_else(name: str) -> None:
    known, (height, width) = pattern(name), (48, 60)
    signal = noisy_mosaic(name)[0] * 0 + 30.0 * (1 + torch.linspace(0, 1, width))
    signal = signal + 10.0 * known.channels(height, width) + torch.randn(signal.shape, generator=seeded(3))
    planes = known.planes(height, width)[None]
    assert (mend_mosaic(signal, planes) != signal).float().mean() < 1e-3
    damaged = signal.clone()
    places = [(9, 11), (20, 31), (33, 40)]
    for (row, column), value in zip(places, (200.0, 0.0, 150.0), strict=True):
        damaged[..., row, column] = value
    repaired = mend_mosaic(damaged, planes)
    for row, column in places:
        assert (repaired - signal)[..., row, column].abs() < 12.0


def test_a_pyramid_finds_wide_noise_of_every_pattern() -> None:
    """At half the sides a network that removes all it sees leaves only what is interpolated from there."""
    for name in ("GRBG", "XTRANS"):
        noisy, variance = noisy_mosaic(name, 96, 96)
        given = with_planes(noisy, pattern(name))
        flat, deep = (trained(mend=False, pyramid=number) for number in (0, 1))
        deep.load_state_dict(flat.state_dict())
        change = deep(given, variance) - flat(given, variance)
        assert change.abs().max() > 1e-4
        wide = torch.nn.functional.avg_pool2d(change, 12).std()
        assert wide > 0.3 * change.std(), "what is added is wide"


def test_what_it_cannot_take_is_refused() -> None:
    net = MosaicDRUNet(**SMALL)
    noisy, variance = noisy_mosaic("XTRANS")
    with pytest.raises(ValueError, match="mosaic"):
        net(noisy, variance)
    given = with_planes(noisy, pattern("XTRANS"))
    with pytest.raises(ValueError, match="variance"):
        net(given)
    with pytest.raises(ValueError, match="domain linear"):
        MosaicDRUNet(**SMALL, domain="linear")
    part = partial(with_planes, pattern=pattern("XTRANS"))
    assert net(part(noisy[..., :5, :4]), variance[..., :5, :4]).shape == (1, 1, 5, 4)
