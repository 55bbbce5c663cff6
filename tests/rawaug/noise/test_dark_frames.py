"""A camera's dark frames as noise: they are found as they were taken, and photons come on top."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.io import RawFrame, read_raw, write_dng
from rawaug.noise import noise_model
from rawaug.noise.dark_frames import DarkFrames

HOT = (7, 10)
"""The row and column of the one hot pixel, a blue one of GRBG."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two dark frames of 14 bits, GRBG, ``row_var`` 4e-6 and ``read_var`` 1e-6, one hot pixel, a tag that says 2e-3."""
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        mosaic = 1e-3 * torch.randn(1, 96, 128, generator=generator)
        mosaic += 2e-3 * torch.randn(1, 96, 1, generator=generator)
        mosaic[(0, *HOT)] = 0.5
        gains, name = (2.0, 1.0, 1.5), f"dark{seed}"
        levels = ((512.0,) * 4, 16383.0, gains, gains, torch.eye(3), "unknown", 1600.0, (2e-3, 1e-6), 0, name)
        write_dng(tmp_path / f"{name}.dng", RawFrame(mosaic, CFA("GRBG"), *levels))
    return tmp_path


def test_without_light_the_noise_is_a_frame_s_own(folder: Path) -> None:
    model = noise_model({"name": "DarkFrames", "path": str(folder)})
    noisy = model.apply(torch.zeros(4, 4, 48, 64), model.sample(4, torch.Generator().manual_seed(0)))
    frames = [bayer.pack(read_raw(file).mosaic[None], "GRBG")[0] for file in sorted(folder.glob("*.dng"))]
    for picture in noisy:
        assert any(torch.equal(picture.flatten().sort().values, frame.flatten().sort().values) for frame in frames)
        assert [int((plane > 0.4).sum()) for plane in picture] == [0, 0, 0, 1]
        rows = picture.mean(-1)  # banding is where it was: R and Gr share a row, and R and B do not
        assert torch.corrcoef(rows[[0, 1, 3]])[0].tolist() == pytest.approx([1.0, 1.0, 0.0], abs=0.35)
    assert len({tuple(picture[0, 0].tolist()) for picture in noisy}) == 4  # each from its own place


def test_photons_come_on_top_and_the_map_says_so(folder: Path) -> None:
    model = DarkFrames(str(folder), shot_var=4e-3)
    params, clean = model.sample(8, torch.Generator().manual_seed(0)), torch.full((8, 4, 48, 64), 0.25)
    noisy, variance = model.apply_with_variance(clean, params)
    noise = noisy - noisy.mean(-1, keepdim=True)  # without banding
    assert noise[noise.abs() < 0.2].var().item() == pytest.approx(4e-3 * 0.25 + 1e-6, rel=0.05)
    assert variance.mean().item() == pytest.approx(4e-3 * 0.25 + 1e-6, rel=0.05)


def test_the_photons_share_is_the_tag_s_or_must_be_given(folder: Path) -> None:
    assert DarkFrames(str(folder)).sample(2, torch.Generator())["shot_var"].tolist() == pytest.approx([2e-3] * 2)
    untagged = replace(read_raw(folder / "dark0.dng"), noise_profile=None)
    write_dng(folder / "other.dng", untagged)
    with pytest.raises(ValueError, match="shot_var"):
        DarkFrames(str(folder))
    assert not DarkFrames(str(folder), shot_var=0.0).sample(8, torch.Generator())["shot_var"].any()
    with pytest.raises(ValueError, match="shot_var"):
        DarkFrames(str(folder), shot_var=-1e-3)
