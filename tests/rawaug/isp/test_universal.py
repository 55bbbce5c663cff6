"""The universal ISP: how its atoms are chosen, what its hulls hold as shipped, and that tone curves go both ways."""

from __future__ import annotations

import json

import pytest
import torch

from benchmarks.universal import (
    CURVES,
    camera_points,
    colour_coordinates,
    distinct_cameras,
    held,
    inverse_gains_in_any_light,
    tone_tables,
)
from rawaug.camera.matrices import camera_from_srgb, load_cameras
from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import CameraDictionary
from rawaug.isp.model import DictionaryISP
from rawaug.isp.sampling import draw_setting
from rawaug.isp.tone import NODES, srgb_to_linear
from rawaug.metrics import psnr


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_squared_distance_is_the_error_on_pictures() -> None:
    colours = torch.rand(3, 500, generator=generator()).double() ** 2
    first, second = camera_from_srgb(distinct_cameras()[[3, 90]])
    a, b = colour_coordinates(torch.stack([first, second]), colours @ colours.T / 500)
    error = (first @ colours - second @ colours).square().mean()
    assert (a - b).square().sum().item() == pytest.approx(error.item(), rel=1e-9)


def test_every_inverse_passes_through_the_measured_points() -> None:
    curves = json.loads(CURVES.read_text())["curves"]
    display = srgb_to_linear(torch.linspace(0, 1, NODES, dtype=torch.float64))
    for name, points in curves.items():
        table = tone_tables()[name].double()
        for light, shown in points[1:]:
            right = int(torch.searchsorted(display, shown).clamp(1, NODES - 1))
            assert table[right - 1] - 1e-6 <= light <= table[right] + 1e-6, name


@pytest.mark.parametrize(("name", "least"), [("universal", 0.97), ("universal-small", 0.9)])
def test_the_hull_holds_the_published_cameras(name: str, least: float) -> None:
    isp = DictionaryISP.from_pretrained(name)
    assert isinstance(isp.colour, CameraDictionary)
    atoms = isp.colour.xyz_to_camera(torch.eye(isp.config.colour_atoms))
    share = held(camera_points(load_cameras().xyz_to_camera), camera_points(atoms))
    assert share >= least
    assert share == pytest.approx(isp.info["holds"]["cameras"], abs=0.002)


def test_gain_atoms_hold_lights_that_they_were_not_chosen_for(universal: DictionaryISP) -> None:
    atoms = 1.0 / universal.gain.channel_gains().detach().double()
    others = inverse_gains_in_any_light(load_cameras().xyz_to_camera[::7], "test", 400)
    assert held(others / 3**0.5, atoms / 3**0.5) > 0.95


def test_readings_find_tone_and_camera_as_well(universal: DictionaryISP) -> None:
    srgb = torch.rand(1, 3, 32, 32, generator=generator()) * 0.85
    truth = draw_setting(universal, 1, generator(3))
    raw = universal.reverse(srgb, truth).raw
    place = torch.randint(32, (1, 64, 2), generator=generator(4))
    value = raw[0, 0, place[0, :, 0], place[0, :, 1]]
    given = torch.cat([place.float(), value[None, :, None]], dim=2)
    known, blind = universal.reverse(srgb, raw_samples=given).raw, universal.reverse(srgb).raw
    assert psnr(known, raw) > psnr(blind, raw) + 15
    assert psnr(known, raw) > 42


def test_a_curve_stands_in_place_of_tone_and_gamma() -> None:
    with pytest.raises(ValueError, match="tone and gamma"):
        DictionaryISP(ISPConfig(stages=("tone", "curve"), tone_atoms=2))
    with pytest.raises(ValueError, match="curve"):
        ISPConfig(stages=("curve", "colour", "gains"))
