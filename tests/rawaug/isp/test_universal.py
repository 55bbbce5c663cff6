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
    greedy_atoms,
    held,
    inverse_gains_in_any_light,
    tone_tables,
)
from rawaug.isp.cameras import colour_matrix, published_cameras
from rawaug.isp.config import ISPConfig
from rawaug.isp.dictionary import CameraDictionary
from rawaug.isp.model import DictionaryISP
from rawaug.isp.tone import NODES, STEPS, srgb_to_linear
from rawaug.metrics import psnr


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_squared_distance_is_the_error_on_pictures() -> None:
    colours = torch.rand(3, 500, generator=generator()).double() ** 2
    first, second = colour_matrix(distinct_cameras()[[3, 90]])
    a, b = colour_coordinates(torch.stack([first, second]), colours @ colours.T / 500)
    error = (first @ colours - second @ colours).square().mean()
    assert (a - b).square().sum().item() == pytest.approx(error.item(), rel=1e-9)


def test_greedy_atoms_of_some_cameras_reach_the_others() -> None:
    photographs = torch.tensor([[0.130, 0.122, 0.118], [0.122, 0.128, 0.130], [0.118, 0.130, 0.148]])
    points = colour_coordinates(colour_matrix(distinct_cameras()), photographs)
    seen, unseen = points[0::8], points[4::8]
    greedy = held(unseen, seen[greedy_atoms(seen, 4)])
    by_chance = held(unseen, seen[torch.randperm(len(seen), generator=generator())[:4]])
    assert greedy > max(0.65, by_chance + 0.4)


def test_curves_rise_from_black_to_white() -> None:
    tables = torch.stack(list(tone_tables().values()))
    assert tables.shape == (27, NODES)
    assert (tables.diff(dim=1) >= 0).all()
    assert (tables[:, 0].abs() < 1e-6).all() and torch.allclose(tables[:, -1], torch.ones(len(tables)))


def test_every_inverse_passes_through_the_measured_points() -> None:
    curves = json.loads(CURVES.read_text())["curves"]
    display = srgb_to_linear(torch.linspace(0, 1, NODES, dtype=torch.float64))
    for name, points in curves.items():
        table = tone_tables()[name].double()
        for light, shown in points[1:]:
            right = int(torch.searchsorted(display, shown).clamp(1, NODES - 1))
            assert table[right - 1] - 1e-6 <= light <= table[right] + 1e-6, name


def test_cameras_lift_the_middle_where_the_linear_rendering_does_not() -> None:
    middle = torch.stack(list(tone_tables().values()))[:, 118 * STEPS]
    linear = tone_tables()["linear"][118 * STEPS]
    assert linear.item() == pytest.approx(0.1812, abs=1e-4)  # sRGB's definition at 118 / 255
    assert (torch.log2(linear / middle[2:]) > 0.25).all()


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
    assert psnr(known, raw) > psnr(blind, raw) + 15
    assert psnr(known, raw) > 42


def test_a_curve_stands_in_place_of_tone_and_gamma() -> None:
    with pytest.raises(ValueError, match="replaces tone and gamma"):
        DictionaryISP(ISPConfig(stages=("tone", "curve"), tone_atoms=2))
    with pytest.raises(ValueError, match="with the stage curve"):
        ISPConfig(stages=("curve", "colour", "gains"))
