"""Names that a file system allows, in reports, logs, tables, pages and outputs."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

from rawaug.commands.synth import print_synthesis
from rawaug.data import PictureFolder, check
from rawaug.errors import escape
from rawaug.evaluation.tables import print_rows
from rawaug.io import write_picture
from rawaug.synthesis.folder import synth

NAMES = [
    "a space", "new\nline", "\"double\" and 'single'", "<script>alert(1)</script>".replace("/", "\u2215"), "-rf",
    "[red]markup[", "$math$ 100%04d ?a=1#b", "\x1b[2Jcleared", "写真", "тест", "\u202eexe.gnp", "n" * 251,
]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "in").mkdir()
    write_picture(tmp_path / "plain.png", torch.full((3, 8, 8), 90, dtype=torch.uint8))
    for name in NAMES:
        (tmp_path / "in" / f"{name}.png").write_bytes((tmp_path / "plain.png").read_bytes())
    return tmp_path / "in"


def test_pictures_of_any_name_become_pairs(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder.with_name("out")
    result = synth(folder, out, "npz", workers=0)
    assert not result.broken and result.made == len(NAMES)
    assert synth(folder, out, "npz", workers=0).existing == len(NAMES)
    written = [file for file in out.rglob("*") if file.is_file()]
    assert len(written) == 2 * len(NAMES) + 1 and all(file.parent == out for file in written)
    print_synthesis(result)
    assert "\x1b[2J" not in capsys.readouterr().out


def test_damaged_files_of_any_name_are_named_in_a_line_each(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for file in folder.iterdir():
        file.write_bytes(b"")
    (part,) = (report := check(folder)).parts
    assert len(part.broken) == len(NAMES) and len(str(report).splitlines()) == len(NAMES) + 3
    pictures = PictureFolder(folder, allowed_share=1.0)
    with pytest.raises(AssertionError):
        pictures[0]
    for text in (str(report), pictures.report()):
        assert "\x1b" not in text and "\u202e" not in text and "写真.png" in text and "[red]markup[" in text
    assert len(pictures.report().splitlines()) == len(NAMES) + 1


@pytest.mark.skipif(os.name != "posix", reason="names are bytes on POSIX")
def test_names_that_are_not_utf8_are_named_too(folder: Path) -> None:
    (folder / os.fsdecode(b"\xff\xfe.png")).write_bytes(b"")
    (folder / os.fsdecode(b"\xff.dng")).write_bytes(b"II*\0")
    text = str(check(folder))
    text.encode()
    assert "xff" in text and "is not UTF-8; rename it" in text


def test_tables_show_names_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows("[bold]title[/none]", ["name", "PSNR"], [["[/]\x1b[2J\n", "1"]])
    printed = capsys.readouterr().out
    assert "[bold]title[/none]" in printed and "[/]" + r"\x1b[2J\n" in printed and "\x1b" not in printed


def test_what_can_be_printed_stays() -> None:
    assert escape("é ü 写真 ½") == "é ü 写真 ½"
    assert escape("a\udc80b\r") == r"a\udc80b\r"
