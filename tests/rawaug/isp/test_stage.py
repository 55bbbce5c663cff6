"""Stages as objects: a new one needs its class alone, an unknown one is an error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.isp.config import POINTWISE_STAGES, ISPConfig, ISPParams
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import STAGES, Stage, Tables, register, stage_class
from rawaug.metrics import psnr


class Squeeze(Stage):
    """``x1 = x - s x (1 - x)``, in the place of the tone network."""

    name, makes = "squeeze", 1

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.strength = nn.Parameter(torch.tensor(0.3))

    def reverse(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        return x - self.strength * x * (1.0 - x)

    def forward(self, x: Tensor, params: ISPParams | None, place: Tensor | None = None) -> Tensor:
        b = 1.0 - self.strength
        return ((b * b + 4.0 * self.strength * x).sqrt() - b) / (2.0 * self.strength)

    def bake(self, tables: Tables) -> Tables:
        return tables._replace(x2=self.reverse(tables.x2, None))


@pytest.fixture
def squeeze() -> Iterator[None]:
    register(Squeeze)
    yield
    del STAGES["squeeze"]


@pytest.fixture
def srgb() -> Tensor:
    return torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1


@pytest.mark.usefixtures("squeeze")
def test_a_new_stage_is_reversed_baked_chosen_by_and_saved(tmp_path: Path, srgb: Tensor) -> None:
    isp = DictionaryISP(ISPConfig(stages=("squeeze", *POINTWISE_STAGES[1:]), encoders=True))
    result = isp.reverse(srgb, intermediates=True)
    torch.testing.assert_close(result.intermediates["x1"], srgb - 0.3 * srgb * (1.0 - srgb))
    x5 = isp.reverse_pixels(srgb, result.params)
    torch.testing.assert_close(isp.forward_pixels(x5, result.params), srgb, atol=1e-4, rtol=0)
    baked = BakedISP(isp)
    for chosen, expected in zip(baked.choose(srgb), result.params, strict=True):
        torch.testing.assert_close(chosen, expected, atol=1e-3, rtol=0)
    assert psnr(baked(srgb, result.params), bayer.pack(result.raw, isp.cfa)).min().item() > 75.0
    with torch.no_grad():
        isp.get_parameter("stages.squeeze.strength").fill_(0.1)
    isp.save(tmp_path / "camera.safetensors")
    again = DictionaryISP.from_pretrained(tmp_path / "camera.safetensors")
    assert torch.equal(again.reverse(srgb).raw, isp.reverse(srgb).raw)


def test_an_unknown_stage_is_refused_by_name() -> None:
    with pytest.raises(ValueError, match="'squeeze' is unknown; choose of tone gamma colour gains shading"):
        DictionaryISP(ISPConfig(stages=("squeeze", "gamma")))
    with pytest.raises(ValueError, match="'vignette' is unknown"):
        stage_class("vignette")


@pytest.mark.usefixtures("squeeze")
def test_a_name_is_registered_once() -> None:
    assert register(Squeeze) is Squeeze
    with pytest.raises(ValueError, match="'squeeze' is registered already"):
        register(type("Other", (Squeeze,), {}))


def test_configure_removes_stages_and_sets_the_knee(srgb: Tensor) -> None:
    isp = DictionaryISP()
    with torch.no_grad():
        isp.gain.log_gains.fill_(0.5)
    before = isp.reverse(0.99 + 0.01 * srgb).raw
    isp.configure(knee=0.5)
    assert not torch.equal(isp.reverse(0.99 + 0.01 * srgb).raw, before)
    isp.configure(stages=("gamma", "gains"))
    assert list(isp.reverse(srgb, intermediates=True).intermediates) == ["x2", "x4"]
    assert not any("tone" in name or "shading" in name for name in isp.state_dict())
    with pytest.raises(ValueError, match="'tone' is not in this ISP, which has gamma gains"):
        isp.configure(stages=("tone", "gamma"))
