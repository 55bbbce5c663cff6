"""Folders of pictures and of RAW files: damaged ones, other datasets' leftovers, and caches."""

from __future__ import annotations

import logging
import os
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader

from rawaug.bayer import CFA, turn
from rawaug.data import PictureFolder, RawFolder, open_pairs, open_pictures
from rawaug.data.frames import Cached, Readable
from rawaug.data.opening import picture_stamp
from rawaug.data.pair_folder import require_no_pairs
from rawaug.io import develop, read_raw, write_picture


def grey(level: int, height: int = 6, width: int = 8) -> torch.Tensor:
    return torch.full((3, height, width), level, dtype=torch.uint8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, level in (("b.png", 20), ("a/z.TIF", 10), ("c.bmp", 30)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_picture(tmp_path / name, grey(level))
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def huge_png(side: int) -> bytes:
    """A header that claims ``side`` x ``side``, and data enough for the claim to look honest."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)), (b"IDAT", bytes(400_000)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def damage(folder: Path) -> set[str]:
    """One file for each way of being no usable picture; their names."""
    pixels = np.random.default_rng(0).integers(0, 256, (40, 50, 3), np.uint8)
    frames = [Image.fromarray(np.roll(pixels, k, 1)) for k in range(3)]
    frames[0].save(folder / "x_truncated.jpg", quality=95)
    whole = (folder / "x_truncated.jpg").read_bytes()
    (folder / "x_truncated.jpg").write_bytes(whole[: len(whole) * 2 // 3])
    frames[0].save(folder / "x_truncated.png")
    (folder / "x_truncated.png").write_bytes((folder / "x_truncated.png").read_bytes()[:-3000])
    (folder / "x_empty.jpg").write_bytes(b"")
    (folder / "x_text.jpeg").write_text("<html>404 Not Found</html>")
    (folder / "x_zeros.tif").write_bytes(bytes(5000))
    Image.fromarray(pixels[:1, :1]).save(folder / "x_1x1.png")
    Image.fromarray(pixels).convert("CMYK").save(folder / "x_cmyk.jpg")
    frames[0].save(folder / "x_animated.gif", save_all=True, append_images=frames[1:])
    frames[0].save(folder / "x_animated.webp", save_all=True, append_images=frames[1:])
    (folder / "x_dangling.jpg").symlink_to(folder / "nowhere.jpg")
    (folder / "x_huge.png").write_bytes(huge_png(60_000))
    (folder / "x_wide.png").write_bytes(huge_png(17_000))
    os.mkfifo(folder / "x_pipe.jpg")
    return {path.name for path in folder.glob("x_*")}


def unusual(folder: Path) -> set[str]:
    """What only looks damaged: a wrong extension, 16 bits, a folder with a picture's name; names of the files."""
    pixels = np.random.default_rng(1).integers(0, 256, (40, 50, 3), np.uint8)
    Image.fromarray(pixels).save(folder / "y_png_inside.jpg", format="png")
    Image.fromarray(pixels[..., 0].astype(np.uint16) * 257).save(folder / "y_16_bits.png")
    (folder / "y_folder.jpg").mkdir()
    Image.fromarray(pixels).save(folder / "y_folder.jpg" / "y_inside.png")
    return {"y_png_inside.jpg", "y_16_bits.png", "y_inside.png"}


@pytest.fixture(scope="module")
def messy(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[str]]:
    """Forty pictures, three unusual ones, and thirteen that cannot be used."""
    folder = tmp_path_factory.mktemp("messy")
    for k in range(40):
        (folder / f"{k % 7}").mkdir(exist_ok=True)
        Image.fromarray(np.full((40, 50, 3), k % 256, np.uint8)).save(folder / f"{k % 7}" / f"{k:02d}.jpg")
    unusual(folder)
    return folder, damage(folder)


def test_pictures_come_sorted_by_path(folder: Path) -> None:
    pictures = PictureFolder(folder)
    names = [pictures.file(k).relative_to(folder).as_posix() for k in range(len(pictures))]
    assert names == ["a/z.TIF", "b.png", "c.bmp"]
    assert [picture[0, 0, 0].item() for picture in (pictures[0], pictures[1], pictures[2])] == [10, 20, 30]
    assert torch.equal(pictures[-1], grey(30)) and pictures.skipped == {}
    first, other = pictures.report().splitlines()
    assert first == f"{folder}: none of 3 pictures skipped so far"
    assert other.startswith("1 other file left out (.txt 1)")
    with pytest.raises(IndexError):
        pictures[3]


def test_an_unreadable_file_is_named_and_replaced_by_the_next(folder: Path) -> None:
    (folder / "b.png").write_bytes(b"broken")
    pictures = PictureFolder(folder, allowed_share=0.5)
    assert torch.equal(pictures[1], grey(30))
    assert [pictures.file(index).name for index in range(3)] == ["z.TIF", "c.bmp", "c.bmp"], "the files that are given"
    (folder / "b.png").unlink()
    assert torch.equal(pictures[1], grey(30)), "and not tried again"
    assert list(pictures.skipped) == [folder / "b.png"] and "cannot be read" in pictures.skipped[folder / "b.png"]
    (folder / "c.bmp").write_bytes(b"broken")
    assert torch.equal(PictureFolder(folder, allowed_share=0.5)[1], grey(10)), "the first comes after the last"


def test_more_than_the_allowed_share_is_an_error_that_names_them(folder: Path) -> None:
    (folder / "b.png").write_bytes(b"broken")
    (folder / "c.bmp").write_bytes(b"broken")
    pictures = PictureFolder(folder, allowed_share=0.4)
    assert torch.equal(pictures[0], grey(10)), "nothing is wrong yet"
    with pytest.raises(
        ValueError,
        match="allowed_share",
    ) as caught:
        pictures[1]
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="allowed_share"):
        pictures[1]  # nor later
    with pytest.raises(ValueError, match="allowed_share"):
        PictureFolder(folder)[1]


def test_small_pictures_are_skipped_where_a_crop_would_not_fit(folder: Path) -> None:
    write_picture(folder / "b.png", grey(40, 9, 9))
    pictures = PictureFolder(folder, min_side=9, allowed_share=0.7)
    assert [torch.equal(pictures[k], grey(40, 9, 9)) for k in range(3)] == [True] * 3
    assert "a/z.TIF: is 6 x 8, smaller than min_side 9" in pictures.skipped[folder / "a" / "z.TIF"].replace(os.sep, "/")


@pytest.mark.parametrize("context", [None, "forkserver"])
def test_an_epoch_over_a_damaged_folder_completes_and_names_every_file(
    messy: tuple[Path, set[str]], context: str | None
) -> None:
    folder, damaged = messy
    pictures = PictureFolder(folder, allowed_share=0.5)
    assert len(damaged) == 13 and len(pictures) == 56
    loader = DataLoader(
        pictures,
        batch_size=None,
        shuffle=True,
        generator=torch.Generator().manual_seed(0),
        num_workers=1 if context else 0,
        multiprocessing_context=context,
    )
    assert sum(1 for _ in loader) == len(pictures)
    assert {path.name for path in pictures.skipped} == damaged
    report = pictures.report().splitlines()
    assert report[0] == f"{folder}: 13 of 56 pictures skipped"
    assert all(sum(name in line for line in report) == 1 for name in damaged)


def test_each_damage_is_reported_for_what_it_is_and_logged_once(
    messy: tuple[Path, set[str]], caplog: pytest.LogCaptureFixture
) -> None:
    pictures = PictureFolder(messy[0], allowed_share=0.5)
    with caplog.at_level(logging.WARNING):
        for k in [*range(len(pictures)), 0, 1]:
            pictures[k]
    assert len(caplog.records) == len(messy[1])
    reasons = {path.name: reason for path, reason in pictures.skipped.items()}
    assert "60000 x 60000 pixels, above the limit" in reasons["x_huge.png"] or "too large" in reasons["x_huge.png"]
    assert "17000 x 17000 pixels, above the limit of 67108864" in reasons["x_wide.png"]
    assert "is an animation" in reasons["x_animated.gif"] and "is an animation" in reasons["x_animated.webp"]
    assert "is CMYK" in reasons["x_cmyk.jpg"] and "smaller than min_side 2" in reasons["x_1x1.png"]
    assert "no such picture file" in reasons["x_dangling.jpg"] and "is a pipe, a device" in reasons["x_pipe.jpg"]
    assert all("\n" not in reason and name in reason for name, reason in reasons.items())


def test_the_replacement_does_not_depend_on_who_asks_in_which_order(messy: tuple[Path, set[str]]) -> None:
    folder, _ = messy
    forwards, backwards = PictureFolder(folder, allowed_share=0.5), PictureFolder(folder, allowed_share=0.5)
    chosen = range(30, len(forwards))
    there = {k: forwards[k] for k in chosen}
    back = {k: backwards[k] for k in reversed(chosen)}
    assert all(torch.equal(there[k], back[k]) for k in chosen)


def test_nothing_is_opened_at_the_start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for k in range(30):
        (tmp_path / f"{k:02d}.jpg").touch()
    monkeypatch.setattr("rawaug.data.folders.read_picture", lambda *_: pytest.fail("opened"))
    assert len(PictureFolder(tmp_path)) == 30


def test_the_stamp_of_a_folder_follows_its_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_picture(tmp_path / name, grey(1))
    stamps = [picture_stamp(tmp_path), picture_stamp(tmp_path)]
    write_picture(tmp_path / "a.png", grey(2))  # of the same name and size
    stamps.append(picture_stamp(tmp_path))
    (tmp_path / "b.png").rename(tmp_path / "c.png")
    stamps.append(picture_stamp(tmp_path))
    assert stamps[0] == stamps[1] and len(set(stamps)) == 3
    assert picture_stamp(["demo:", tmp_path]) != picture_stamp(["demo:"])
    assert picture_stamp("shapes:10") == "shapes:10"


def test_names_may_hold_any_bytes(tmp_path: Path) -> None:
    strange = ["ä.png", "b c.png", os.fsdecode(b"\xff.png")]
    for name in strange:
        write_picture(tmp_path / "a.png", grey(1))
        (tmp_path / "a.png").rename(tmp_path / name)
    pictures = pickle.loads(pickle.dumps(PictureFolder(tmp_path, allowed_share=0.5)))
    assert sorted(pictures.file(k).name for k in range(3)) == sorted(strange)
    assert pictures[2].shape == (3, 6, 8)
    assert "name is not UTF-8; rename it" in pictures.report()


def test_nothing_to_read_is_reported_at_once(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="none:"):
        PictureFolder(tmp_path / "none")
    with pytest.raises(ValueError, match="extensions"):
        PictureFolder(tmp_path)
    (tmp_path / "a.png").write_bytes(b"broken")
    with pytest.raises(ValueError, match="unusable"):
        PictureFolder(tmp_path)[0]


Dng = Callable[..., Path]
NUMBERS = np.random.default_rng(0).integers(0, 4096, (40, 62)).astype(np.uint16)


@pytest.fixture
def shots(tmp_path: Path, bayer_dng: Dng) -> Path:
    (tmp_path / "sub").mkdir()
    bayer_dng(tmp_path / "b.dng", NUMBERS, "GRBG")
    bayer_dng(tmp_path / "sub" / "c.DNG", NUMBERS[::-1].copy(), "BGGR")
    return tmp_path


def test_a_folder_a_file_and_a_list(shots: Path) -> None:
    pairs = RawFolder(shots)
    assert [pair.name for pair in pairs] == ["b", "c"]
    assert [pair.cfa for pair in pairs[:]] == [CFA.GRBG, CFA.BGGR]
    assert [pair.name for pair in RawFolder(shots / "b.dng")] == ["b"]
    assert [pair.name for pair in RawFolder([shots / "sub" / "c.DNG", str(shots / "b.dng")])] == ["c", "b"]
    assert pairs[-1].name == "c" and pairs[0] is pairs[-2] and len(open_pairs(str(shots))) == 2
    with pytest.raises(IndexError):
        pairs[2]


def test_a_pair_says_whether_its_colours_are_known(tmp_path: Path, bayer_dng: Dng) -> None:
    bayer_dng(tmp_path / "known.dng", NUMBERS)
    bayer_dng(tmp_path / "unknown.dng", NUMBERS, color_matrix=None)
    assert [pair.clean.color_known for pair in RawFolder(tmp_path)] == [True, False]


def test_a_link_to_itself_is_one_unreadable_frame_of_a_folder(shots: Path) -> None:
    (shots / "sub" / "b.dng").symlink_to(shots / "sub" / "b.dng")
    pairs = Readable(RawFolder(shots))
    assert [pair.name for pair in pairs] == ["b.dng", "sub/c.DNG"]
    assert pairs.reasons() == [f"{shots}/sub/b.dng: cannot be opened (Too many levels of symbolic links)"]
    require_no_pairs(RawFolder(shots), str(shots), as_clean=True)


def test_a_pair_is_the_mosaic_and_libraws_rendering(shots: Path) -> None:
    pair, frame = RawFolder(shots)[0], read_raw(shots / "b.dng")
    assert torch.equal(pair.clean.mosaic, frame.mosaic) and torch.equal(pair.srgb, develop(shots / "b.dng"))
    assert (pair.clean.camera, pair.clean.white_balance, pair.registered) == (frame.camera, frame.white_balance, True)
    assert pair.noisy is None


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
    with pytest.warns(UserWarning, match=r"a.jpg: .*LibRaw"):
        pair = RawFolder(tmp_path)[0]
    assert pair.registered and torch.equal(pair.srgb, develop(path))


def test_a_jpeg_that_lacks_a_few_lines_is_taken_and_the_mosaic_is_cut(tmp_path: Path, bayer_dng: Dng) -> None:
    numbers = np.random.default_rng(1).integers(0, 4096, (160, 240)).astype(np.uint16)
    path = bayer_dng(tmp_path / "a.dng", numbers, "GRBG")
    write_picture(tmp_path / "a.png", develop(path)[:, 2:158, 2:238])
    (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    pair = RawFolder(tmp_path)[0]
    assert not pair.registered and pair.cfa == CFA.GRBG
    assert torch.equal(pair.clean.mosaic, read_raw(path).mosaic[:, 2:158, 2:238])
    assert torch.equal(pair.srgb, develop(path)[:, 2:158, 2:238])


def test_files_of_one_stem_have_names_of_their_own(tmp_path: Path, bayer_dng: Dng) -> None:
    for shots in ("x", "y"):
        (tmp_path / shots).mkdir()
        bayer_dng(tmp_path / shots / "IMG.dng", NUMBERS)
    assert [pair.name for pair in RawFolder(tmp_path)] == ["x/IMG.dng", "y/IMG.dng"]


def test_nothing_to_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="extensions"):
        RawFolder(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"none\.dng:"):
        RawFolder(tmp_path / "none.dng")
    for opened, kind in ((open_pairs, "data"), (open_pictures, "pictures")):
        with pytest.raises(ValueError, match=f"flickr:x.*{kind}.*demo:"):
            opened("flickr:x")


class Decoded:
    """Three pictures of 0.5 MiB; what is decoded is noted."""

    def __init__(self) -> None:
        self.read: list[int] = []

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> Tensor:
        self.read.append(index)
        return torch.full((2, 512, 512), index, dtype=torch.uint8)


@pytest.mark.parametrize(
    ("megabytes", "order", "decoded"), [(2, [0, 1, 2], [0, 1, 2]), (1, [2, 0, 1], [2, 0, 1, 1])], ids=["all", "two"]
)
def test_a_picture_is_decoded_once_if_there_is_room(megabytes: int, order: list[int], decoded: list[int]) -> None:
    pictures = Decoded()
    kept = Cached(pictures, megabytes)  # type: ignore[var-annotated]
    for _ in range(2):
        assert [int(kept[k][0, 0, 0]) for k in order] == order
    assert pictures.read == decoded
