"""What is drawn by names and numbers: a camera in a light, one tone curve, an exposure, noise at an ISO."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch

from rawaug.camera.lights import LAMPS, light_range, sample_lights, white_point
from rawaug.camera.matrices import gains_in_light, load_cameras
from rawaug.isp.model import DictionaryISP
from rawaug.plugin.augment import RawAugment
from rawaug.plugin.camera_noise import with_iso
from rawaug.plugin.config import AugmentConfig
from rawaug.plugin.draw import Draw
from rawaug.plugin.finishing import Finish
from rawaug.plugin.targets import Burst, Srgb

PICTURE = torch.randint(256, (3, 16, 24), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_a_lamp_and_a_temperature_give_their_gains() -> None:
    camera = load_cameras().select(["Nikon D750"])
    lamp = AugmentConfig(camera="Nikon D750", draw=Draw(light="LED-B1", exposure=0.0)).make()
    expected = gains_in_light(camera, white_point(LAMPS["LED-B1"]))
    drawn = torch.stack([lamp.sample(PICTURE, seeded(k)).isp.gains for k in range(20)])
    balance = drawn / drawn[:, 1:2]
    torch.testing.assert_close(balance.mean(dim=0), expected[0].float(), atol=0.05, rtol=0)
    warm, cold = (lamp.with_draws("upi", Draw(light=kelvin, exposure=0)) for kelvin in (2500, 9000))
    red, blue = zip(*(a.sample(PICTURE, seeded()).isp.gains[[0, 2]].tolist() for a in (warm, cold)), strict=True)
    assert red[0] < red[1] and blue[0] > blue[1], "incandescent light needs less red gain and more blue"
    assert sample_lights(5, seeded(), light_range("FL11")).std(axis=0).max() < 0.05


def test_one_tone_curve_is_drawn_and_the_camera_stays() -> None:
    augment = AugmentConfig().make()
    names = augment.isp.info["tones"]
    any_tone = augment.sample(PICTURE, seeded())
    setting = augment.with_draws("cycleisp_sidd", Draw(tone="Nikon D750")).sample(PICTURE, seeded())
    assert setting.isp.tone_weights.argmax() == names.index("Nikon D750") and setting.isp.tone_weights.max() == 1
    assert torch.equal(setting.isp.matrix, any_tone.isp.matrix) and torch.equal(setting.isp.gains, any_tone.isp.gains)


def test_an_iso_of_a_published_camera_is_of_its_own_noise() -> None:
    config = AugmentConfig(camera="Nikon D750", iso=6400.0)
    expected = RawAugment.from_pretrained("universal", camera="Nikon D750", iso=6400.0)
    drawn = [augment.sample(PICTURE, seeded()).noise for augment in (config.make(), expected)]
    assert all(torch.equal(drawn[0][key], drawn[1][key]) for key in drawn[1]) and config.noise == "Nikon D750"
    assert AugmentConfig(camera="Nikon D750").noise == AugmentConfig().noise


CONFIGS = [
    AugmentConfig(
        camera="Nikon D750", noise="Nikon D750", iso=1600, draw=Draw("convex", 0.1, -0.5, 4000, "linear"), cfa="BGGR"
    ),
    AugmentConfig("gopro-hero", noise=(1e-3, 1e-5), draw=Draw(exposure=(-1.0, -1.0)), cfa="XTRANS"),
]


@pytest.mark.parametrize("config", CONFIGS)
def test_with_other_draws_it_is_what_a_new_one_draws(config: AugmentConfig) -> None:
    new = config.make()
    before = RawAugment.from_pretrained(config.isp, camera=config.camera, cfa=config.cfa)
    shared = before.with_draws(with_iso(config.noise, config.iso), config.draw)
    first, second = (augment(PICTURE, seeded(3)) for augment in (new, shared))
    assert torch.equal(first.noisy, second.noisy) and torch.equal(first.clean, second.clean)
    assert new.cfa == config.cfa and new.settings.exposure[0] == new.settings.exposure[1] < 0
    assert new.mosaic(first.clean).shape == (1, 16, 24)


@pytest.mark.parametrize(
    "config",
    [
        *CONFIGS,
        AugmentConfig(target=Srgb(demosaicing=("ahd", "malvar"), jpeg=(40, 95), finish=True), burst=2),
        AugmentConfig(target=Srgb(finish=Finish(unfinished=0.5)), burst=Burst(3, stops=(0.0, -2.0, 1.0))),
    ],
)
def test_settings_go_through_json(config: AugmentConfig) -> None:
    assert AugmentConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"draw": {"light": "LED-B9"}}, r"'LED-B9'.*nearest: LED-B"),
        ({"draw": {"light": 500}}, "2000 to 10000"),
        ({"draw": {"tone": "nikon"}}, "'nikon'"),
        ({"draw": {"tone": "linear"}, "isp": "gopro-hero"}, "fitted"),
        ({"draw": {"light": 5000, "sampling": "chosen"}}, "'chosen'"),
        ({"iso": 800, "noise": (1e-3, 1e-5)}, "ISO"),
        ({"iso": 800, "noise": "upi"}, "ISO"),
    ],
)
def test_what_cannot_be_drawn_is_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AugmentConfig(**settings | {"draw": Draw(**settings.get("draw", {}))}).make()


def test_a_curve_without_a_name_is_refused() -> None:
    universal = DictionaryISP.from_pretrained("universal")
    universal.info = {}
    with pytest.raises(ValueError, match="none by name"):
        RawAugment(universal, draw=Draw(tone="linear"))
