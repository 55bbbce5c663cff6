"""Photon transfer on frames that are drawn with known gain, read noise, row noise and pattern of the pixels."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import rawaug
from rawaug.camera.transfer import measure_photon_transfer
from rawaug.cli import main
from rawaug.io import RawFrame, write_dng

BLACK, WHITE = 256.0, 4095.0
LEVELS = (200.0, 800.0, 1600.0, 2400.0)
"""Mean signals of the flats in DN."""


class Sensor:
    """A sensor that counts photons: gain in DN per electron, noise in DN, and the relative deviation of its pixels."""

    def __init__(self, gain: float, sigma: float, row: float, pattern: float, side: int = 512, seed: int = 0) -> None:
        self.gain, self.sigma, self.row, self.side = gain, sigma, row, side
        self.random = np.random.default_rng(seed)
        self.pixels = 1 + pattern * self.random.standard_normal((side, side))
        y, x = np.linspace(-1, 1, side)[:, None], np.linspace(-1, 1, side)
        self.light = 1 - 0.4 * (x**2 + y**2)
        self.light[1::2, 1::2] *= 0.6  # blue

    def frame(self, level: float = 0.0, iso: float | None = 100) -> RawFrame:
        electrons = self.random.poisson(level / self.gain * self.light * self.pixels)
        noise = self.sigma * self.random.standard_normal(electrons.shape)
        rows = self.row * self.random.standard_normal((self.side, 1))
        values = np.rint(self.gain * electrons + noise + rows + BLACK).clip(0, WHITE)
        mosaic = torch.from_numpy((values - BLACK) / (WHITE - BLACK)).float()[None]
        return RawFrame(mosaic, "RGGB", (BLACK,) * 4, WHITE, camera="Maker M1", iso=iso, name="frame")

    def darks(self, count: int = 4, iso: float | None = 100) -> list[RawFrame]:
        return [self.frame(iso=iso) for _ in range(count)]

    def flats(self, levels: Sequence[float] = LEVELS, iso: float | None = 100) -> list[RawFrame]:
        """Two of each level, in light that flickers by 1.5 %."""
        return [self.frame(flicker * level, iso) for level in levels for flicker in (1.0, 0.985)]


@pytest.mark.parametrize("pattern", [0.0, 0.01])
def test_k_is_within_half_a_percent_whatever_the_pattern(pattern: float) -> None:
    sensor = Sensor(gain=0.12, sigma=3.0, row=1.2, pattern=pattern)
    levels, lines = measure_photon_transfer(sensor.darks(), sensor.flats())
    assert levels[100]["K"] == pytest.approx(0.12, rel=0.005)
    assert levels[100]["sigma"] == pytest.approx((3.0**2 + 1 / 12) ** 0.5, rel=0.005)
    assert levels[100]["row"] == pytest.approx(1.2, rel=0.1)
    assert len(lines) == 1 and "4 pairs" in lines[0]


def test_the_interval_of_k_holds_it_as_often_as_it_says() -> None:
    inside = 0
    for seed in range(40):
        sensor = Sensor(gain=0.48, sigma=3.0, row=1.2, pattern=0.01, side=64, seed=seed)
        _, (line,) = measure_photon_transfer(sensor.darks(2), sensor.flats(LEVELS[1:3]))
        low, high = line.split("(")[1].split(")")[0].split(" to ")
        inside += float(low) <= 0.48 <= float(high)
    assert inside >= 34


def test_what_is_left_out_is_counted_by_its_reason() -> None:
    sensor = Sensor(gain=0.48, sigma=3.0, row=0.0, pattern=0.0, side=64)
    flats = [*sensor.flats(LEVELS[:1]), sensor.frame(1000.0), sensor.frame(9000.0), *sensor.flats(LEVELS[:1], iso=800)]
    levels, lines = measure_photon_transfer([*sensor.darks(2), *sensor.darks(1, iso=200)], flats)
    assert list(levels) == [100]
    text = " | ".join(lines)
    for reason in ("1 flat clipped", "1 flat without", "ISO 200: 1 dark;", "ISO 800: 0 darks;"):
        assert reason in text

    with pytest.raises(ValueError, match="nothing can be measured"):
        measure_photon_transfer([], flats)
    with pytest.raises(ValueError, match="no pair of flats"):
        measure_photon_transfer(sensor.darks(2), [sensor.frame(500.0)])
    with pytest.raises(ValueError, match="mosaic"):
        measure_photon_transfer(sensor.darks(2), Sensor(0.48, 3.0, 0.0, 0.0, side=32).flats())


def test_frames_of_which_only_some_state_an_iso_are_refused() -> None:
    sensor = Sensor(gain=0.48, sigma=3.0, row=0.0, pattern=0.0, side=64)
    darks = [*sensor.darks(2), *sensor.darks(2, iso=None)]
    flats = [*sensor.flats(LEVELS[:1]), *sensor.flats(LEVELS[:1], iso=None)]
    with pytest.raises(ValueError, match="ISO"):
        measure_photon_transfer(darks, flats)


def test_a_sheet_is_measured_from_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sensors: dict[float, Any] = {100: Sensor(0.3, 2.0, 0.5, 0.01, side=128), 400: Sensor(1.2, 4.0, 2.0, 0.01, side=128)}
    for kind in ("dark", "flat"):
        (tmp_path / kind).mkdir()
        for iso, sensor in sensors.items():
            frames = sensor.darks(iso=iso) if kind == "dark" else sensor.flats(iso=iso)
            for number, frame in enumerate(frames):
                write_dng(tmp_path / kind / f"{iso}-{number}.dng", frame)
    (tmp_path / "flat" / "broken.dng").write_bytes(b"II*\0broken")

    folders = ["--dark", str(tmp_path / "dark"), "--flat", str(tmp_path / "flat")]
    assert main(["camera", "measure", *folders, "--out", str(tmp_path / "m1.yaml"), "--camera", "Nikon D750"]) == 0
    printed = capsys.readouterr().out
    assert "1 file left out" in printed and "4 pairs of flats" in printed

    camera = rawaug.Camera.load(tmp_path / "m1.yaml")
    assert (camera.black_level, camera.white, camera.bits) == (BLACK, WHITE, 12)
    for level, sensor in zip(camera.levels, sensors.values(), strict=True):
        assert level.shot_var == pytest.approx(sensor.gain / (WHITE - BLACK), rel=0.03)
        assert level.row_var == pytest.approx((sensor.row / (WHITE - BLACK)) ** 2, rel=0.5)
    pair = rawaug.RawPairs([torch.rand(3, 32, 32)], camera, crop=32)[0]
    assert pair.params.camera()["ISO"] >= 100
