"""A camera's noise from its own files, with and without dark frames."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.experiment.camera_noise import measure_camera_noise
from rawaug.experiment.fitting import fit
from rawaug.noise import noise_model

SHOT_VAR, READ_VAR = 1e-3, 4e-5


@pytest.fixture
def noisy_pair() -> Pair:
    """Patches of many greys, as a colour chart has, at known levels."""
    generator = torch.Generator().manual_seed(0)
    patches = 0.02 + 0.8 * torch.rand(1, 3, 8, 8, generator=generator)
    scene = torch.nn.functional.interpolate(patches, (512, 512), mode="nearest")[0]
    raw = bayer.mosaic(scene, "GRBG")
    noise = noise_model((SHOT_VAR, READ_VAR))
    packed = bayer.pack(raw[None], "GRBG")
    noisy = bayer.unpack(noise.apply(packed, noise.sample(1, generator)), "GRBG")[0]
    srgb = (scene ** (1 / 2.2) * 255).round().to(torch.uint8)
    return Pair("chart", srgb, raw, CFA.GRBG, (1.0, 1.0, 1.0), torch.eye(3), noisy=noisy)


def test_the_capture_is_measured_and_stored(noisy_pair: Pair, tmp_path: Path) -> None:
    isp = fit([noisy_pair], progress=False, noise_figure=tmp_path / "noise.png", steps=2, pixels=512)
    assert isp.info["noise"]["shot_var"] == pytest.approx(SHOT_VAR, rel=0.1)
    assert isp.info["noise"]["r2"] > 0.9
    assert (tmp_path / "noise.png").stat().st_size > 10_000


def test_dark_frames_tell_the_read_variance(noisy_pair: Pair, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    rng = np.random.default_rng(0)
    dark = rng.normal(512, READ_VAR**0.5 * (16383 - 512), (128, 128)).round().astype(np.uint16)
    bayer_dng(tmp_path / "dark.dng", dark, cfa="GRBG", black=(512,), white=16383)
    estimate = measure_camera_noise([noisy_pair], dark=tmp_path)
    assert estimate.read_var == pytest.approx(READ_VAR, rel=0.03)
    assert estimate.shot_var == pytest.approx(SHOT_VAR, rel=0.1)
