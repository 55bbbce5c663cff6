from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug.bayer import CFA, turn
from rawaug.data import RawFolder, open_pairs
from rawaug.io import develop, read_raw, write_picture

Dng = Callable[..., Path]
NUMBERS = np.random.default_rng(0).integers(0, 4096, (40, 62)).astype(np.uint16)


@pytest.fixture
def folder(tmp_path: Path, bayer_dng: Dng) -> Path:
    (tmp_path / "sub").mkdir()
    bayer_dng(tmp_path / "b.dng", NUMBERS, "GRBG")
    bayer_dng(tmp_path / "sub" / "c.DNG", NUMBERS[::-1].copy(), "BGGR")
    return tmp_path


def test_a_folder_a_file_and_a_list(folder: Path) -> None:
    pairs = RawFolder(folder)
    assert [pair.name for pair in pairs] == ["b", "c"]
    assert [pair.cfa for pair in pairs[:]] == [CFA.GRBG, CFA.BGGR]
    assert [pair.name for pair in RawFolder(folder / "b.dng")] == ["b"]
    assert [pair.name for pair in RawFolder([folder / "sub" / "c.DNG", str(folder / "b.dng")])] == ["c", "b"]
    assert pairs[-1].name == "c" and len(open_pairs(str(folder))) == 2
    with pytest.raises(IndexError):
        pairs[2]


def test_a_pair_is_the_mosaic_and_libraws_rendering(folder: Path) -> None:
    pair, frame = RawFolder(folder)[0], read_raw(folder / "b.dng")
    assert torch.equal(pair.raw, frame.mosaic) and torch.equal(pair.srgb, develop(folder / "b.dng"))
    assert (pair.camera, pair.white_balance, pair.registered) == (frame.camera, frame.white_balance, True)
    assert pair.noisy is None


def test_the_last_frame_stays(folder: Path) -> None:
    pairs = RawFolder(folder)
    assert pairs[0] is pairs[-2]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_camera_jpeg_is_turned_into_the_sensors_orientation(tmp_path: Path, bayer_dng: Dng, orientation: int) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS, orientation=orientation)
    sensor = torch.stack([ramp * 4 + 2 for ramp in torch.meshgrid(torch.arange(40), torch.arange(62), indexing="ij")])
    sensor = torch.cat([sensor, sensor[:1]]).to(torch.uint8)
    write_picture(tmp_path / "a.JPG", turn(sensor, read_raw(path).upright_view))
    pair = RawFolder(tmp_path)[0]
    assert not pair.registered
    assert (pair.srgb.int() - sensor.int()).abs().float().mean() < 8
    assert RawFolder(tmp_path, camera_jpeg=False)[0].registered


def test_a_jpeg_of_another_size_is_ignored_with_a_warning(tmp_path: Path, bayer_dng: Dng) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS)
    write_picture(tmp_path / "a.jpg", torch.zeros(3, 20, 31, dtype=torch.uint8))
    with pytest.warns(UserWarning, match=r"a.jpg: is 20 x 31 but its RAW file is 40 x 62; using LibRaw's"):
        pair = RawFolder(tmp_path)[0]
    assert pair.registered and torch.equal(pair.srgb, develop(path))


def test_a_jpeg_that_lacks_a_few_lines_is_taken_and_the_mosaic_is_cut(tmp_path: Path, bayer_dng: Dng) -> None:
    numbers = np.random.default_rng(1).integers(0, 4096, (160, 240)).astype(np.uint16)
    path = bayer_dng(tmp_path / "a.dng", numbers, "GRBG")
    write_picture(tmp_path / "a.png", develop(path)[:, 2:158, 2:238])
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    pair = RawFolder(tmp_path)[0]
    assert not pair.registered and pair.cfa == CFA.GRBG
    assert torch.equal(pair.raw, read_raw(path).mosaic[:, 2:158, 2:238])
    assert torch.equal(pair.srgb, develop(path)[:, 2:158, 2:238])


def test_files_of_one_stem_have_names_of_their_own(tmp_path: Path, bayer_dng: Dng) -> None:
    for folder in ("x", "y"):
        (tmp_path / folder).mkdir()
        bayer_dng(tmp_path / folder / "IMG.dng", NUMBERS)
    assert [pair.name for pair in RawFolder(tmp_path)] == ["x/IMG.dng", "y/IMG.dng"]


def test_nothing_to_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"contains no RAW file; supported extensions are \.3fr"):
        RawFolder(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"none\.dng: no such RAW file"):
        RawFolder(tmp_path / "none.dng")
    with pytest.raises(ValueError, match="flickr:x: unknown kind of data; use demo:"):
        open_pairs("flickr:x")


def test_a_gopro_and_its_jpeg_are_the_same_picture(camera_files: Path) -> None:
    folder = camera_files / "raw_jpeg" / "gopro"
    jpeg, rendering = RawFolder(folder)[0], RawFolder(folder, camera_jpeg=False)[0]
    assert not jpeg.registered and rendering.registered

    def thumbnail(picture: Tensor) -> Tensor:
        return F.avg_pool2d(picture.float().mean(0, keepdim=True), 32).flatten()

    correlations = [
        torch.corrcoef(torch.stack([thumbnail(rendering.srgb), thumbnail(turn(jpeg.srgb, view))]))[0, 1].item()
        for view in range(4)
    ]
    assert correlations[0] > 0.95 and max(correlations[1:]) < 0.8
