"""The universal ISP as shipped: what its hulls hold, and that tone curves go both ways."""

from __future__ import annotations

import pytest
import torch

from rawaug.isp.cameras import published_cameras
from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import CameraDictionary
from rawaug.isp.model import DictionaryISP
from rawaug.isp.universal import TONE_AND_CAMERAS, camera_points, held, inverse_gains_in_any_light
from rawaug.metrics import psnr as image_psnr


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("name", "least"), [("universal", 0.97), ("universal-small", 0.9)])
def test_the_hull_holds_the_published_cameras(name: str, least: float) -> None:
    isp = DictionaryISP.from_pretrained(name)
    assert isinstance(isp.colour, CameraDictionary)
    atoms = isp.colour.xyz_to_camera(torch.eye(isp.config.colour_atoms))
    share = held(camera_points(published_cameras().xyz_to_camera), camera_points(atoms))
    assert share >= least
    assert share == pytest.approx(isp.info["holds"]["cameras"], abs=0.002)


def test_gain_atoms_hold_lights_that_they_were_not_chosen_for(universal: DictionaryISP) -> None:
    atoms = 1.0 / universal.gain.channel_gains().detach().double()
    others = inverse_gains_in_any_light(published_cameras().xyz_to_camera[::7], "test", 400)
    assert held(others / 3**0.5, atoms / 3**0.5) > 0.95


def test_readings_find_tone_and_camera_as_well(universal: DictionaryISP) -> None:
    srgb = torch.rand(1, 3, 32, 32, generator=generator()) * 0.85
    truth = universal.draw_setting(1, generator(3))
    raw = universal.reverse(srgb, truth).raw
    place = torch.randint(32, (1, 64, 2), generator=generator(4))
    value = raw[0, 0, place[0, :, 0], place[0, :, 1]]
    given = torch.cat([place.float(), value[None, :, None]], dim=2)
    known, blind = universal.reverse(srgb, raw_samples=given).raw, universal.reverse(srgb).raw
    assert image_psnr(known, raw) > image_psnr(blind, raw) + 15
    assert image_psnr(known, raw) > 42


def test_a_curve_stands_in_place_of_tone_and_gamma() -> None:
    with pytest.raises(ValueError, match="replaces tone and gamma"):
        DictionaryISP(ISPConfig(stages=("tone", "curve"), tone_atoms=2))
    with pytest.raises(ValueError, match="with the stage curve"):
        ISPConfig(stages=TONE_AND_CAMERAS)
