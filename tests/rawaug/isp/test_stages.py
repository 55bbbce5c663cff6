"""Each stage and its inverse, and what keeps it physical."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from rawaug import bayer
from rawaug.isp import functional, layers
from rawaug.isp.config import POINTWISE_STAGES, ISPConfig, ISPParams
from rawaug.isp.fast import BakedISP
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import STAGES, Stage, Tables
from rawaug.isp.tone import ToneDictionary, to_code, to_linear
from rawaug.metrics import psnr


@pytest.fixture
def x() -> torch.Tensor:
    return torch.rand(2, 3, 6, 8, generator=torch.Generator().manual_seed(0))


def test_untrained_networks_are_the_identity(x: torch.Tensor) -> None:
    assert torch.equal(layers.ToneNetwork()(x), x)
    where = functional.frame_coordinates(6, 8)
    assert torch.equal(layers.AttentionMask()(x, where), torch.ones(2, 1, 6, 8))
    torch.testing.assert_close(layers.GaussianMask()(where), torch.ones(1, 1, 6, 8), atol=3e-4, rtol=0)


def test_a_tone_network_starts_from_exactly_the_curve(x: torch.Tensor) -> None:
    torch.manual_seed(0)
    tone, toe = layers.ToneNetwork(), 0.055 / 1.055
    tone.start_from(toe)
    torch.testing.assert_close(tone(x), (x + 0.055) / 1.055, atol=1e-6, rtol=0)
    tone.start_from(0.0)
    assert torch.equal(tone(x), x)


def test_highlights_come_back_saturated() -> None:
    gains = torch.tensor([[2.0, 1.0, 1.5]])
    white = torch.ones(1, 3, 1, 1)
    assert torch.equal(functional.inverse_gains(white, gains), white)
    torch.testing.assert_close(functional.inverse_gains(white, gains, knee=None).flatten(), 1 / gains[0])


def test_a_gain_below_one_divides_plainly_in_highlights_too() -> None:
    """Bending its factor towards 1 would make bright pixels darker than the plain division does."""
    gains, bright = torch.tensor([[2.0, 0.8, 1.5]]), torch.linspace(0.9, 1.0, 11).expand(1, 3, 1, 11)
    spared, plain = (functional.inverse_gains(bright, gains, knee=knee) for knee in (0.9, None))
    torch.testing.assert_close(spared[:, 1], plain[:, 1])
    assert (spared[:, 0::2, :, 1:] > plain[:, 0::2, :, 1:]).all()


def test_a_crop_keeps_its_place_in_the_frame() -> None:
    whole = functional.frame_coordinates(20, 30)
    crop = functional.frame_coordinates(8, 10, offset=(4, 6), frame=(20, 30))
    torch.testing.assert_close(crop, whole[..., 4:12, 6:16])
    corner = functional.frame_coordinates(2000, 3000)[0, :, -1, -1]
    assert corner.norm().item() == pytest.approx(1.0, abs=1e-3)


def test_gaussian_mask_takes_mean_and_precision() -> None:
    mask = layers.GaussianMask()
    mean, precision = torch.tensor([0.1, -0.2]), torch.tensor([[0.8, 0.1], [0.1, 0.5]])
    mask.set(mean, precision)
    torch.testing.assert_close(mask.precision, precision)
    coordinates = functional.frame_coordinates(40, 60)
    p = coordinates[0] - mean[:, None, None]
    expected = torch.exp(-0.5 * (0.8 * p[0] ** 2 + 0.2 * p[0] * p[1] + 0.5 * p[1] ** 2))
    torch.testing.assert_close(mask(coordinates)[0, 0], expected)


def vignetted_wall(height: int = 24, width: int = 36) -> tuple[torch.Tensor, torch.Tensor]:
    """Coordinates, and what is left of the light there: 60 % in the corners, around a point off centre."""
    where = functional.frame_coordinates(height, width)
    centre = torch.tensor([0.1, -0.05])[None, :, None, None]
    return where, torch.exp(-0.5 * ((where - centre) ** 2).sum(1, keepdim=True))


def descend(module: nn.Module, wanted: torch.Tensor, *inputs: torch.Tensor) -> float:
    """The largest error after descending on the squared one."""
    optimiser = torch.optim.Adam(module.parameters(), lr=0.02)
    for _ in range(800):
        loss = ((module(*inputs) - wanted) ** 2).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return float((module(*inputs) - wanted).detach().abs().max())


def test_a_gaussian_mask_is_learned_from_scratch() -> None:
    where, light = vignetted_wall()
    assert descend(layers.GaussianMask(), light, where) < 0.01


def test_a_mask_that_was_set_flat_can_still_be_learned() -> None:
    mask = layers.GaussianMask()
    mask.set(torch.zeros(2), torch.zeros(2, 2))
    where, light = vignetted_wall()
    assert descend(mask, light, where) < 0.01


def test_the_attention_mask_sees_where_a_pixel_is() -> None:
    torch.manual_seed(0)
    where, light = vignetted_wall()
    wall = torch.full((1, 3, 24, 36), 0.5)
    assert descend(layers.AttentionMask(), light, wall, where) < 0.05


class Squeeze(Stage):
    """``x1 = x - s x (1 - x)``, in the place of the tone network."""

    name, makes = "squeeze", 1

    def __init__(self, config: ISPConfig) -> None:
        super().__init__(config)
        self.strength = nn.Parameter(torch.tensor(0.3))

    def reverse(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        return x - self.strength * x * (1.0 - x)

    def forward(self, x: Tensor, params: ISPParams | None, coordinates: Tensor | None = None) -> Tensor:
        b = 1.0 - self.strength
        return ((b * b + 4.0 * self.strength * x).sqrt() - b) / (2.0 * self.strength)

    def bake(self, tables: Tables, forward: bool = False) -> Tables:
        return tables._replace(x2=(self.forward if forward else self.reverse)(tables.x2, None))


@pytest.fixture
def squeeze() -> Iterator[None]:
    STAGES.register("squeeze")(Squeeze)
    yield
    del STAGES._things["squeeze"]


@pytest.fixture
def srgb() -> Tensor:
    return torch.rand(2, 3, 16, 24, generator=torch.Generator().manual_seed(0)) * 0.8 + 0.1


@pytest.mark.usefixtures("squeeze")
def test_a_new_stage_is_reversed_baked_chosen_by_and_saved(tmp_path: Path, srgb: Tensor) -> None:
    isp = DictionaryISP(ISPConfig(stages=("squeeze", *POINTWISE_STAGES[1:]), encoders=True))
    result = isp.reverse(srgb, intermediates=True)
    torch.testing.assert_close(result.intermediates["x1"], srgb - 0.3 * srgb * (1.0 - srgb))
    x5 = isp.stages.reverse(srgb, result.params)
    torch.testing.assert_close(isp.stages.forward(x5, result.params), srgb, atol=1e-4, rtol=0)
    baked = BakedISP(isp)
    for chosen, expected in zip(baked.host.choose(srgb), result.params, strict=True):
        torch.testing.assert_close(chosen, expected, atol=1e-3, rtol=0)
    assert psnr(baked(srgb, result.params), bayer.pack(result.raw, isp.cfa)).min().item() > 75.0
    with torch.no_grad():
        isp.get_parameter("stages.squeeze.strength").fill_(0.1)
    isp.save(tmp_path / "camera.safetensors")
    again = DictionaryISP.from_pretrained(tmp_path / "camera.safetensors")
    assert torch.equal(again.reverse(srgb).raw, isp.reverse(srgb).raw)


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
    with pytest.raises(ValueError, match="'tone'"):
        isp.configure(stages=("tone", "gamma"))


def test_curves_go_both_ways(universal: DictionaryISP) -> None:
    assert universal.tone is not None
    tables = universal.tone.curves
    code = torch.rand(len(tables), 3, 8, 8, generator=torch.Generator().manual_seed(0))
    there = to_linear(code, tables)
    torch.testing.assert_close(to_linear(to_code(there, tables), tables), there, atol=1e-5, rtol=0)
    assert torch.equal(to_code(torch.tensor([[[[-1.0, 2.0]]]]), tables[:1]), torch.tensor([[[[0.0, 1.0]]]]))


def test_a_mixture_of_curves_has_the_same_bits_in_any_batch_with_and_without_zeros() -> None:
    tone = ToneDictionary(5)
    tone.curves.copy_(torch.rand(5, tone.curves.shape[1], generator=torch.Generator().manual_seed(0)))
    weights = torch.tensor([[0.0, 0.3, 0.0, 0.7, 0.0], [0.1, 0.2, 0.3, 0.15, 0.25], [0.0, 0.0, 0.0, 0.0, 1.0]])
    mixed = tone.combine(weights)
    torch.testing.assert_close(mixed, weights @ tone.curves)
    assert all(torch.equal(tone.combine(row[None])[0], table) for row, table in zip(weights, mixed, strict=True))
    fitted = weights.clone().requires_grad_()
    assert torch.equal(tone.combine(fitted), mixed)
    tone.combine(fitted)[:, 500].sum().backward()
    torch.testing.assert_close(fitted.grad, tone.curves[:, 500].expand(3, 5))
