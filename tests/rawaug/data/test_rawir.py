from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.bayer import CFA, pack
from rawaug.data import Rawir, Rgb2Raw, check, open_pairs
from rawaug.io import write_picture

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
    assert pair.name == "12_3" and pair.cfa == CFA.RGGB and pair.registered and pair.raw.shape == (1, 12, 16)
    packed = pack(pair.raw, pair.cfa) * white
    assert torch.allclose(packed[:, 0, 1], torch.tensor(PLANES, dtype=torch.float32), atol=1e-3)
    assert torch.allclose(packed[:, 2, 0] - packed[:, 0, 1], torch.full((4,), 7.0), atol=1e-3)
    assert pair.raw[0, 0, 3].item() == pytest.approx(200 / white) and pair.raw[0, 1, 2].item() == pytest.approx(
        300 / white
    )


def test_splits_are_folders_and_the_p20_is_not_registered(tmp_path: Path) -> None:
    write_pair(tmp_path / "data-p20" / "train", "a", "jpg")
    (tmp_path / "data-p20" / "val_rgb").mkdir()
    write_pair(tmp_path / "data-p20" / "val", "b", "jpg")
    assert [pair.name for pair in open_pairs(f"rawir:{tmp_path / 'data-p20'}", "train")] == ["a"]
    (pair,) = open_pairs(f"rawir:{tmp_path / 'data-p20'}", "validation")
    assert pair.name == "b" and not pair.registered
    with pytest.raises(ValueError, match=r"test: contains no \.npy or \.npz file"):
        open_pairs(f"rawir:{tmp_path / 'data-p20'}", "test")


def test_an_archive_states_its_white_level(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", "png")
    packed = np.load(tmp_path / "a.npy")
    (tmp_path / "a.npy").unlink()
    np.savez(tmp_path / "a.npz", raw=packed, max_val=2**14 - 1)
    (pair,) = Rawir(tmp_path)
    assert pair.raw[0, 0, 3].item() == pytest.approx(200 / (2**14 - 1))
    np.savez(tmp_path / "a.npz", raw=packed)
    with pytest.raises(OSError, match=r"a\.npz: cannot be read as raw and max_val"):
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
    assert (pair.name, pair.camera, pair.balance_known) == ("iphone-x/20_0", "iphone-x", False)
    assert pair.raw[0, 0, 3].item() == pytest.approx(200 / 4095)
    with pytest.raises(ValueError, match="has no pair of RGB2RAW for train; it needs files of 10 RAWs"):
        write_pair(tmp_path / "one", "1_0", "png")
        Rgb2Raw(tmp_path / "one", "train")


def test_what_is_wrong_is_reported(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", "jpg", scale=3)
    with pytest.raises(ValueError, match=r"a\.npy: has value 1207, above the white level 1024; pass white="):
        Rawir(tmp_path)[0]
    assert Rawir(tmp_path, white=4095)[0].raw.max().item() == pytest.approx(1207 / 4095)
    np.save(tmp_path / "a.npy", np.zeros((4, 6, 8), np.uint16))
    with pytest.raises(ValueError, match=r"packed RAW must be unsigned \(h, w, 4\), got uint16 \(4, 6, 8\)"):
        Rawir(tmp_path)[0]
    np.save(tmp_path / "a.npy", np.array([{"code": "to run"}], object), allow_pickle=True)
    with pytest.raises(OSError, match=r"a\.npy: cannot be read as an array"):
        Rawir(tmp_path)[0]
    (tmp_path / "a.jpg").unlink()
    with pytest.raises(FileNotFoundError, match=r"a\.npy: has no \.jpg or \.png of the same stem"):
        Rawir(tmp_path)
    with pytest.raises(FileNotFoundError, match="none: no such folder of RAWIR"):
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
    with pytest.raises(OSError, match=r"b\.npy: cannot be read as an array") as error:
        Rawir(tmp_path)[1]
    assert "\n" not in str(error.value)
    (part,) = (part for part in check(tmp_path).parts if part.what.startswith("RAWIR"))
    assert len(part.broken) == 1 and "b.npy" in part.broken[0] and part.sizes["12 x 16"] == 2


def test_an_archive_in_place_of_an_array(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", "jpg")
    np.savez(tmp_path / "a.npz", np.zeros(3))
    (tmp_path / "a.npz").replace(tmp_path / "a.npy")
    with pytest.raises(OSError, match=r"a\.npy: cannot be read as an array \(does not begin as one\)"):
        Rawir(tmp_path)[0]
