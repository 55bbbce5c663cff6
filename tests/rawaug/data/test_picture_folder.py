from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader

from rawaug.data import PictureFolder, open_pictures
from rawaug.io import write_picture


def grey(level: int, height: int = 6, width: int = 8) -> torch.Tensor:
    return torch.full((3, height, width), level, dtype=torch.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, level in (("b.png", 20), ("a/z.TIF", 10), ("c.bmp", 30)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_picture(tmp_path / name, grey(level))
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def test_pictures_come_sorted_by_path(folder: Path) -> None:
    pictures = PictureFolder(folder)
    assert len(pictures) == 3
    assert [picture[0, 0, 0].item() for picture in (pictures[0], pictures[1], pictures[2])] == [10, 20, 30]
    assert torch.equal(pictures[-1], grey(30)) and pictures.skipped == {}
    with pytest.raises(IndexError):
        pictures[3]


def test_an_unreadable_file_is_named_and_replaced_by_the_next(folder: Path) -> None:
    (folder / "b.png").write_bytes(b"broken")
    pictures = PictureFolder(folder)
    with pytest.warns(UserWarning, match=r"b\.png: cannot be read as a picture.*; skipped"):
        assert torch.equal(pictures[1], grey(30))
    assert torch.equal(pictures[1], grey(30)), "asked again, without a warning"
    assert list(pictures.skipped) == [folder / "b.png"] and "cannot be read" in pictures.skipped[folder / "b.png"]


def test_the_last_file_wraps_to_the_first(folder: Path) -> None:
    (folder / "c.bmp").write_bytes(b"broken")
    pictures = PictureFolder(folder)
    with pytest.warns(UserWarning, match="skipped"):
        assert torch.equal(pictures[2], grey(10))


def test_a_loader_with_workers_reads_it(folder: Path) -> None:
    loader = DataLoader(PictureFolder(folder), batch_size=3, num_workers=1)
    assert next(iter(loader)).shape == (3, 3, 6, 8)


def test_nothing_to_read_is_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none: no such folder of pictures"):
        PictureFolder(tmp_path / "none")
    with pytest.raises(ValueError, match=r"holds no picture; known are \.bmp"):
        PictureFolder(tmp_path)
    (tmp_path / "a.png").write_bytes(b"broken")
    with (
        pytest.warns(UserWarning, match="skipped"),
        pytest.raises(ValueError, match=r"none of its 1 pictures can be read; .*a\.png: cannot be read"),
    ):
        PictureFolder(tmp_path)


def test_open_pictures(folder: Path) -> None:
    assert len(open_pictures(str(folder))) == 3
    with pytest.raises(ValueError, match="flickr:x: no such kind of pictures; there are demo:"):
        open_pictures("flickr:x")
