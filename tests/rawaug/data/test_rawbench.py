"""RawBench: shots at several ISO values beside those at ISO 100 of the same exposure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.data import open_pairs

GAIN = 8


def test_the_clean_frame_is_the_mean_at_iso_100_at_the_noisy_exposure(
    tmp_path: Path, bayer_dng: Callable[..., Path]
) -> None:
    rng = np.random.default_rng(0)
    light = np.tile(np.linspace(20, 480, 96), (64, 1))
    folder = tmp_path / "Scene_0001"
    (folder / "gt").mkdir(parents=True)
    for k in (1, 2):
        numbers = 64 + light + rng.normal(0, 2, light.shape)
        bayer_dng(folder / "gt" / f"Scene_0001_ISO100_{k}.ARW", numbers.round().astype(np.uint16), black=(64,))
    noisy = np.clip(64 + GAIN * light + rng.normal(0, 40, light.shape), 0, 4095).round().astype(np.uint16)
    bayer_dng(folder / "Scene_0001_ISO800_1.ARW", noisy, black=(64,))
    pairs = open_pairs(f"rawbench:{tmp_path}")
    (pair,) = pairs
    assert pair.name == "Scene_0001_ISO800_1" and pair.noisy is not None and pair.color_known
    truth = torch.from_numpy(GAIN * light / (4095 - 64)).float()
    assert (pair.raw[0] - truth).abs().mean() < 4e-3 < (pair.noisy[0] - truth).abs().mean()
    assert (pair.raw.mean() - truth.clamp(max=1).mean()).abs() < 1e-3


def test_what_is_missing_is_named(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    with pytest.raises(FileNotFoundError, match="no such folder of RawBench"):
        open_pairs(f"rawbench:{tmp_path / 'none'}")
    with pytest.raises(ValueError, match=r"contains no RAW file named as Scene_0001_ISO3200_1\.ARW"):
        open_pairs(f"rawbench:{tmp_path}")
    (tmp_path / "Scene_0002").mkdir()
    bayer_dng(tmp_path / "Scene_0002" / "Scene_0002_ISO200_1.ARW", np.full((32, 32), 99, np.uint16))
    with pytest.raises(FileNotFoundError, match="gt: has no RAW file at ISO 100; download it too"):
        open_pairs(f"rawbench:{tmp_path}")
