"""CycleISP: blocks, checkpoints in the published layout; InvISP: invertible, balanced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from denoisers.cycleisp import RENAMED, DualAttentionBlock
from rawaug.data.pairs import Pair
from rawaug.paper.baselines.networks import CycleISP, InvISP

SMALL: dict[str, Any] = {"features": 8, "groups": 2, "blocks": 1}


def test_published_weights_load(tmp_path: Path) -> None:
    """Under their published names, with what is published beside them; other files are tested with the denoiser."""
    model, published = CycleISP(**SMALL, seed=1), CycleISP(**SMALL, seed=2).reverse_network.state_dict()
    renamed = {"module.blur.weight": torch.zeros(3, 1, 21, 21)}
    for key, value in published.items():
        for theirs, own in RENAMED:
            key = key.replace(own, theirs)
        renamed[f"module.{key}"] = value
    torch.save({"epoch": 3, "state_dict": renamed}, tmp_path / "part.pth")
    model.load_published(tmp_path / "part.pth")
    loaded = model.reverse_network.state_dict()
    assert all(torch.equal(loaded[key], published[key]) for key in published)


@torch.no_grad()
def test_a_block_weighs_its_features_over_space_and_over_channels() -> None:
    block = DualAttentionBlock(4, 2, torch.nn.PReLU(4))
    for parameter in block.parameters():
        parameter.zero_()
    block.get_parameter("body.2.bias").copy_(torch.tensor([1.0, 2.0, 3.0, 4.0]))  # f is this everywhere
    block.spatial.weight[0, 0, 1, 1] = 1.0  # sigmoid(max = 4)
    block.get_parameter("channel.2.bias").copy_(torch.tensor([0.0, 9.0, 0.0, 0.0]))
    block.merge.weight[0, 0] = block.merge.weight[1, 4 + 1] = 1.0
    out = block(torch.full((1, 4, 5, 5), 0.5))[0, :, 2, 2]
    expected = torch.tensor([0.5 + torch.tensor(4.0).sigmoid(), 0.5 + 2.0 * torch.tensor(9.0).sigmoid(), 0.5, 0.5])
    torch.testing.assert_close(out, expected)


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
    mean = torch.tensor([pair.white_balance for pair in exact_pairs]).log().mean(0).exp()
    srgb = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(model.reverse(srgb), model.reverse(srgb, mean))
