from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.data import check, fivek_pairs, open_pairs
from rawaug.data.published import CAMERAS, fivek_numbers
from rawaug.io import develop
from rawaug.io.pictures import through_jpeg

SPLITS = {("canon", "train"): 650, ("canon", "test"): 127, ("nikon", "train"): 414, ("nikon", "test"): 73}


def test_the_splits_are_as_large_as_published_and_share_nothing() -> None:
    numbers = {key: fivek_numbers(*key) for key in SPLITS}
    assert {key: len(value) for key, value in numbers.items()} == SPLITS
    together = [number for value in numbers.values() for number in value]
    assert len(set(together)) == len(together) and all(1 <= int(number) <= 5000 for number in together)
    assert {"3552", "4318"} <= set(numbers["canon", "test"]) and {"4331", "4613"} <= set(numbers["nikon", "test"])
    assert {"3674", "3745"} <= set(numbers["canon", "train"]) and {"2754", "4914"} <= set(numbers["nikon", "train"])


@pytest.fixture
def folder(tmp_path: Path, bayer_dng: Callable[..., Path]) -> Path:
    """The Nikon's test frames, and one of the Canon's; red of a frame is as bright as its place in the split."""
    for place, number in enumerate(fivek_numbers("nikon", "test")):
        cell = np.array([[500 + 10 * place, 1000], [1000, 2000]], np.uint16)
        path = tmp_path / "raw_photos" / f"HQa{place % 3}" / "photos" / f"a{number}-_DGW{place:04d}.dng"
        path.parent.mkdir(parents=True, exist_ok=True)
        bayer_dng(path, np.tile(cell, (16, 24)))
    bayer_dng(tmp_path / f"a{fivek_numbers('canon', 'test')[0]}-MB.dng", np.tile(cell, (16, 24)))
    return tmp_path


def test_a_split_is_found_by_number_and_developed(folder: Path) -> None:
    pairs = open_pairs(f"fivek_nikon:{folder}", split="test")
    assert len(pairs) == 73
    for place in (0, 40, 72):
        pair = pairs[place]
        assert pair.name.startswith(f"a{fivek_numbers('nikon', 'test')[place]}-") and pair.registered
        assert pair.raw[0, 0, 0].item() == pytest.approx((500 + 10 * place) / 4095)
        assert str(pair.cfa) == "RGGB" and pair.white_balance == pytest.approx((2, 1, 1.6), rel=1e-4)
        assert pair.srgb.shape == (3, 32, 48)


def test_invisps_pictures_are_scaled_by_the_frames_maximum_and_stored_as_jpegs(
    folder: Path, bayer_dng: Callable[..., Path]
) -> None:
    number = fivek_numbers("nikon", "test")[72]
    (file,) = folder.rglob(f"a{number}-*.dng")
    cell = np.tile(np.array([[1700, 3400], [3400, 2600]], np.uint16), (16, 24))  # brightest at 0.83 of white
    cell[:, 24:] //= 3
    bayer_dng(file, cell)
    pair, plain = (open_pairs(f"{kind}_nikon:{folder}", split="test")[72] for kind in ("invisp", "fivek"))
    assert torch.equal(pair.raw, plain.raw) and pair.name == plain.name == file.stem
    assert torch.equal(plain.srgb, develop(file))
    assert torch.equal(pair.srgb, through_jpeg(develop(file, 0.75), 90))
    assert pair.srgb.float().mean() > plain.srgb.float().mean() + 2, "the brightest becomes white"


def test_missing_frames_are_reported(folder: Path) -> None:
    with pytest.raises(
        FileNotFoundError, match=r"126 of the 200 DNGs of fivek canon\+nikon, test, are missing, first a\d{4}-"
    ):
        fivek_pairs(folder, "test")
    with pytest.raises(FileNotFoundError, match="414 of the 414 DNGs of fivek nikon, train"):
        open_pairs(f"fivek_nikon:{folder}:train")
    with pytest.raises(ValueError, match="fivek: no split validation; use one of InvISP's: train, test"):
        open_pairs(f"fivek:{folder}", split="validation")
    with pytest.raises(ValueError, match="fivek: no camera sony; use one of canon, nikon"):
        fivek_pairs(folder, "test", ["sony"])
    with pytest.raises(FileNotFoundError, match="no such folder of FiveK"):
        fivek_pairs(folder / "none", "test", CAMERAS)


def test_check_counts_the_files_of_each_split(folder: Path) -> None:
    report = str(check(folder))
    assert "RAW files (FiveK: canon test 1 of 127, nikon test 73 of 73): 74" in report
    assert "sizes: 32 x 48 (74)" in report and "cfas: RGGB (74)" in report and "black 0, white 4095 (74)" in report
