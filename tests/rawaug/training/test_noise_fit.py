"""A camera's noise from its own files, with and without dark frames."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from denoisers import build, save
from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.levels import find_levels, load_noise
from rawaug.io import RawFrame
from rawaug.noise import IsoLevel, MeasuredLevels, NoiseEstimate, camera_law, estimate_noise, noise_model
from rawaug.training.camera_fit import fit
from rawaug.training.noise_fit import measure_camera_noise
from rawaug.training.noisy_frames import noisy_frame

SHOT_VAR, READ_VAR = 1e-3, 4e-5
TINY: dict[str, Any] = {"steps": 1, "curve_steps": 1, "pixels": 256}


@pytest.fixture(scope="module")
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
    return Pair("chart", RawFrame(raw, CFA.GRBG), srgb, RawFrame(noisy, CFA.GRBG))


def test_the_capture_is_measured_and_stored(noisy_pair: Pair, tmp_path: Path) -> None:
    isp = fit([noisy_pair], progress=False, noise_figure=tmp_path / "noise.png", curve_steps=2, steps=2, pixels=512)
    (level,) = camera_law(isp.info["noise"]).levels
    assert level.iso is None and level.shot_var == pytest.approx(SHOT_VAR, rel=0.1)
    assert level.r2 is not None and level.r2 > 0.9
    assert (tmp_path / "noise.png").stat().st_size > 10_000


def test_dark_frames_set_the_read_variance(noisy_pair: Pair, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    rng = np.random.default_rng(0)
    dark = rng.normal(512, READ_VAR**0.5 * (16383 - 512), (128, 128)).round().astype(np.uint16)
    bayer_dng(tmp_path / "dark.dng", dark, cfa="GRBG", black=(512,), white=16383)
    shot_var, read_var = measure_camera_noise([noisy_pair], dark=tmp_path)[0].at(None)
    assert read_var == pytest.approx(READ_VAR, rel=0.03)
    assert shot_var == pytest.approx(SHOT_VAR, rel=0.1)


def with_variance(pair: Pair, shot_var: float, read_var: float, seed: int = 1) -> Pair:
    """The pair with noise of the variance ``shot_var y + read_var``, which no sensor need have."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(pair.clean.mosaic.shape, generator=generator) * (shot_var * pair.clean.mosaic + read_var).sqrt()
    return replace(pair, noisy=replace(pair.clean, mosaic=pair.clean.mosaic + noise))


def test_what_is_refused_is_reported_or_raised_as_is_asked(noisy_pair: Pair) -> None:
    """Where the noise stays the slope may be above 0 by chance, but the line explains nothing."""
    with pytest.raises(ValueError, match=r"R\^2 -?0\.[0-4]"):
        measure_camera_noise([with_variance(noisy_pair, 0.0, 2e-4, seed) for seed in (2, 3)])
    pair = with_variance(noisy_pair, -4e-4, 4e-4)  # falls with the signal
    isp = fit([pair], progress=False, **TINY)
    assert "do not fit one noise law" in isp.info["noise_not_measured"] and "noise" not in isp.info
    with pytest.raises(ValueError, match="camera"):
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
    found = estimate_noise(noisy_pair.noisy.mosaic, noisy_pair.cfa)
    monkeypatch.setattr("rawaug.training.noise_fit.estimate_noise", estimate)
    if accepted:
        assert measure_camera_noise([noisy_pair])[0].at(None)[0] == shot_var
    else:
        with pytest.raises(ValueError, match=f"R\\^2 {r2:.2f}"):
            measure_camera_noise([noisy_pair])


def at_iso(pair: Pair, iso: float | None, shot_var: float, camera: str = "Maker Model") -> Pair:
    pair = replace(pair, clean=replace(pair.clean, iso=iso, camera=camera))
    return with_variance(pair, shot_var, shot_var / 25)


def test_a_law_over_iso_is_measured_stored_and_drawn_from(noisy_pair: Pair, tmp_path: Path) -> None:
    pairs = [at_iso(noisy_pair, 400, 8e-4), at_iso(noisy_pair, 100, 2e-4)]
    isp = fit(pairs, progress=False, noise="on", noise_figure=tmp_path / "noise.png", **TINY)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["noise-iso100.png", "noise-iso400.png"]
    assert isp.info["rendering"] == "sRGB of the pairs (2 of 2)"
    shot_var = noise_model("camera", info=isp.info).sample(200, torch.Generator().manual_seed(0))["shot_var"]
    assert 1.7e-4 < float(shot_var.min()) < 2.4e-4 and 6.5e-4 < float(shot_var.max()) < 9e-4
    law = camera_law(json.loads(json.dumps(isp.info))["noise"])
    assert law.camera == "Maker Model" and law.limits == (100, 400)
    assert law.at(200)[0] == pytest.approx((law.at(100)[0] * law.at(400)[0]) ** 0.5, rel=1e-4)
    with pytest.raises(ValueError, match="measured"):
        law.at(800)
    with pytest.raises(ValueError, match="depends"):
        law.at(None)
    for other, said in (
        (
            at_iso(noisy_pair, 100, 2e-4, "Other 2"),
            r"2 cameras, Maker Model \(2\), Other 2 \(1\); measure each",
        ),
        (at_iso(noisy_pair, None, 2e-4), "1 of 3 frames have no ISO"),
    ):
        with pytest.raises(ValueError, match=said):
            measure_camera_noise([*pairs, other])
    frame = noisy_frame(replace(pairs[1], noisy=None), isp.info["noise"])
    assert (frame.shot_var, frame.read_var) == law.at(100)


def test_files_without_an_iso_have_one_level_for_every_iso() -> None:
    law = camera_law({"name": "MeasuredNoise", "settings": {"levels": [{"shot_var": 1e-3, "read_var": 1e-5}]}})
    assert law.at(None) == law.at(1600) == (1e-3, 1e-5)
    with pytest.raises(ValueError, match="camera"):
        camera_law({"name": "upi"})
    with pytest.raises(ValueError, match="levels"):
        MeasuredLevels([IsoLevel(100, 1e-3, 0.0), IsoLevel(100, 1e-3, 0.0)])


def test_denoise_takes_the_law_at_the_files_iso(noisy_pair: Pair, tmp_path: Path) -> None:
    law = MeasuredLevels([IsoLevel(100, 2e-4, 1e-6), IsoLevel(400, 8e-4, 1e-5)], "Maker Model")
    weights = tmp_path / "small.safetensors"
    save(build("PMRID", width=4, variance_map=True), weights, {"cfa": "RGGB", "noise": law.spec()})
    stored = load_noise("camera", RawDenoiser.of(weights))
    frame = RawFrame(
        noisy_pair.clean.mosaic, CFA.GRBG, (0.0, 0.0, 0.0, 0.0), 4095.0, (1.0, 1.0, 1.0), (1.0, 1.0, 1.0), torch.eye(3),
        camera="Maker Model", iso=400, noise_profile=None, orientation=0, name="a",
    )  # fmt: skip
    assert find_levels(frame, stored) == (8e-4, 1e-5, "camera")
    assert find_levels(frame, load_noise(law.spec(), RawDenoiser.of(weights))) == (8e-4, 1e-5, "camera")
    with pytest.raises(ValueError, match="levels by ISO"):
        load_noise({"name": "upi"}, RawDenoiser.of(weights))
    with pytest.raises(ValueError, match="noise"):
        find_levels(replace(frame, camera="Other"), stored)
    with pytest.raises(ValueError, match="noise="):
        find_levels(replace(frame, iso=800), stored)
    with pytest.raises(ValueError, match=r"rawaug-small: .*camera"):
        load_noise("camera", RawDenoiser.of("rawaug-small"))


def test_a_published_camera_at_one_iso_is_spelled_as_everywhere() -> None:
    levels = load_noise({"name": "Nikon D750", "iso": 400}, RawDenoiser.of("rawaug-small"))
    frame = RawFrame(torch.zeros(1, 1, 8, 8), CFA.RGGB, name="frame.dng", camera="Nikon D750", iso=400)
    assert levels == find_levels(frame, "Nikon D750")[:2]
    with pytest.raises(ValueError, match="with one iso"):
        load_noise({"name": "Nikon D750"}, RawDenoiser.of("rawaug-small"))
