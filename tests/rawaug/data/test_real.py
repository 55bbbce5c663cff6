"""The frames that travel with the package: where they come from, and that the splits share nothing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rawaug.data import open_pairs
from rawaug.data.published import REAL_FRAMES
from rawaug.io import read_raw


def test_every_split_is_read_and_states_what_is_known() -> None:
    splits = {split: open_pairs(f"real:{split}") for split in ("train", "validation", "test")}
    assert [len(pairs) for pairs in splits.values()] == [3, 2, 4]
    assert len({name for pairs in splits.values() for name in pairs.names}) == 9
    cameras = {split: {pair.clean.camera for pair in pairs} for split, pairs in splits.items()}
    assert not cameras["validation"] & (cameras["train"] | cameras["test"])
    for pair in (pair for pairs in splits.values() for pair in pairs):
        assert pair.clean.color_known and pair.balance_known and pair.clean.iso and pair.noisy is None
        assert (
            -0.01 < pair.clean.mosaic.min() < 0.02 and pair.clean.mosaic.max() <= 1.0 and pair.srgb.float().std() > 10
        )
        assert pair.clean.noise_profile is not None
        shot_var, read_var = pair.clean.noise_profile
        assert 1e-7 < shot_var * pair.clean.mosaic.mean() + read_var < 3e-6
    with pytest.raises(ValueError, match=r"real: .*validation"):
        open_pairs("real:all")


def test_they_stay_small_and_have_their_licence() -> None:
    folder = REAL_FRAMES
    assert sum(file.stat().st_size for file in folder.iterdir()) < 5e6
    assert "CC0 1.0" in (folder / "LICENCE.md").read_text()


def test_the_maker_makes_them_of_the_camera_files(camera_files: Path, tmp_path: Path) -> None:
    from benchmarks.real_frames import SPLITS, described, numbers_of

    for split, name in (("test", "raw/canon/s40_0117.crw"), ("train", "raw/canon/s40_0112.crw")):
        file = camera_files / name
        assert name in SPLITS[split]
        frame = read_raw(file)
        assert np.array_equal(np.array(Image.open(REAL_FRAMES / f"{file.stem}.png")), numbers_of(frame))
        said = json.loads(json.dumps(described(file, frame, split)))
        kept = json.loads((REAL_FRAMES / "frames.json").read_text())[file.stem]
        assert said.pop("own_noise") == pytest.approx(kept.pop("own_noise"), rel=1e-3) and said == kept
