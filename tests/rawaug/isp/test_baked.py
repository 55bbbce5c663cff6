"""The baked reverse pass against the ISP itself."""

from __future__ import annotations

import pytest
import torch

from rawaug import bayer
from rawaug.isp.baked import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import POINTWISE_STAGES, ISPConfig
from rawaug.metrics import psnr


def curved_isp(**settings: object) -> DictionaryISP:
    """An ISP with atoms apart from each other, and with tone, attention and shading that do something."""
    generator = torch.Generator().manual_seed(0)
    isp = DictionaryISP(ISPConfig(cfa="GBRG", colour_atoms=3, gain_atoms=3, **settings), generator)  # type: ignore[arg-type]
    with torch.no_grad():
        isp.colour.matrices.add_(0.3 * torch.rand(3, 3, 3, generator=generator))
        for network in (isp.reverse_networks.tone, isp.reverse_networks.attention):
            list(network.parameters())[-2].normal_(std=0.05, generator=generator)
    isp.shading.set(torch.tensor([0.1, 0.0]), 0.5 * torch.eye(2))
    return isp


@pytest.mark.parametrize("attention", [False, True])
def test_baked_is_the_isp_above_75_db(attention: bool) -> None:
    isp = curved_isp(attention=attention)
    generator = torch.Generator().manual_seed(1)
    srgb = torch.randint(256, (4, 3, 48, 64), generator=generator, dtype=torch.uint8)
    params = isp.choose(srgb)
    unbaked = bayer.pack(isp.reverse(srgb, params).raw, isp.cfa)
    assert psnr(BakedISP(isp)(srgb, params), unbaked).min().item() > 75.0


@pytest.mark.parametrize("left_out", POINTWISE_STAGES)
def test_any_stage_may_be_left_out(left_out: str) -> None:
    isp = curved_isp(stages=tuple(stage for stage in POINTWISE_STAGES if stage != left_out))
    srgb = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(1))
    params = isp.choose(srgb)
    unbaked = bayer.pack(isp.reverse(srgb, params).raw, isp.cfa)
    assert psnr(BakedISP(isp)(srgb, params), unbaked).item() > 75.0


def test_bytes_and_floats_agree() -> None:
    isp = curved_isp()
    srgb = torch.randint(256, (1, 3, 16, 16), generator=torch.Generator().manual_seed(1), dtype=torch.uint8)
    params, baked = isp.choose(srgb), BakedISP(isp)
    torch.testing.assert_close(baked(srgb, params), baked(srgb / 255.0, params), atol=1e-6, rtol=1e-5)


def test_another_order_of_stages_is_refused() -> None:
    isp = DictionaryISP(ISPConfig(stages=("gamma", "tone", "colour", "gains")))
    with pytest.raises(ValueError, match="usual order"):
        BakedISP(isp)
