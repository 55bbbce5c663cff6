"""A scene exposed by the ISP itself is recovered by merging, and goes back to sRGB without clipped highlights."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.data.demo import demo_photographs
from rawaug.isp.config import ISPConfig
from rawaug.isp.exposures import merge_exposures, render_exposure
from rawaug.isp.model import DictionaryISP

STOPS = (-2.0, 0.0, 2.0)


@pytest.fixture(scope="module")
def isp() -> DictionaryISP:
    """A gamma camera with a colour matrix and gains."""
    return DictionaryISP(ISPConfig(attention=False))


@pytest.fixture(scope="module")
def scene(isp: DictionaryISP) -> Tensor:
    """RAW ``(1, 3, 32, 48)`` over ten stops, up to 2.5 times white."""
    generator = torch.Generator().manual_seed(0)
    light = torch.exp2(torch.linspace(-8.0, 1.3, 48)) * (0.7 + 0.3 * torch.rand(1, 3, 32, 48, generator=generator))
    params = isp.choose(torch.zeros(1, 3, 32, 48))
    matrix, gains = params.matrix[0], params.gains[0]
    return torch.einsum("ij,bjhw->bihw", matrix, light) / gains[:, None, None]


@torch.no_grad()
def exposed(isp: DictionaryISP, scene: Tensor, stops: float) -> Tensor:
    """The 8-bit picture that the ISP makes of a scene."""
    srgb = isp.stages.forward(scene * 2.0**stops, isp.choose(torch.zeros_like(scene)))
    return (srgb.clamp(0, 1) * 255).round().to(torch.uint8)


def relative_error(raw: Tensor, scene: Tensor) -> Tensor:
    return (raw - scene).abs().sum(1) / scene.sum(1)


def test_a_bracket_recovers_the_scene(isp: DictionaryISP, scene: Tensor) -> None:
    shots = [exposed(isp, scene, stops) for stops in STOPS]
    merged = relative_error(merge_exposures(isp, shots, STOPS).image, scene)
    single = relative_error(merge_exposures(isp, shots[1:2], [0.0]).image, scene)
    assert merged.max() < 0.08 and merged.mean() < 0.01
    assert single.max() > 0.5 and single.mean() > 5 * merged.mean()


def test_what_is_not_clipped_is_summed_over_summed_exposure(isp: DictionaryISP) -> None:
    dark, bright = torch.full((1, 3, 2, 2), 0.2), torch.full((1, 3, 2, 2), 0.6)
    single = [merge_exposures(isp, [x], [0.0]).image for x in (dark, bright)]
    merged = merge_exposures(isp, [dark, bright], [-1.0, 1.0]).image
    assert torch.allclose(merged, (single[0] + single[1]) / (0.5 + 2.0), rtol=1e-5)


def test_one_clipped_channel_excludes_a_pixel(isp: DictionaryISP) -> None:
    short = torch.full((1, 3, 2, 2), 0.4)
    clipped = torch.tensor([1.0, 0.5, 0.5]).reshape(1, 3, 1, 1).expand(1, 3, 2, 2)
    merged = merge_exposures(isp, [clipped, short], [2.0, 0.0]).image
    assert torch.allclose(merged, merge_exposures(isp, [short], [0.0]).image, rtol=1e-5)


def test_the_shortest_exposure_decides_where_all_are_clipped(isp: DictionaryISP) -> None:
    white = torch.ones(1, 3, 2, 2)
    merged = merge_exposures(isp, [white, white, white], STOPS).image
    assert torch.allclose(merged, 4.0 * merge_exposures(isp, [white], [0.0]).image, rtol=1e-5)


@pytest.mark.parametrize("name", ["gamma camera", "universal-small"])
def test_one_picture_at_its_own_exposure_comes_back(isp: DictionaryISP, name: str) -> None:
    camera = isp if name == "gamma camera" else DictionaryISP.from_pretrained(name)
    photograph = demo_photographs("test")["chelsea"][None, :, ::4, ::4]
    merged = merge_exposures(camera, [photograph], [0.0])
    back = render_exposure(camera, merged.image, merged.params)
    assert (back - photograph / 255.0).abs().max() < 0.5 / 255


def test_highlights_are_compressed_in_order_and_keep_their_colour(isp: DictionaryISP, scene: Tensor) -> None:
    light = torch.exp2(torch.linspace(-5.0, 3.0, 64)).expand(1, 1, 2, 64)
    colour = torch.tensor([1.0, 0.6, 0.4]).reshape(1, 3, 1, 1)
    params = isp.choose(torch.zeros(1, 3, 2, 64))
    raw = torch.einsum("ij,bjhw->bihw", params.matrix[0], colour * light) / params.gains[0][:, None, None]
    srgb = render_exposure(isp, raw, params)
    assert (srgb[0, 0].diff(dim=-1) > 0).all() and srgb.max() <= 1.0
    linear = srgb**2.2
    assert torch.allclose(linear / linear[:, :1], colour.expand_as(linear), rtol=1e-2)
    dark = light[0, 0] < 0.18
    assert torch.allclose(linear[0, 0][dark], light[0, 0][dark], rtol=1e-3)


def test_what_is_no_bracket_is_refused(isp: DictionaryISP) -> None:
    small, large = torch.zeros(1, 3, 2, 2), torch.zeros(1, 3, 4, 2)
    for pictures, stops, message in (
        ([], [], "got 0 for 0"),
        ([small], [0.0, 1.0], "got 2 for 1"),
        ([small, small], [1.0, 1.0], "must differ, got \\+1 \\+1 EV"),
        ([small, large], [0.0, 1.0], "one shape"),
    ):
        with pytest.raises(ValueError, match=message):
            merge_exposures(isp, pictures, stops)
