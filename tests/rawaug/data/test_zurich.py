from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.bayer import CFA, pack
from rawaug.data import Zurich, open_pairs
from rawaug.io import write_picture

CELL = np.array([[163, 263], [363, 463]], np.uint16)


def write_pair(folder: Path, number: int, numbers: np.ndarray) -> None:
    for name in ("huawei_raw", "canon"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    Image.fromarray(numbers).save(folder / "huawei_raw" / f"{number}.png")
    height, width = numbers.shape
    write_picture(folder / "canon" / f"{number}.jpg", torch.full((3, height, width), 90, dtype=torch.uint8))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for split in ("train", "test"):
        for number in (0, 2, 10):
            mosaic = np.tile(CELL, (4, 6)) + np.uint16(number)
            mosaic[0, 0] = 20  # below black
            mosaic[7, 11] = 1023
            write_pair(tmp_path / split, number, mosaic)
    return tmp_path


def test_pattern_levels_and_order_are_the_published_ones(folder: Path) -> None:
    pairs = open_pairs(f"zurich:{folder}", "test")
    assert [pair.name for pair in pairs] == ["test_0", "test_2", "test_10"]
    pair = pairs[2]
    assert pair.cfa == CFA.RGGB and not pair.registered and pair.raw.shape == (1, 8, 12)
    planes = pack(pair.raw, pair.cfa)[:, 1, 1] * (1020 - 63)
    assert planes.tolist() == pytest.approx([110, 210, 310, 410], abs=1e-3)
    assert pair.raw[0, 0, 0].item() == pytest.approx(-43 / 957), "not clipped at black"
    assert pair.raw[0, 7, 11].item() == 1 and pair.srgb[0, 3, 3].item() == pytest.approx(90, abs=2)


def test_8_bits_are_a_quarter(tmp_path: Path) -> None:
    write_pair(tmp_path / "train", 0, (np.tile(CELL, (4, 6)) // 4).astype(np.uint8))
    planes = pack(Zurich(tmp_path)[0].raw, "RGGB")[:, 0, 0] * 957
    assert planes.tolist() == pytest.approx([100, 200, 300, 400], abs=4)


def test_larger_pictures_and_mosaics_are_refused(folder: Path) -> None:
    assert open_pairs(f"zurich:{folder}", "test", max_pixels=96)[0].raw.shape == (1, 8, 12)
    with pytest.raises(ValueError, match=r"huawei_raw/0\.png: declares 8 x 12 pixels, above the limit of 95"):
        open_pairs(f"zurich:{folder}", "test", max_pixels=95)[0]
    write_picture(folder / "test" / "canon" / "0.jpg", torch.zeros(3, 16, 24, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"canon/0\.jpg: declares 16 x 24 pixels, above the limit of 96"):
        open_pairs(f"zurich:{folder}", "test", max_pixels=96)[0]


def test_what_is_wrong_is_reported(folder: Path) -> None:
    (folder / "train" / "canon" / "2.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"2\.jpg: is missing, and 0 others"):
        Zurich(folder)
    Image.fromarray(np.full((4, 4), 5000, np.uint16)).save(folder / "test" / "huawei_raw" / "0.png")
    with pytest.raises(ValueError, match=r"0\.png: has value 5000, more than 10 bits"):
        Zurich(folder, "test")[0]
    with pytest.raises(ValueError, match="zurich: no split validation; use train or test"):
        open_pairs(f"zurich:{folder}", "validation")
    with pytest.raises(FileNotFoundError, match="no such folder of Zurich"):
        Zurich(folder / "train")
