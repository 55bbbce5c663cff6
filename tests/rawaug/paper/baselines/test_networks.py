"""CycleISP: blocks, checkpoints in the published layout."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from denoisers.published import RENAMED, DualAttentionBlock
from rawaug.paper.baselines.networks import CycleISP

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
