"""A camera's noise from its own files, with and without dark frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.commands.camera_noise import measure_camera_noise
from rawaug.commands.fit import fit
from rawaug.data.pair import Pair
from rawaug.noise import NoiseEstimate, estimate_noise, noise_model

SHOT_VAR, READ_VAR = 1e-3, 4e-5
TINY: dict[str, Any] = {"steps": 1, "curve_steps": 1, "pixels": 256}


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
    isp = fit([noisy_pair], progress=False, noise_figure=tmp_path / "noise.png", curve_steps=2, steps=2, pixels=512)
    assert isp.info["noise"]["shot_var"] == pytest.approx(SHOT_VAR, rel=0.1)
    assert isp.info["noise"]["r2"] > 0.9
    assert (tmp_path / "noise.png").stat().st_size > 10_000


def test_dark_frames_set_the_read_variance(noisy_pair: Pair, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    rng = np.random.default_rng(0)
    dark = rng.normal(512, READ_VAR**0.5 * (16383 - 512), (128, 128)).round().astype(np.uint16)
    bayer_dng(tmp_path / "dark.dng", dark, cfa="GRBG", black=(512,), white=16383)
    estimate = measure_camera_noise([noisy_pair], dark=tmp_path)
    assert estimate.read_var == pytest.approx(READ_VAR, rel=0.03)
    assert estimate.shot_var == pytest.approx(SHOT_VAR, rel=0.1)


def with_variance(pair: Pair, shot_var: float, read_var: float, seed: int = 1) -> Pair:
    """The pair with noise of the variance ``shot_var y + read_var``, which no sensor need have."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(pair.raw.shape, generator=generator) * (shot_var * pair.raw + read_var).sqrt()
    return replace(pair, noisy=pair.raw + noise)


def test_noise_that_falls_with_the_signal_is_refused(noisy_pair: Pair) -> None:
    falling = with_variance(noisy_pair, -4e-4, 4e-4)
    with pytest.raises(ValueError, match=r"do not fit one noise law .*use one camera at one ISO"):
        measure_camera_noise([falling])


def test_noise_that_is_the_same_everywhere_is_refused(noisy_pair: Pair) -> None:
    """Its slope may be above 0 by chance, but the line explains nothing."""
    with pytest.raises(ValueError, match=r"R\^2 -?0\.[0-4]"):
        measure_camera_noise([with_variance(noisy_pair, 0.0, 2e-4, seed) for seed in (2, 3)])


def test_what_is_refused_is_reported_or_raised_as_is_asked(noisy_pair: Pair) -> None:
    pair = with_variance(noisy_pair, -4e-4, 4e-4)
    isp = fit([pair], progress=False, **TINY)
    assert "do not fit one noise law" in isp.info["noise_not_measured"] and "noise" not in isp.info
    with pytest.raises(ValueError, match="one noise law"):
        fit([pair], progress=False, noise="on", **TINY)
    assert not {"noise", "noise_not_measured"} & set(fit([pair], progress=False, noise="off", **TINY).info)


@pytest.mark.parametrize(
    ("shot_var", "r2", "accepted"),
    [(1e-3, 0.5, True), (1e-3, 0.499, False), (1e-9, 0.9, True), (0.0, 0.9, False), (-1e-9, 0.9, False)],
)
def test_the_limits_are_a_slope_above_0_and_half_the_variance_explained(
    shot_var: float, r2: float, accepted: bool, noisy_pair: Pair, monkeypatch: pytest.MonkeyPatch
) -> None:
    def estimate(*arguments: object, **settings: object) -> NoiseEstimate:
        return replace(found, shot_var=shot_var, r2=r2)

    assert noisy_pair.noisy is not None
    found = estimate_noise(noisy_pair.noisy, noisy_pair.cfa)
    monkeypatch.setattr("rawaug.commands.camera_noise.estimate_noise", estimate)
    if accepted:
        assert measure_camera_noise([noisy_pair]).shot_var == shot_var
    else:
        with pytest.raises(ValueError, match=f"R\\^2 {r2:.2f}"):
            measure_camera_noise([noisy_pair])
