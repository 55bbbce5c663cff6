"""What a file is, asked of its first bytes; and folders of files of many kinds."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rawaug.cli import main
from rawaug.data import PictureFolder, check
from rawaug.data.folders import reports
from rawaug.io import content, read_picture
from rawaug.io.content import identify_content, list_pictures
from rawaug.io.directories import Tag, pack_directory

Dng = Callable[..., Path]
PIXELS = np.random.default_rng(0).integers(0, 256, (24, 36, 3), np.uint8)


def tiff(tags: list[Tag]) -> bytes:
    return b"II*\0" + struct.pack("<I", 8) + pack_directory("<", tags, 8)


HEADS: dict[str, tuple[bytes, str, str]] = {
    "Canon CRW": (b"II\x1a\0\0\0HEAPCCDR", "raw", "CRW"),
    "Canon CR2": (b"II*\0\x10\0\0\0CR\x02\0" + bytes(20), "raw", "CR2"),
    "Canon CR3": (b"\0\0\0\x18ftypcrx \0\0\0\1crx isom", "raw", "CR3"),
    "Fuji": (b"FUJIFILMCCD-RAW 0201", "raw", "RAF"),
    "Panasonic": (b"IIU\0\x18\0\0\0", "raw", "RW2"),
    "Olympus": (b"IIRO\x08\0\0\0", "raw", "ORF"),
    "mosaic in TIFF": (tiff([Tag(262, 3, 1, struct.pack("<H", 32803))]), "raw", "RAW based on TIFF"),
    "picture in TIFF": (tiff([Tag(262, 3, 1, struct.pack("<H", 2))]), "picture", "TIFF"),
    "damaged TIFF": (b"II*\0\xff\xff\xff\x7f", "picture", "TIFF"),
    "iPhone": (b"\0\0\0\x24ftypheic\0\0\0\0mif1MiHEMiPr", "picture", "HEIC"),
    "AVIF": (b"\0\0\0\x1cftypmif1\0\0\0\0avifmif1miaf", "picture", "AVIF"),
    "film": (b"\0\0\0\x18ftypqt  \0\0\0\0qt  ", "other", "unknown"),
    "text": (b"What a day", "other", "unknown"),
    "empty": (b"", "other", "unknown"),
}


@pytest.mark.parametrize("name", HEADS)
@pytest.mark.parametrize("extension", ["", ".bin"])
def test_a_file_is_what_its_bytes_say(tmp_path: Path, name: str, extension: str) -> None:
    data, kind, format_name = HEADS[name]
    (tmp_path / f"a{extension}").write_bytes(data)
    assert identify_content(tmp_path / f"a{extension}") == (kind, format_name)


def test_a_wrong_extension_does_not_deceive_and_decides_where_bytes_tell_nothing(
    tmp_path: Path, bayer_dng: Dng
) -> None:
    bayer_dng(tmp_path / "a.dng", np.full((32, 48), 1000, np.uint16))
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.dng").read_bytes())
    assert identify_content(tmp_path / "a.jpg") == ("raw", "DNG")
    Image.fromarray(PIXELS).save(tmp_path / "b.png")
    (tmp_path / "b.dng").write_bytes((tmp_path / "b.png").read_bytes())
    assert identify_content(tmp_path / "b.dng") == ("picture", "PNG")
    for extension, kind in ((".raw", "raw"), (".jpg", "picture"), (".txt", "other")):
        (tmp_path / f"c{extension}").write_bytes(bytes(100))
        assert identify_content(tmp_path / f"c{extension}").kind == kind
    with pytest.raises(FileNotFoundError, match="none"):
        identify_content(tmp_path / "none")


def test_raw_is_never_read_as_the_picture_that_lies_in_it(tmp_path: Path, bayer_dng: Dng) -> None:
    bayer_dng(tmp_path / "a.dng", np.full((32, 48), 1000, np.uint16))
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.dng").read_bytes())
    for name in ("a.dng", "b.jpg"):
        with pytest.raises(ValueError, match=rf"{name}.*DNG"):
            read_picture(tmp_path / name)


@pytest.fixture
def mixed(tmp_path: Path, bayer_dng: Dng) -> Path:
    """Three pictures, one of them damaged, two HEIC, a RAW file and three others."""
    folder = tmp_path / "mixed"
    folder.mkdir()
    Image.fromarray(PIXELS).save(folder / "a.jpg")
    Image.fromarray(PIXELS).save(folder / "b.png")
    (folder / "c.jpg").write_bytes((folder / "a.jpg").read_bytes()[:300])
    bayer_dng(folder / "d.dng", np.full((32, 48), 1000, np.uint16))
    for name in ("e.heic", "f.HEIC"):
        (folder / name).write_bytes(HEADS["iPhone"][0])
    for name in ("notes.txt", "list.TXT", "no_extension"):
        (folder / name).write_text("words")
    return folder


def test_what_a_folder_leaves_out_is_a_line_for_each_kind_and_adds_up(
    mixed: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(content, "reads_heic", lambda: False)
    listing = list_pictures(mixed)
    assert [file.name for file in listing.files] == ["a.jpg", "b.png", "c.jpg"]
    assert {kind: extensions.total() for kind, extensions in listing.left_out.items()} == {
        "HEIC picture": 2,
        "RAW file": 1,
        "other file": 3,
    }
    heic, raw, other = listing.lines()
    assert "2 HEIC pictures left out" in heic and "pip install" in heic and "heif" in heic
    assert "1 RAW file left out (.dng 1)" in raw
    assert "(.txt 2, no extension 1)" in other

    (report,) = reports(PictureFolder(mixed))
    assert report.splitlines()[-3:] == listing.lines()

    checked = check(mixed)
    assert [part.items for part in checked.parts] == [1, 3]
    assert len(checked.broken) == 1 and "c.jpg" in checked.broken[0]
    assert checked.left_out[0] == heic and "other" in checked.left_out[1]

    assert main(["synth", str(mixed), str(mixed.parent / "out"), "--format", "npz", "--workers", "0"]) == 0
    printed = capsys.readouterr().out.splitlines()
    assert set(listing.lines()) < set(printed)
    assert sum("c.jpg" in line for line in printed) == 1


def test_a_folder_of_heic_alone_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(content, "reads_heic", lambda: False)
    (tmp_path / "a.heic").write_bytes(HEADS["iPhone"][0])
    for look in (list_pictures, PictureFolder, check):
        with pytest.raises(ValueError, match="HEIC"):
            look(tmp_path)


def test_denoise_asks_the_content(
    mixed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(content, "reads_heic", lambda: False)
    (mixed / "d.dng").rename(mixed.parent / "d.jpg")
    assert main(["denoise", str(mixed.parent / "d.jpg"), str(tmp_path / "o.jpg")]) == 2
    assert "DNG" in capsys.readouterr().err
    assert main(["denoise", str(mixed / "notes.txt"), str(tmp_path / "o.jpg")]) == 2
    assert "neither camera RAW nor a picture" in capsys.readouterr().err

    (mixed / "c.jpg").unlink()
    out = tmp_path / "out"
    assert main(["denoise", str(mixed), str(out), "--denoiser", "NonLocalMeans", "--device", "cpu"]) == 0
    assert sorted(file.name for file in out.iterdir()) == ["a.jpg", "b.png"]
    printed = capsys.readouterr().out
    assert "2 HEIC pictures left out" in printed and "3 other files left out" in printed
