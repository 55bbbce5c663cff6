"""CycleISP: its blocks, checkpoints in the published layout, the picture that colours its rendering, its cycle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch.nn import functional as F

from denoisers.cycleisp import RENAMED, DualAttentionBlock
from rawaug import bayer
from rawaug.paper.baselines.base import Crops
from rawaug.paper.baselines.cycleisp import CycleISP

SMALL: dict[str, Any] = {"features": 8, "groups": 2, "blocks": 1}


def part_of(model: CycleISP, part: str) -> torch.nn.Module:
    return {"rgb2raw": model.reverse_network, "raw2rgb": model.raw2rgb, "ccm": model.colour_branch}[part]


@pytest.mark.parametrize("part", ["rgb2raw", "raw2rgb", "ccm"])
def test_published_weights_load(part: str, tmp_path: Path) -> None:
    """Under their published names, with what is published beside them; other files are tested with the denoiser."""
    model, published = CycleISP(**SMALL, seed=1), part_of(CycleISP(**SMALL, seed=2), part).state_dict()
    renamed = {"module.blur.weight": torch.zeros(3, 1, 21, 21)}
    for key, value in published.items():
        for theirs, own in RENAMED:
            key = key.replace(own, theirs)
        renamed[f"module.{key}"] = value
    torch.save({"epoch": 3, "state_dict": renamed}, tmp_path / "part.pth")

    model.load_published(tmp_path / "part.pth", part)
    loaded = part_of(model, part).state_dict()
    assert all(torch.equal(loaded[key], published[key]) for key in published)


def test_a_part_that_there_is_not_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="rgb2raw"):
        CycleISP(**SMALL).load_published(tmp_path / "part.pth", "rgb2rgb")


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


@torch.no_grad()
def test_the_picture_colours_the_rendering() -> None:
    model = CycleISP(**SMALL)
    generator = torch.Generator().manual_seed(0)
    raw, srgb = torch.rand(1, 1, 16, 16, generator=generator), torch.rand(1, 3, 16, 16, generator=generator)
    first, second = model(raw, srgb), model(raw, 1.0 - srgb)
    assert first.shape == (1, 3, 16, 16) and not torch.equal(first, second)
    with pytest.raises(ValueError, match="scene"):
        model(raw)
    with pytest.raises(ValueError, match="pixels"):
        model(raw[..., :8, :], srgb[..., :8, :])
    with pytest.raises(ValueError, match="both=True"):
        CycleISP(**SMALL, both=False)(raw, srgb)


def test_the_networks_are_trained_apart_and_then_on_the_cycle() -> None:
    generator = torch.Generator().manual_seed(0)
    srgb = torch.rand(1, 3, 32, 32, generator=generator)
    crops = Crops(srgb, torch.rand(1, 1, 32, 32, generator=generator), torch.ones(1, 3))
    model = CycleISP(**SMALL)

    with torch.no_grad():
        cycled = F.l1_loss(model.render(bayer.mosaic(model.unprocess(srgb), "RGGB"), srgb), srgb)
        error = model.raw_error(bayer.mosaic(model.unprocess(srgb), "RGGB"), crops.raw)
    together = model.loss(crops, share_done=0.9)
    torch.testing.assert_close(together, 0.5 * error + 0.5 * cycled)

    apart = model.loss(crops, share_done=0.1)
    rendered = F.l1_loss(model.render(crops.raw, srgb), srgb)
    torch.testing.assert_close(apart, error + rendered)
    torch.testing.assert_close(model.cycle(srgb), model(model.reverse(srgb), srgb))
