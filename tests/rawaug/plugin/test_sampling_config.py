"""What is drawn by names and numbers: a camera in a light, one tone curve, an exposure, noise at an ISO."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from rawaug.isp.cameras import LAMPS, gains_in_light, light_range, load_cameras, sample_lights, white_point
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.sampling_config import SamplingConfig

PICTURE = torch.randint(256, (3, 16, 24), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_lamp_and_a_temperature_give_their_gains() -> None:
    camera = load_cameras().select(["Nikon D750"])
    lamp = SamplingConfig(camera="Nikon D750", light="LED-B1", exposure=0.0).make()
    expected = gains_in_light(camera, white_point(LAMPS["LED-B1"]))
    drawn = torch.stack([lamp.sample(PICTURE, seeded(k)).isp.gains for k in range(20)])
    balance = drawn / drawn[:, 1:2]
    torch.testing.assert_close(balance.mean(dim=0), expected[0].float(), atol=0.05, rtol=0)
    warm, cold = (lamp.redrawn("upi", light=kelvin, exposure=(0, 0)) for kelvin in (2500, 9000))
    red, blue = zip(*(a.sample(PICTURE, seeded()).isp.gains[[0, 2]].tolist() for a in (warm, cold)), strict=True)
    assert red[0] < red[1] and blue[0] > blue[1], "incandescent light needs less red gain and more blue"
    assert sample_lights(5, seeded(), light_range("FL11")).std(axis=0).max() < 0.05


def test_one_tone_curve_is_drawn_and_the_camera_stays() -> None:
    augment = SamplingConfig().make()
    names = augment.isp.info["tones"]
    any_tone = augment.sample(PICTURE, seeded())
    setting = augment.redrawn("cycleisp_sidd", tone="Nikon D750").sample(PICTURE, seeded())
    assert setting.isp.tone_weights.argmax() == names.index("Nikon D750") and setting.isp.tone_weights.max() == 1
    assert torch.equal(setting.isp.matrix, any_tone.isp.matrix) and torch.equal(setting.isp.gains, any_tone.isp.gains)


@pytest.mark.parametrize(
    "drawing",
    [
        SamplingConfig("universal", "Nikon D750", 4000, "linear", -0.5, "Nikon D750", iso=1600, cfa="BGGR"),
        SamplingConfig(isp="gopro-hero", noise=(1e-3, 1e-5), cfa="XTRANS", exposure=-1.0),
    ],
)
def test_redrawn_is_what_a_new_one_draws(drawing: SamplingConfig) -> None:
    new = drawing.make()
    shared = RawAugment.from_pretrained(drawing.isp, camera=drawing.camera, cfa=drawing.cfa).redrawn(**drawing.draws())
    first, second = (augment(PICTURE, seeded(3)) for augment in (new, shared))
    assert torch.equal(first.noisy, second.noisy) and torch.equal(first.clean, second.clean)
    assert new.cfa == drawing.cfa and new.exposure == (drawing.exposure, drawing.exposure)
    assert new.mosaic(first.clean).shape == (1, 16, 24)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"light": "LED-B9"}, r"light 'LED-B9' is unknown; .*nearest: LED-B"),
        ({"light": 500}, "2000 to 10000 kelvin, got 500"),
        ({"tone": "nikon"}, r"tone 'nikon' is no curve of this ISP"),
        ({"tone": "linear", "isp": "gopro-hero"}, "not of a fitted ISP"),
        ({"light": 5000, "sampling": "chosen"}, "not with sampling 'chosen'"),
        ({"iso": 800, "noise": (1e-3, 1e-5)}, "iso is for the noise of a measured camera"),
        ({"iso": 800, "noise": "upi"}, "does not depend on ISO"),
    ],
)
def test_what_cannot_be_drawn_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SamplingConfig(**settings).make()


def test_a_curve_without_a_name_is_refused() -> None:
    universal = DictionaryISP.from_pretrained("universal")
    universal.info = {}
    with pytest.raises(ValueError, match="none by name"):
        RawAugment(universal, tone="linear")
