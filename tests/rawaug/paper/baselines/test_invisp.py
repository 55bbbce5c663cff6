"""InvISP is exactly invertible, starts as a plain camera, uses the shot's balance, and learns through JPEG."""

from __future__ import annotations

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.paper.baselines.base import Crops
from rawaug.paper.baselines.invisp import InvISP, JpegInvISP


def shaken(blocks: int = 8, growth: int = 32) -> InvISP:
    """A model whose weights are far from the start."""
    model, generator = InvISP(blocks=blocks, growth=growth), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return model


@torch.no_grad()
def test_it_is_exactly_invertible() -> None:
    flow = shaken().flow
    x = torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(1))
    assert (flow(x) - x).abs().max() > 0.05
    torch.testing.assert_close(flow(flow.inverse(x)), x, atol=1e-5, rtol=0)
    torch.testing.assert_close(flow.inverse(flow(x)), x, atol=1e-5, rtol=0)


@pytest.mark.parametrize("blocks", [1, 2, 3, 8])
def test_untrained_it_is_a_plain_gamma_camera(blocks: int) -> None:
    srgb = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(2))
    raw = InvISP("GRBG", blocks=blocks, growth=4).reverse(srgb, (2.0, 1.0, 1.6))
    linear = srgb**2.2
    torch.testing.assert_close(raw[:, 0, 0::2, 1::2], linear[:, 0, 0::2, 1::2], atol=1e-6, rtol=1e-4)
    assert raw.max() <= 1.0  # w is (1, 0.5, 0.8): green and blue are divided by it
    green = (2.0 * linear[:, 1, 0::2, 0::2]).clamp(max=1.0)
    torch.testing.assert_close(raw[:, 0, 0::2, 0::2], green, atol=1e-6, rtol=1e-4)


def test_blind_it_uses_the_mean_balance_of_the_pairs(exact_pairs: list[Pair]) -> None:
    model = InvISP(blocks=1, growth=4)
    model.prepare(exact_pairs)
    mean = torch.tensor([pair.clean.white_balance for pair in exact_pairs]).log().mean(0).exp()
    srgb = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(model.reverse(srgb), model.reverse(srgb, mean))


def test_with_jpeg_between_the_way_back_sees_the_compressed_rendering() -> None:
    generator = torch.Generator().manual_seed(4)
    srgb = torch.rand(2, 3, 32, 32, generator=generator)
    crops = Crops(srgb, torch.rand(2, 1, 32, 32, generator=generator), torch.tensor([[2.0, 1.0, 1.5]] * 2))

    losses = {}
    for quality in (10, 90):
        model = JpegInvISP(blocks=2, growth=4, quality=quality)
        loss = model.loss(crops)
        loss.backward()
        gradients = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
        assert all(gradient.isfinite().all() for gradient in gradients)
        assert any(gradient.abs().max() > 0 for gradient in gradients)
        losses[quality] = loss.item()
    assert losses[10] > losses[90] + 0.01
