"""Noisy/clean DNGs made of clean RAW files: the noise is the stated one, and is read as `rawaug evaluate` draws it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.noisy_pairs import main, write_pair
from rawaug.bayer import CFA
from rawaug.data import open_pairs
from rawaug.data.folders import RawFolder
from rawaug.evaluation.scores import frozen_levels, frozen_sample
from rawaug.io import RawFrame, write_dng
from rawaug.noise import Compose, RowNoise, noise_model


@pytest.fixture
def shots(tmp_path: Path) -> RawFolder:
    frame = RawFrame(
        mosaic=torch.linspace(0, 0.8, 64 * 96).reshape(1, 64, 96),
        cfa=CFA.GRBG,
        black=(512.0, 513.0, 511.0, 512.0),
        white=16383.0,
        white_balance=(2.0, 1.0, 1.5),
        daylight=(1.9, 1.0, 1.6),
        color_matrix=torch.eye(3),
        camera="Maker Model",
        iso=100.0,
        noise_profile=None,
        orientation=0,
        name="shot",
    )
    (tmp_path / "raw").mkdir()
    write_dng(tmp_path / "raw/shot.dng", frame)
    return RawFolder(tmp_path / "raw")


def test_a_pair_has_the_frozen_noise_and_states_its_levels(shots: RawFolder, tmp_path: Path) -> None:
    noise, out = noise_model("cycleisp_sidd"), tmp_path / "pairs"
    out.mkdir()
    levels = write_pair(shots, 0, noise, 0, out)
    (pair,) = open_pairs(f"pairs:{out}")
    sample = frozen_sample(shots[0], noise, CFA.GRBG, 0)
    assert levels == frozen_levels(shots[0], noise, 0) == pytest.approx((pair.shot_var, pair.read_var))
    again = frozen_sample(pair, noise, CFA.GRBG, 1)
    step = 1 / (65535 - 16384)
    torch.testing.assert_close(again.noisy, sample.noisy, rtol=0, atol=step)
    torch.testing.assert_close(again.clean, sample.clean, rtol=0, atol=step)


def test_files_of_the_same_stem_are_kept_apart(shots: RawFolder, tmp_path: Path) -> None:
    folder = shots.files[0].parent
    for name in ("a", "b"):
        (folder / name).mkdir()
        (folder / name / "shot.dng").write_bytes(shots.files[0].read_bytes())
    shots.files[0].unlink()
    main([str(folder), str(tmp_path / "pairs"), "--noise", "cycleisp_sidd"])
    assert [pair.name for pair in open_pairs(f"pairs:{tmp_path / 'pairs'}")] == ["a_shot.dng", "b_shot.dng"]


def test_noise_without_levels_is_refused(shots: RawFolder, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="shot: its pair needs noise with known shot_var"):
        write_pair(shots, 0, Compose([RowNoise(1e-6)]), 0, tmp_path)
    assert not list(tmp_path.glob("*.dng"))
