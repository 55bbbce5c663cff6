"""FiveK, RAWIR, RGB2RAW, Zurich and RawBench, from files made as they were published."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rawaug.bayer import CFA, pack
from rawaug.data import check, open_pairs
from rawaug.data.published import CAMERAS, Rawir, Rgb2Raw, Zurich, fivek_numbers, fivek_pairs, read_packed
from rawaug.io import develop, write_picture
from rawaug.io.pictures import recode_jpeg

SPLITS = {("canon", "train"): 650, ("canon", "test"): 127, ("nikon", "train"): 414, ("nikon", "test"): 73}


def test_the_splits_are_as_large_as_published_and_share_nothing() -> None:
    numbers = {key: fivek_numbers(*key) for key in SPLITS}
    assert {key: len(value) for key, value in numbers.items()} == SPLITS
    together = [number for value in numbers.values() for number in value]
    assert len(set(together)) == len(together) and all(1 <= int(number) <= 5000 for number in together)
    assert {"3552", "4318"} <= set(numbers["canon", "test"]) and {"4331", "4613"} <= set(numbers["nikon", "test"])
    assert {"3674", "3745"} <= set(numbers["canon", "train"]) and {"2754", "4914"} <= set(numbers["nikon", "train"])


@pytest.fixture
def fivek(tmp_path: Path, bayer_dng: Callable[..., Path]) -> Path:
    """The Nikon's test frames, and one of the Canon's; red of a frame is as bright as its place in the split."""
    for place, number in enumerate(fivek_numbers("nikon", "test")):
        cell = np.array([[500 + 10 * place, 1000], [1000, 2000]], np.uint16)
        path = tmp_path / "raw_photos" / f"HQa{place % 3}" / "photos" / f"a{number}-_DGW{place:04d}.dng"
        path.parent.mkdir(parents=True, exist_ok=True)
        bayer_dng(path, np.tile(cell, (16, 24)))
    bayer_dng(tmp_path / f"a{fivek_numbers('canon', 'test')[0]}-MB.dng", np.tile(cell, (16, 24)))
    return tmp_path


def test_a_split_is_found_by_number_and_developed(fivek: Path) -> None:
    pairs = open_pairs(f"fivek_nikon:{fivek}", split="test")
    assert len(pairs) == 73
    for place in (0, 40, 72):
        pair = pairs[place]
        assert pair.name.startswith(f"a{fivek_numbers('nikon', 'test')[place]}-") and pair.registered
        assert pair.clean.mosaic[0, 0, 0].item() == pytest.approx((500 + 10 * place) / 4095)
        assert str(pair.cfa) == "RGGB" and pair.clean.white_balance == pytest.approx((2, 1, 1.6), rel=1e-4)
        assert pair.srgb.shape == (3, 32, 48)


def test_invisps_pictures_are_scaled_by_the_frames_maximum_and_stored_as_jpegs(
    fivek: Path, bayer_dng: Callable[..., Path]
) -> None:
    number = fivek_numbers("nikon", "test")[72]
    (file,) = fivek.rglob(f"a{number}-*.dng")
    cell = np.tile(np.array([[1700, 3400], [3400, 2600]], np.uint16), (16, 24))  # brightest at 0.83 of white
    cell[:, 24:] //= 3
    bayer_dng(file, cell)
    pair, plain = (open_pairs(f"{kind}_nikon:{fivek}", split="test")[72] for kind in ("invisp", "fivek"))
    assert torch.equal(pair.clean.mosaic, plain.clean.mosaic) and pair.name == plain.name == file.stem
    assert torch.equal(plain.srgb, develop(file))
    assert torch.equal(pair.srgb, recode_jpeg(develop(file, 0.75), 90))
    assert pair.srgb.float().mean() > plain.srgb.float().mean() + 2, "the brightest becomes white"


def test_missing_frames_are_reported(fivek: Path) -> None:
    with pytest.raises(FileNotFoundError, match="missing"):
        fivek_pairs(fivek, "test")
    with pytest.raises(FileNotFoundError, match="fivek"):
        open_pairs(f"fivek_nikon:{fivek}:train")
    with pytest.raises(ValueError, match=r"fivek: .*validation"):
        open_pairs(f"fivek:{fivek}", split="validation")
    with pytest.raises(ValueError, match=r"fivek: .*camera"):
        fivek_pairs(fivek, "test", ["sony"])
    with pytest.raises(FileNotFoundError, match="FiveK"):
        fivek_pairs(fivek / "none", "test", CAMERAS)


def test_check_counts_the_files_their_sizes_patterns_and_levels(fivek: Path) -> None:
    report = str(check(fivek))
    assert "RAW files: 74" in report
    assert "sizes: 32 x 48 (74)" in report and "cfas: RGGB (74)" in report and "black 0, white 4095 (74)" in report


PLANES = (100, 200, 300, 400)


def write_pair(folder: Path, stem: str, picture: str, scale: int = 1) -> None:
    """Packed (h, w, 4): flat planes, but for a bright cell at the left of the third row."""
    folder.mkdir(parents=True, exist_ok=True)
    packed = np.tile(np.array(PLANES, np.uint16) * scale, (6, 8, 1))
    packed[2, 0] += 7
    np.save(folder / f"{stem}.npy", packed)
    write_picture(folder / f"{stem}.{picture}", torch.arange(3 * 12 * 16).reshape(3, 12, 16).to(torch.uint8))


@pytest.mark.parametrize(("picture", "white"), [("jpg", 1024), ("png", 4095)])
def test_planes_rows_and_white_are_the_published_ones(tmp_path: Path, picture: str, white: int) -> None:
    write_pair(tmp_path, "12_3", picture)
    (pair,) = Rawir(tmp_path)
    assert pair.name == "12_3" and pair.cfa == CFA.RGGB and pair.registered and pair.clean.mosaic.shape == (1, 12, 16)
    packed = pack(pair.clean.mosaic, pair.cfa) * white
    assert torch.allclose(packed[:, 0, 1], torch.tensor(PLANES, dtype=torch.float32), atol=1e-3)
    assert torch.allclose(packed[:, 2, 0] - packed[:, 0, 1], torch.full((4,), 7.0), atol=1e-3)
    assert pair.clean.mosaic[0, 0, 3].item() == pytest.approx(200 / white) and pair.clean.mosaic[
        0, 1, 2
    ].item() == pytest.approx(300 / white)


def test_splits_are_folders_and_the_p20_is_not_registered(tmp_path: Path) -> None:
    write_pair(tmp_path / "data-p20" / "train", "a", "jpg")
    (tmp_path / "data-p20" / "val_rgb").mkdir()
    write_pair(tmp_path / "data-p20" / "val", "b", "jpg")
    assert [pair.name for pair in open_pairs(f"rawir:{tmp_path / 'data-p20'}", "train")] == ["a"]
    (pair,) = open_pairs(f"rawir:{tmp_path / 'data-p20'}", "validation")
    assert pair.name == "b" and not pair.registered
    with pytest.raises(FileNotFoundError, match=r"test: .*RAWIR"):
        open_pairs(f"rawir:{tmp_path / 'data-p20'}", "test")


def test_an_archive_states_its_white_level(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", "png")
    packed = np.load(tmp_path / "a.npy")
    (tmp_path / "a.npy").unlink()
    np.savez(tmp_path / "a.npz", raw=packed, max_val=2**14 - 1)
    (pair,) = Rawir(tmp_path)
    assert pair.clean.mosaic[0, 0, 3].item() == pytest.approx(200 / (2**14 - 1))
    np.savez(tmp_path / "a.npz", raw=packed)
    with pytest.raises(OSError, match=r"a\.npz: .*packed"):
        Rawir(tmp_path)[0]


def test_rgb2raw_keeps_whole_raws_of_every_phone_aside(tmp_path: Path) -> None:
    for phone in ("iphone-x", "samsung-s9"):
        for shot in range(10, 22):
            for crop in range(2):
                write_pair(tmp_path / phone, f"{shot}_{crop}", "png")
    splits = {split: Rgb2Raw(tmp_path, split) for split in ("train", "validation", "test")}
    assert {split: len(pairs) for split, pairs in splits.items()} == {"train": 32, "validation": 8, "test": 8}
    shots = {split: {name.rpartition("_")[0] for name in pairs.names} for split, pairs in splits.items()}
    assert shots["test"] == {f"{phone}/{shot}" for phone in ("iphone-x", "samsung-s9") for shot in (10, 20)}
    assert not (shots["train"] & shots["test"] or shots["train"] & shots["validation"])
    pair = open_pairs(f"rgb2raw:{tmp_path}", "test")[2]
    assert (pair.name, pair.clean.camera, pair.balance_known) == ("iphone-x/20_0", "iphone-x", False)
    assert pair.clean.mosaic[0, 0, 3].item() == pytest.approx(200 / 4095)
    with pytest.raises(ValueError, match="train"):
        write_pair(tmp_path / "one", "1_0", "png")
        Rgb2Raw(tmp_path / "one", "train")


def test_what_is_wrong_is_reported(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", "jpg", scale=3)
    with pytest.raises(ValueError, match=r"a\.npy: .*white"):
        Rawir(tmp_path)[0]
    assert Rawir(tmp_path, white=4095)[0].clean.mosaic.max().item() == pytest.approx(1207 / 4095)
    np.save(tmp_path / "a.npy", np.zeros((4, 6, 8), np.uint16))
    with pytest.raises(ValueError, match="unsigned"):
        Rawir(tmp_path)[0]
    np.save(tmp_path / "a.npy", np.array([{"code": "to run"}], object), allow_pickle=True)
    with pytest.raises(OSError, match=r"a\.npy: .*packed"):
        Rawir(tmp_path)[0]
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.npy: .*same"):
        Rawir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"none: .*RAWIR"):
        Rawir(tmp_path / "none")


@pytest.mark.parametrize(
    "damage",
    [
        lambda whole: whole.replace(b"(6, 8, 4)", b"(6, 8, 4" + b"0" * 9 + b")").replace(b" " * 10, b"", 1),
        lambda whole: whole.replace(b"'<u2'", b"'|O'  "),
        lambda whole: whole.replace(b"'shape'", b"'shap['"),
        lambda whole: whole[:40],
        lambda whole: whole[:40] + b" " * (len(whole) - 40),  # the dictionary in the header does not end
        lambda whole: b"PK\x03\x04" + whole,
        lambda whole: b"",
    ],
)
def test_damaged_arrays_are_named_and_the_rest_is_read(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    for stem in ("a", "b", "c"):
        write_pair(tmp_path, stem, "jpg")
    file = tmp_path / "b.npy"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(OSError, match=r"b\.npy: .*packed") as error:
        Rawir(tmp_path)[1]
    assert "\n" not in str(error.value)
    (part,) = (part for part in check(tmp_path).parts if part.what.startswith("RAWIR"))
    assert len(part.broken) == 1 and "b.npy" in part.broken[0] and part.counts["sizes"]["12 x 16"] == 2


CELL = np.array([[163, 263], [363, 463]], np.uint16)


def write_zurich(folder: Path, number: int, numbers: np.ndarray) -> None:
    for name in ("huawei_raw", "canon"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    Image.fromarray(numbers).save(folder / "huawei_raw" / f"{number}.png")
    height, width = numbers.shape
    write_picture(folder / "canon" / f"{number}.jpg", torch.full((3, height, width), 90, dtype=torch.uint8))


@pytest.fixture
def zurich(tmp_path: Path) -> Path:
    for split in ("train", "test"):
        for number in (0, 2, 10):
            mosaic = np.tile(CELL, (4, 6)) + np.uint16(number)
            mosaic[0, 0] = 20  # below black
            mosaic[7, 11] = 1023
            write_zurich(tmp_path / split, number, mosaic)
    return tmp_path


def test_pattern_levels_and_order_are_the_published_ones(zurich: Path) -> None:
    pairs = open_pairs(f"zurich:{zurich}", "test")
    assert [pair.name for pair in pairs] == ["test_0", "test_2", "test_10"]
    pair = pairs[2]
    assert pair.cfa == CFA.RGGB and not pair.registered and pair.clean.mosaic.shape == (1, 8, 12)
    planes = pack(pair.clean.mosaic, pair.cfa)[:, 1, 1] * (1020 - 63)
    assert planes.tolist() == pytest.approx([110, 210, 310, 410], abs=1e-3)
    assert pair.clean.mosaic[0, 0, 0].item() == pytest.approx(-43 / 957), "not clipped at black"
    assert pair.clean.mosaic[0, 7, 11].item() == 1 and pair.srgb[0, 3, 3].item() == pytest.approx(90, abs=2)


def test_8_bits_are_a_quarter(tmp_path: Path) -> None:
    write_zurich(tmp_path / "train", 0, (np.tile(CELL, (4, 6)) // 4).astype(np.uint8))
    planes = pack(Zurich(tmp_path)[0].clean.mosaic, "RGGB")[:, 0, 0] * 957
    assert planes.tolist() == pytest.approx([100, 200, 300, 400], abs=4)


def test_larger_pictures_and_mosaics_are_refused(zurich: Path) -> None:
    assert open_pairs(f"zurich:{zurich}", "test", max_pixels=96)[0].clean.mosaic.shape == (1, 8, 12)
    with pytest.raises(ValueError, match=r"huawei_raw/0\.png: .*declares"):
        open_pairs(f"zurich:{zurich}", "test", max_pixels=95)[0]
    write_picture(zurich / "test" / "canon" / "0.jpg", torch.zeros(3, 16, 24, dtype=torch.uint8))
    with pytest.raises(ValueError, match=r"canon/0\.jpg: .*declares"):
        open_pairs(f"zurich:{zurich}", "test", max_pixels=96)[0]


def test_what_is_wrong_with_zurich_is_reported(zurich: Path) -> None:
    (zurich / "train" / "canon" / "2.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"2\.jpg: .*missing"):
        Zurich(zurich)
    Image.fromarray(np.full((4, 4), 5000, np.uint16)).save(zurich / "test" / "huawei_raw" / "0.png")
    with pytest.raises(ValueError, match=r"0\.png: .*bits"):
        Zurich(zurich, "test")[0]
    with pytest.raises(ValueError, match=r"zurich: .*validation"):
        open_pairs(f"zurich:{zurich}", "validation")
    with pytest.raises(FileNotFoundError, match=r"huawei_raw: .*Zurich"):
        Zurich(zurich / "train")


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
    assert pair.name == "Scene_0001_ISO800_1" and pair.noisy is not None and pair.clean.color_known
    truth = torch.from_numpy(GAIN * light / (4095 - 64)).float()
    assert (pair.clean.mosaic[0] - truth).abs().mean() < 4e-3 < (pair.noisy.mosaic[0] - truth).abs().mean()
    assert (pair.clean.mosaic.mean() - truth.clamp(max=1).mean()).abs() < 1e-3


def test_what_is_missing_is_named(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    with pytest.raises(FileNotFoundError, match="RawBench"):
        open_pairs(f"rawbench:{tmp_path / 'none'}")
    with pytest.raises(ValueError, match="RawBench"):
        open_pairs(f"rawbench:{tmp_path}")
    bayer_dng(tmp_path / "IMG_0001.ARW", np.full((32, 32), 99, np.uint16))
    with pytest.raises(ValueError, match="Scene_0001_ISO3200_1"):
        open_pairs(f"rawbench:{tmp_path}")
    (tmp_path / "Scene_0002").mkdir()
    bayer_dng(tmp_path / "Scene_0002" / "Scene_0002_ISO200_1.ARW", np.full((32, 32), 99, np.uint16))
    with pytest.raises(FileNotFoundError, match=r"gt: .*download"):
        open_pairs(f"rawbench:{tmp_path}")


def test_a_pipe_in_the_place_of_packed_raw_is_refused_and_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.npy")
    keep = os.open(tmp_path / "a.npy", os.O_RDWR | os.O_NONBLOCK)  # so that opening it to read would not wait
    try:
        with pytest.raises(OSError, match=r"a\.npy.*regular"):
            read_packed(tmp_path / "a.npy", tmp_path / "a.png", None)
    finally:
        os.close(keep)
