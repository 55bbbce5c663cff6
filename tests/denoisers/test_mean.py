"""The mean of two networks of developed pictures."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import denoisers


def two_networks(share: float = 0.25) -> denoisers.MeanDRUNet:
    """A mean of two networks that change their input, each in its own way."""
    network = denoisers.MeanDRUNet(width=4, second_blocks=[2, 1, 1, 1], share=share).eval()
    for seed, part in enumerate((network.first, network.second)):
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            part.tail.weight.copy_(0.1 * torch.randn(part.tail.weight.shape, generator=generator))
    return network


def test_the_result_is_the_mean_by_the_share() -> None:
    noisy = torch.rand(2, 3, 35, 50, generator=torch.Generator().manual_seed(0))
    variance = torch.full_like(noisy, 1e-3)
    for share in (0.0, 0.25, 1.0):
        network = two_networks(share)
        first = network.first(noisy, variance)
        second = network.second(noisy, variance)
        assert (first - second).abs().max() > 1e-3
        torch.testing.assert_close(network(noisy, variance), (1 - share) * first + share * second)


def test_it_is_saved_and_loaded_and_takes_one_turn_where_a_single_network_takes_two(tmp_path: Path) -> None:
    network = two_networks()
    denoisers.save(network, tmp_path / "mean.safetensors", {})
    again, _ = denoisers.load(tmp_path / "mean.safetensors")
    noisy = torch.rand(1, 3, 32, 32, generator=torch.Generator().manual_seed(1))
    unknown = torch.zeros_like(noisy)
    assert again.config == network.config
    assert torch.equal(again(noisy, unknown), network(noisy, unknown))
    assert (network.views, network.first.views) == (1, 2)


def test_a_share_beyond_one_is_refused() -> None:
    with pytest.raises(ValueError, match="share"):
        denoisers.MeanDRUNet(width=4, share=1.5)
