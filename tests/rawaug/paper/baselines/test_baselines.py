"""The contract that all methods keep: one interface, published sizes, their own randomness."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.isp.config import ISPConfig, ReverseISP
from rawaug.isp.model import DictionaryISP
from rawaug.paper.baselines import BASELINES, BaselineISP, CycleISP, InvertibleGrey, InvISP, UNetISP

SMALL: dict[str, dict[str, Any]] = {
    "upi": {},
    "upi-tuned": {},
    "unet": {"width": 4},
    "cycleisp": {"features": 8, "groups": 1, "blocks": 1},
    "invisp": {"blocks": 2, "growth": 4},
    "invgrey": {"features": 4, "blocks": 1},
}


def small(name: str, cfa: CFA | str = "RGGB") -> BaselineISP:
    return BASELINES[name](cfa, **SMALL[name])


def test_every_method_is_covered() -> None:
    assert set(SMALL) == set(BASELINES)
    assert [name for name, method in BASELINES.items() if not method.trainable] == ["upi"]


@pytest.mark.parametrize(
    ("method", "millions"), [(UNetISP, 11.77), (CycleISP, 3.14), (InvISP, 1.41), (InvertibleGrey, 0.74)]
)
def test_published_number_of_parameters(method: type[BaselineISP], millions: float) -> None:
    with torch.device("meta"):
        assert method().reverse_parameters / 1e6 == pytest.approx(millions, abs=0.02)


@pytest.mark.parametrize("cfa", list(CFA))
@pytest.mark.parametrize("name", list(BASELINES))
def test_shapes_and_range_both_ways(name: str, cfa: CFA) -> None:
    model, srgb = small(name, cfa), torch.rand(2, 3, 14, 22, generator=torch.Generator().manual_seed(0))
    raw = model.reverse(srgb)
    assert raw.shape == (2, 1, 14, 22)
    assert raw.min() >= 0.0 and raw.max() <= 1.0
    if model.bidirectional:
        rendered = model.cycle(srgb)
        assert rendered.shape == srgb.shape
        assert rendered.min() >= 0.0 and rendered.max() <= 1.0


@pytest.mark.parametrize("name", list(BASELINES))
def test_a_site_keeps_its_own_channel(name: str) -> None:
    model, srgb = small(name, "BGGR"), torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    linear = model.unprocess(srgb).clamp(0.0, 1.0)
    raw = model.reverse(srgb)
    assert torch.equal(raw[:, 0, 0::2, 0::2], linear[:, 2, 0::2, 0::2])
    assert torch.equal(raw[:, 0, 1::2, 0::2], linear[:, 1, 1::2, 0::2])


@pytest.mark.parametrize("name", list(BASELINES))
def test_bad_pictures_are_refused(name: str) -> None:
    model = small(name)
    for shape, message in (((3, 8, 8), "B, 3, H, W"), ((1, 3, 7, 8), "even sides")):
        with pytest.raises(ValueError, match=message):
            model.reverse(torch.rand(shape))
    with pytest.raises(ValueError, match=r"torch\.int32"):
        model.reverse(torch.zeros(1, 3, 8, 8, dtype=torch.int32))
    with pytest.raises(ValueError, match="only converts sRGB to RAW" if name == "unet" else "mosaic|reference"):
        model(torch.rand(1, 3, 8, 8) if name != "unet" else torch.rand(1, 1, 8, 8))


def test_the_unet_says_that_it_does_not_render() -> None:
    with pytest.raises(ValueError, match=r"unet only converts sRGB to RAW; rawaug\.paper\.baselines lists"):
        small("unet")(torch.rand(1, 1, 8, 8))


@pytest.mark.parametrize("name", ["unet", "cycleisp", "invisp", "invgrey"])
def test_weights_come_from_the_seed_alone(name: str) -> None:
    before = torch.get_rng_state()
    first, same, other = (BASELINES[name](seed=seed, **SMALL[name]) for seed in (1, 1, 2))
    assert torch.equal(before, torch.get_rng_state())
    states = [torch.cat([value.flatten() for value in model.state_dict().values()]) for model in (first, same, other)]
    assert torch.equal(states[0], states[1]) and not torch.equal(states[0], states[2])


@pytest.mark.parametrize("name", ["dictionary", *BASELINES])
def test_every_method_makes_raw_through_one_interface(name: str) -> None:
    model = DictionaryISP(ISPConfig(cfa="GBRG")) if name == "dictionary" else small(name, "GBRG")
    srgb = torch.rand(2, 3, 16, 20, generator=torch.Generator().manual_seed(0))
    assert isinstance(model, ReverseISP) and model.name == name and model.cfa == CFA("GBRG") and model.info == {}
    with torch.no_grad():
        made = model.make(srgb)
        drawn = [model.draw(srgb, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
        assert made.shape == drawn[0].shape == (2, 1, 16, 20)
        assert torch.equal(drawn[0], drawn[1])
        assert torch.equal(drawn[0], drawn[2]) == (name not in ("dictionary", "upi"))
        if model.bidirectional:
            assert model.cycle(srgb).shape == srgb.shape
