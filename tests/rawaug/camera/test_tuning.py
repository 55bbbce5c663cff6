"""Tuning files of libcamera, made from their published structure with numbers of our own."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rawaug
from rawaug.bayer import CFA
from rawaug.camera.lights import light_xyz
from rawaug.camera.own import Camera

CCMS = {
    2850.0: [[1.9, -0.7, -0.2], [-0.4, 2.0, -0.6], [0.0, -0.9, 1.9]],
    4500.0: [[2.1, -0.9, -0.2], [-0.4, 2.1, -0.7], [-0.1, -0.5, 1.6]],
    6500.0: [[2.2, -1.0, -0.2], [-0.3, 2.0, -0.7], [-0.1, -0.4, 1.5]],
}
WHITES = [2500.0, 0.58, 0.33, 4500.0, 0.36, 0.67, 7500.0, 0.29, 0.75]
BLACKS = {"first": (4096, 0.0, 2.8), "second": (3840, 12.0, 4.1), "third": (1024, 30.0, 1.9)}
"""Black level, constant and slope of the noise of three sensors."""


RED_SHADING = {3000.0: 0.3, 5000.0: 0.15}
"""How much more than green red is shaded, by colour temperature."""
GRIDS = {"first": (12, 16), "second": (32, 32), "third": (12, 16)}
STRENGTHS = {"first": 0.9, "second": 1.3, "third": 0.6}
"""Rows and columns of the shading of three sensors, and how many times the gain of the centre that of a corner is, less
one."""


def gains(sensor: str, power: float, y: Any = None, x: Any = None) -> Any:
    """The gains that undo a lens, off its centre, at (y, x) from 0 to 1, or in the cells of the sensor's table."""
    if y is None:
        rows, columns = GRIDS[sensor]
        y, x = (np.arange(rows)[:, None] + 0.5) / rows, (np.arange(columns) + 0.5) / columns
    return (1 + STRENGTHS[sensor] * 2 * ((y - 0.52) ** 2 + (x - 0.47) ** 2)) ** power


def tuning(sensor: str, version: float = 2.0) -> dict[str, Any]:
    black, constant, slope = BLACKS[sensor]
    parts: dict[str, Any] = {
        "rpi.black_level": {"black_level": black},
        "rpi.noise": {"reference_constant": constant, "reference_slope": slope},
        "rpi.awb": {"ct_curve": WHITES, "bayes": 1},
        "rpi.agc": {"channels": [{"exposure_modes": {"short": {"gain": [1.0, 2.0]}, "normal": {"gain": [1.0, 8.0]}}}]},
        "rpi.contrast": {"ce_enable": 1, "gamma_curve": [0, 0, 1024, 5040, 16384, 40642, 65535, 65535]},
        "rpi.ccm": {"ccms": [{"ct": ct, "ccm": np.ravel(matrix).tolist()} for ct, matrix in CCMS.items()]},
        "rpi.sdn": {},
        "rpi.alsc": {
            "luminance_strength": 0.5,
            "luminance_lut": (1.2 * gains(sensor, 1.0)).ravel().tolist(),
            "calibrations_Cr": [
                {"ct": ct, "table": (2.3 * gains(sensor, share)).ravel().tolist()} for ct, share in RED_SHADING.items()
            ],
            "calibrations_Cb": [{"ct": ct, "table": (1.6 * gains(sensor, 0.1)).ravel().tolist()} for ct in RED_SHADING],
        },
    }
    if version == 1.0:
        return parts
    return {"version": version, "target": "bcm2835", "algorithms": [{name: part} for name, part in parts.items()]}


@pytest.fixture
def write(tmp_path: Path) -> Callable[[Any], Path]:
    def write(content: Any) -> Path:
        path = tmp_path / "imx000.json"
        path.write_text(json.dumps(content))
        return path

    return write


@pytest.mark.parametrize("sensor", BLACKS)
@pytest.mark.parametrize("version", [1.0, 2.0])
def test_what_is_drawn_is_what_the_file_states(write: Callable[[Any], Path], sensor: str, version: float) -> None:
    black, constant, slope = BLACKS[sensor]
    path = write(tuning(sensor, version))
    camera = Camera.from_tuning(path)
    assert Camera.load(path) == camera and camera.source is not None and "imx000.json" in camera.source

    light = rawaug.Draw(light=4500.0, exposure=0.0)
    augment = rawaug.RawAugment.from_pretrained("universal", camera=str(path), iso=400, draw=light)
    params = augment(torch.rand(1, 3, 16, 16)).params
    signal = torch.linspace(0.02, 1.0, 50, dtype=torch.float64)
    codes = 65535 - black
    stated = 4 * ((constant + slope * (signal * codes).sqrt()) / codes) ** 2
    drawn = params.noise["shot_var"].double() * signal + params.noise["read_var"].double()
    if constant == 0:
        assert (drawn / stated - 1).abs().max() < 1e-5
    assert abs(float(drawn.mean() / stated.mean()) - 1) < 0.01

    (anchor,) = [anchor for anchor in camera.anchors() if anchor.light == "4500"]
    inverse = torch.linalg.inv(torch.tensor(CCMS[4500.0], dtype=torch.float64))
    assert (anchor.matrix / inverse - 1).abs().max() < 0.01
    assert anchor.gains.tolist() == pytest.approx([1 / 0.36, 1.0, 1 / 0.67])
    response = anchor.from_xyz @ light_xyz("4500")
    assert (response[1] / response / anchor.gains - 1).abs().max() < 0.01


@pytest.mark.parametrize("sensor", BLACKS)
def test_the_lens_is_shaded_as_the_file_states(write: Callable[[Any], Path], sensor: str) -> None:
    camera = Camera.from_tuning(write(tuning(sensor)))
    grey = torch.full((1, 3, 96, 128), 0.5)
    for ct, red in RED_SHADING.items():
        draw = rawaug.Draw(light=f"{ct:g}", exposure=0.0)
        augment = rawaug.RawAugment.from_pretrained("universal", camera=camera, draw=draw)
        pair = augment(grey)
        for plane, (i, j), power in zip(pair.clean[0], CFA.RGGB.sites, (1 + red, 1.0, 1.0, 1.1), strict=True):
            y, x = (np.arange(i, 96, 2)[:, None] + 0.5) / 96, (np.arange(j, 128, 2) + 0.5) / 128
            ratio = plane.numpy() * gains(sensor, power, y, x)
            assert np.abs(ratio / ratio.mean() - 1).max() < 0.01

        developed = augment.develop(pair.clean, pair.params)
        assert (developed[..., 8:-8, 8:-8] - 0.5).abs().max() < 0.01, "which takes the shading off again"

        crop = augment.apply(
            grey[..., :32, :32], pair.params._replace(crop=torch.tensor([[16, 24, *grey.shape[2:], 0]]))
        )
        assert (crop.clean / pair.clean[..., 8:24, 12:28] - 1).abs().max() < 0.01, "a crop keeps its place"


def test_a_sheet_states_its_shading(tmp_path: Path) -> None:
    table = [[0.5, 0.9, 0.6], [0.8, 1.0, 0.7]]
    camera = Camera("M1", **SHEET, shading={"A": table, "D65": [table, table, np.sqrt(table)]})
    shares = camera.shading_in("A")
    assert shares is not None and shares[2].tolist() == table and camera.shading_in("D50") is not None
    universal = rawaug.DictionaryISP.from_pretrained("universal")
    isp = universal.with_cameras(camera)
    augment = rawaug.RawAugment(isp)
    isp.save(tmp_path / "isp.safetensors")
    again = rawaug.RawAugment.from_pretrained(tmp_path / "isp.safetensors")
    grey = torch.full((1, 3, 32, 48), 0.5)
    pair = augment(grey)
    assert torch.equal(again.apply(grey, pair.params).clean, pair.clean)
    assert pair.clean[0, 1, 0, 0] < 0.7 * pair.clean[0, 1, 8, 12]
    assert "falloff" in isp.stages and "falloff" not in universal.stages


def test_imx477_has_the_variance_that_its_makers_formula_gives(write: Callable[[Any], Path]) -> None:
    """2.767 is the slope of its published file of 2023, for a black level of 4096."""
    content = tuning("first", 1.0)
    content["rpi.noise"] = {"reference_constant": 0, "reference_slope": 2.767}
    first, last = Camera.from_tuning(write(content)).levels
    assert (first.iso, last.iso) == (100, 800)
    assert first.shot_var == pytest.approx(2.767**2 / (65535 - 4096)) and first.read_var == 0
    assert last.shot_var == pytest.approx(8 * first.shot_var)


def without(name: str) -> Callable[[dict[str, Any]], Any]:
    return lambda content: {key: part for key, part in content.items() if key != name}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without("rpi.ccm"), "monochrome"),
        (without("rpi.black_level"), "black_level"),
        (without("rpi.awb"), "rpi.awb"),
        (lambda content: {**content, "version": 3.0}, "version"),
        (lambda content: [content], "must hold"),
        (lambda content: {**content, "rpi.awb": {"ct_curve": [1, 2]}}, "no tuning file"),
        (lambda content: {**content, "rpi.noise": {"reference_slope": None}}, "no tuning file"),
        (lambda content: {**content, "rpi.alsc": {"luminance_lut": [1.0] * 200}}, "200 gains"),
        (lambda content: {**content, "rpi.ccm": {"ccms": [{"ct": 4000, "ccm": [0.0] * 9}]}}, "matrix"),
    ],
)
def test_what_is_not_stated_is_refused(write: Callable[[Any], Path], change: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Camera.from_tuning(write(change(tuning("first", 1.0))))


def test_a_file_that_is_no_json_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "imx000.json"
    path.write_text("{")
    with pytest.raises(ValueError, match="JSON"):
        Camera.from_tuning(path)
    with pytest.raises(FileNotFoundError, match="tuning file"):
        Camera.from_tuning(tmp_path / "none.json")


SHEET: dict[str, Any] = {
    "matrix": [[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]],
    "matrix_is": "camera_to_srgb",
    "white_balance": (2.1, 1.0, 1.7),
    "bits": 10,
}


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"matrix_is": "srgb_to_camera"}, "is it camera_to_srgb"),
        ({"white_balance": (0.48, 1.0, 0.59)}, "AsShotNeutral"),
        ({"noise": {100: (1e-3, 1e-6), 800: (1.25e-4, 1e-6)}}, "falls with ISO"),
        ({"noise": {100: (0.01, 1e-3), 1600: (0.04, 2e-3)}}, "root of ISO"),
        ({"noise": {100: (1e-4, 1e-3)}}, "deviation"),
        ({"cfa": "rggb"}, "did you mean 'RGGB'"),
        ({"black_level": [64, 64, 64, 65]}, "black_level"),
        ({"shading": [[1.0, 2.0], [2.0, 1.5]]}, "are these gains"),
        ({"shading": [0.5, 1.0]}, "shading"),
    ],
)
def test_plausible_nonsense_has_its_line(figures: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Camera("M1", **{**SHEET, **figures})


def test_four_equal_black_levels_are_one() -> None:
    figures: dict[str, Any] = {**SHEET, "black_level": [64, 64, 64, 64]}
    assert Camera("M1", **figures).black_level == 64


@pytest.mark.parametrize("black_level", [0, 64])
def test_whole_numbers_end_at_0(black_level: int) -> None:
    camera = Camera("M1", **SHEET, black_level=black_level, noise={"K": 1.0, "sigma": 28.0})
    augment = rawaug.RawAugment.from_pretrained("universal", camera=camera, draw=rawaug.Draw(exposure=0.0))
    codes = augment(torch.zeros(1, 3, 64, 64)).noisy * camera.full_scale + black_level
    assert codes.min() == pytest.approx(0.0, abs=1e-3)
    if black_level:
        assert (codes < black_level).float().mean() > 0.4, "noise below black is kept"
