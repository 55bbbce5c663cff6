"""RawTherapee develops a result like its source. Skipped where it is not installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tifffile

import rawaug
from rawaug.io import read_raw, write_dng

pytestmark = pytest.mark.skipif(shutil.which("rawtherapee-cli") is None, reason="RawTherapee is not installed")

SENSOR_COLOURS = "[Color Management]\nInputProfile=(none)\n"


def mean_colour(path: Path, profile: Path | None = None) -> np.ndarray:
    """The mean of red, green and blue as RawTherapee develops a file, by its default profile or by another."""
    out = path.with_suffix(".tif")
    options = ["-d"] if profile is None else ["-p", str(profile)]
    command = ["rawtherapee-cli", "-q", "-o", str(out), "-b16", "-t", "-Y", *options, "-c", str(path)]
    subprocess.run(command, check=True)
    picture = tifffile.imread(out)
    return np.asarray(picture[..., :3].mean((0, 1), dtype=np.float64))


@pytest.fixture
def source(tmp_path: Path, camera_files: Path) -> Path:
    return Path(shutil.copy(camera_files / "raw/canon/s40_0101.crw", tmp_path))


def test_a_denoised_crw_has_the_means_of_its_source(source: Path, tmp_path: Path) -> None:
    # white balance, levels and noise at the ends of the scale; RawTherapee has another colour matrix for this CRW
    rawaug.denoise(source, tmp_path / "denoised.dng")
    neutral = tmp_path / "neutral.pp3"
    neutral.write_text(SENSOR_COLOURS)
    np.testing.assert_allclose(
        mean_colour(tmp_path / "denoised.dng", neutral), mean_colour(source, neutral), rtol=0.005
    )


def test_the_curve_is_matched_to_the_preview_of_the_source(source: Path, tmp_path: Path) -> None:
    # without the preview the means differ by a tenth; RawTherapee's other matrix for this CRW takes 0.8 %
    first, second = tmp_path / "first.dng", tmp_path / "second.dng"
    write_dng(first, read_raw(source), source)
    write_dng(second, read_raw(first), first)

    developed = mean_colour(first)
    np.testing.assert_allclose(developed, mean_colour(source), rtol=0.015)
    np.testing.assert_allclose(mean_colour(second), developed, rtol=1e-4)
