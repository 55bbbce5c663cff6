"""Noisy/clean pairs from files of every format: what files state, what is given, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image
from scipy.io import savemat

from rawaug.bayer import CFA, pack
from rawaug.cli import main
from rawaug.data import Pair, PairFolder, check, open_pairs
from rawaug.io import RawFrame

Dng = Callable[..., Path]
BLACK, WHITE = 64, 1023
CLEAN = np.random.default_rng(0).integers(BLACK, WHITE + 1, (32, 48)).astype(np.uint16)
NOISY = np.clip(CLEAN + np.random.default_rng(1).normal(0, 20, CLEAN.shape), 0, WHITE).round().astype(np.uint16)
GIVEN: dict[str, Any] = {"cfa": "GRBG", "black": BLACK, "white": WHITE}
STATED = {**GIVEN, "white_balance": [4.0, 2.0, 3.0], "shot_var": 1e-3, "read_var": 1e-5}
MATRIX = np.array([[1.5, -0.3, -0.2], [-0.2, 1.4, -0.2], [0.0, -0.5, 1.5]])


def signal(numbers: np.ndarray) -> torch.Tensor:
    return torch.from_numpy((numbers.astype(np.float32) - BLACK) / (WHITE - BLACK))[None]


def write(file: Path, numbers: np.ndarray) -> None:
    """A mosaic that states nothing, in the format of its extension."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".npz":
        np.savez(file, x=numbers)
    elif file.suffix == ".mat":
        savemat(file, {"x": numbers})
    elif file.suffix == ".png":
        Image.fromarray(numbers).save(file)
    else:
        tifffile.imwrite(file, numbers, photometric="minisblack")


def write_pair(folder: Path, name: str, suffix: str) -> None:
    write(folder / f"{name}_noisy{suffix}", NOISY)
    write(folder / f"{name}_clean{suffix}", CLEAN)


def refused(folder: Path, **settings: Any) -> str:
    """The one line with which the pairs, or the first one, are refused."""
    with pytest.raises((OSError, ValueError)) as error:
        open_pairs(f"pairs:{folder}", **settings)[0]
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".png", ".tif", ".TIFF"])
def test_numbers_of_every_format_become_signal_by_the_given_levels(tmp_path: Path, suffix: str) -> None:
    write_pair(tmp_path / "sub", "a", suffix)
    (pair,) = open_pairs(f"pairs:{tmp_path}", **GIVEN)
    assert pair.noisy is not None and pair.noisy.noise_profile is None
    assert (pair.name, pair.cfa, pair.clean.color_known) == ("sub/a", CFA.GRBG, False)
    assert torch.allclose(pair.clean.mosaic, signal(CLEAN), atol=1e-6)
    assert (
        torch.allclose(pair.noisy.mosaic, signal(NOISY), atol=1e-6) and pair.noisy.mosaic.min() < 0
    )  # not clipped at black
    missing = dict(GIVEN)
    for key in ("white", "black", "cfa"):  # what is not stated must be given
        del missing[key]
        assert re.search(f"a_noisy.*does not state its ({key}|CFA)", refused(tmp_path, **missing), re.IGNORECASE)


def test_a_camera_file_states_it_all_and_cannot_be_contradicted(tmp_path: Path, bayer_dng: Dng) -> None:
    for kind, numbers in (("noisy", NOISY), ("clean", CLEAN)):
        bayer_dng(tmp_path / f"a_{kind}.dng", numbers, "BGGR", (BLACK,), WHITE, noise_profile=(1e-3, 1e-5))
    pair = PairFolder(tmp_path)[0]
    assert (pair.cfa, pair.clean.color_known, pair.clean.camera) == (CFA.BGGR, True, "Maker Model 1")
    assert pair.noisy is not None and pair.noisy.noise_profile == (1e-3, 1e-5)
    assert pair.clean.white_balance == pytest.approx((2.0, 1.0, 1.6))
    assert pair.noisy is not None and torch.allclose(pair.noisy.mosaic, signal(NOISY), atol=1e-6)
    assert "states cfa BGGR, not RGGB as given" in refused(tmp_path, cfa="RGGB")
    assert "states black 64, not 0 as given" in refused(tmp_path, black=0)
    assert len(open_pairs(f"pairs:{tmp_path}", cfa="BGGR", black=[BLACK] * 4, white=WHITE)[:]) == 1


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".tif"])
def test_statements_of_a_file_are_taken(tmp_path: Path, suffix: str) -> None:
    stated = {**STATED, "color_matrix": MATRIX.tolist()}
    if suffix == ".tif":
        for kind, numbers in (("noisy", NOISY), ("clean", CLEAN)):
            tifffile.imwrite(tmp_path / f"a_{kind}.tif", numbers, description=json.dumps(stated), metadata=None)
    elif suffix == ".npz":
        packed: dict[str, Any] = {
            k: pack(torch.from_numpy(x.astype(np.int32))[None], "GRBG").numpy() for k, x in both().items()
        }
        np.savez(tmp_path / "a.npz", **packed, **stated)
    else:
        savemat(tmp_path / "a.mat", {**both(), **stated})
    pair = PairFolder(tmp_path)[0]
    assert (pair.name, pair.cfa) == ("a", CFA.GRBG)
    assert (pair.clean.white_balance, pair.clean.color_known) == ((2.0, 1.0, 1.5), True)
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    assert pair.noisy.noise_profile[0] == pytest.approx(1e-3)
    assert torch.allclose(pair.clean.color_matrix, torch.tensor(MATRIX).float())
    assert pair.noisy is not None and torch.allclose(pair.noisy.mosaic, signal(NOISY), atol=1e-6)
    assert torch.allclose(pair.clean.mosaic, signal(CLEAN), atol=1e-6)


def both() -> dict[str, np.ndarray]:
    return {"noisy": NOISY, "clean": CLEAN}


def test_four_black_levels_are_those_of_r_gr_gb_b(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", noisy=CLEAN, clean=CLEAN, black=np.array([60, 61, 62, 63]), white=WHITE)
    packed = pack(PairFolder(tmp_path, cfa="GRBG")[0].clean.mosaic, "GRBG")
    numbers = pack(torch.from_numpy(CLEAN.astype(np.float32))[None], "GRBG")
    for plane, black in enumerate((60, 61, 62, 63)):
        assert torch.allclose(packed[plane], (numbers[plane] - black) / (WHITE - black))


def test_floating_point_holds_the_signal_itself_and_must_stay_within_it(tmp_path: Path) -> None:
    write(tmp_path / "a_clean.tif", signal(CLEAN)[0].numpy())
    write(tmp_path / "a_noisy.tif", signal(NOISY)[0].numpy())
    assert torch.equal(PairFolder(tmp_path, cfa="RGGB")[0].clean.mosaic, signal(CLEAN))
    write(tmp_path / "a_clean.tif", CLEAN.astype(np.float32))
    assert "a_clean.tif: has values from" in refused(tmp_path, cfa="RGGB")
    write(tmp_path / "a_clean.tif", np.full((32, 48), np.nan, np.float32))
    assert "has values from nan to nan" in refused(tmp_path, cfa="RGGB")


def test_other_names_go_by_a_pattern(tmp_path: Path) -> None:
    for index in ("010", "011"):
        write(tmp_path / "s1" / f"x_NOISY_{index}.png", NOISY)
        write(tmp_path / "s1" / f"x_CLEAN_{index}.png", CLEAN)
    write(tmp_path / "preview.png", CLEAN)
    pairs = PairFolder(tmp_path, noisy="*_NOISY_*.png", **GIVEN)
    assert pairs.names == ["s1/x_NOISY_010", "s1/x_NOISY_011"] and torch.equal(pairs[1].clean.mosaic, signal(CLEAN))
    assert "preview.png (and 4 others): is neither" in refused(tmp_path)
    assert "same number of * and ?" in refused(tmp_path, noisy="*_NOISY_*.png", clean="*.png")
    assert "does not contain the word noisy" in refused(tmp_path, noisy="*_01?.png")
    (tmp_path / "in").mkdir()
    write(tmp_path / "in" / "n" / "a.png", NOISY)
    write(tmp_path / "in" / "gt" / "a.png", CLEAN)
    assert PairFolder(tmp_path / "in", noisy="n/*.png", clean="gt/*.png", **GIVEN).names == ["n/a"]


def test_a_frame_without_its_partner_is_refused(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", ".png")
    write(tmp_path / "b_noisy.png", NOISY)
    assert "b_noisy.png: has no clean frame" in refused(tmp_path, **GIVEN)
    (tmp_path / "b_noisy.png").rename(tmp_path / "b_clean.png")
    assert "b_clean.png: has no noisy frame" in refused(tmp_path, **GIVEN)
    (tmp_path / "b_clean.png").unlink()
    assert len(open_pairs(f"pairs:{tmp_path}")) == 1
    assert "contains no noisy/clean pair" in refused(tmp_path, noisy="noisy?.png")
    assert "no such folder" in refused(tmp_path / "gone")


def test_what_is_no_mosaic_or_no_pair_is_refused(tmp_path: Path) -> None:
    write_pair(tmp_path, "a", ".png")
    write(tmp_path / "a_clean.png", CLEAN[:-2])
    assert "differ in size, (30, 48) and (32, 48)" in refused(tmp_path, **GIVEN)
    Image.fromarray(NOISY.astype(np.uint8)).save(tmp_path / "a_noisy.png")
    assert "has 8 bits" in refused(tmp_path, **GIVEN)
    write_pair(tmp_path, "a", ".png")
    assert "white level 10 is not above black" in refused(tmp_path, cfa="RGGB", black=64, white=10)
    assert "not a Bayer pattern" in refused(tmp_path, cfa="XYZW")
    assert "2 levels" in refused(tmp_path, black=[1, 2])
    other = tmp_path / "other"
    other.mkdir()
    np.savez(other / "a.npz", noisy=NOISY, clean=CLEAN, cfa="GRBG", black=BLACK, white=500)
    assert "has values from" in refused(other)
    np.savez(other / "a.npz", x=NOISY)
    assert "a.npz: has no array noisy, but x" in refused(other)
    (other / "a.npz").write_bytes(b"PK not an archive")
    assert "a.npz: cannot be read as NPZ" in refused(other)
    (other / "a.npz").unlink()
    (other / "a.mat").write_bytes(b"no")
    assert "a.mat: is not a MATLAB file of version 5 or 7.3" in refused(other)


def test_a_bare_folder_never_takes_a_noisy_frame_for_a_clean_one(tmp_path: Path, bayer_dng: Dng) -> None:
    for kind, numbers in (("noisy", NOISY), ("clean", CLEAN)):
        bayer_dng(tmp_path / f"X_0_{kind}.dng", numbers, black=(BLACK,), white=WHITE)
    for clean in (True, False):
        with pytest.raises(ValueError, match=r"X_0_noisy\.dng: .*X_0_clean"):
            open_pairs(str(tmp_path), as_clean=clean)
    assert main(["evaluate", "rawaug-small", "--data", str(tmp_path)]) == 2
    (tmp_path / "X_0_clean.dng").unlink()
    with pytest.raises(ValueError, match="noisy"):
        open_pairs(str(tmp_path))
    assert len(open_pairs(str(tmp_path), as_clean=False)) == 1  # frames that nothing takes for clean


def test_settings_are_for_pairs_alone(tmp_path: Path, bayer_dng: Dng) -> None:
    bayer_dng(tmp_path / "a.dng", CLEAN)
    for spec in (str(tmp_path), "demo:test"):
        with pytest.raises(ValueError, match="cfa"):
            open_pairs(spec, cfa="RGGB")
    assert len(open_pairs(str(tmp_path), cfa=None)) == 1


def test_the_pairs_of_a_sequence_are_taken_as_they_are() -> None:
    pairs = [Pair("a", RawFrame(torch.zeros(1, 4, 4), CFA.RGGB), torch.zeros(3, 4, 4, dtype=torch.uint8))]
    frames = open_pairs(pairs)
    assert frames.names == ["a"] and frames[0] is pairs[0] and open_pairs(frames) is frames
    for wrong in ([], [1], 5):
        with pytest.raises(ValueError, match=r"list of Pair"):
            open_pairs(wrong)  # type: ignore[arg-type]


def test_data_check_finds_pairs_and_takes_their_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_pair(tmp_path, "a", ".png")
    assert main(["data", "check", f"pairs:{tmp_path}", "--cfa", "GRBG", "--black", "64", "--white", "1023"]) == 0
    said = capsys.readouterr().out
    assert "noisy/clean pairs: 1" in said and "cfas: GRBG (1)" in said and "damaged: none" in said
    (part,) = check(tmp_path).parts  # found by the names; what they lack is listed
    assert part.what == "noisy/clean pairs" and "does not state its CFA" in part.unfit[0]
    assert main(["data", "check", str(tmp_path), "--cfa", "GRBG"]) == 2


def test_damage_by_others_is_a_line_and_the_rest_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")
    for name in ("noisy", "clean"):
        tifffile.imwrite(tmp_path / f"deep_{name}.tif", CLEAN.astype(np.float32), description='{"a":' * 50_000)
    np.savez(tmp_path / "empty.npz", noisy=CLEAN, clean=CLEAN, cfa=np.zeros(0, "U4"))
    (tmp_path / "loop_noisy.tif").symlink_to(tmp_path / "loop_noisy.tif")
    (tmp_path / "loop_clean.tif").symlink_to(tmp_path / "loop_clean.tif")
    np.savez(tmp_path / "whole.npz", noisy=CLEAN, clean=CLEAN, cfa="GRBG", black=BLACK, white=WHITE)
    (part,) = check(tmp_path).parts
    assert part.counts["cfas"] == {"GRBG": 1}
    for said in (
        "deep_noisy.tif: its TIFF tags are damaged (maximum recursion depth",
        "empty.npz: cfa is not valid",
        "loop_noisy.tif",
    ):
        assert sum(said in line for line in part.broken + part.unfit) == 1


@pytest.mark.parametrize("kind", ["npy", "npz"])
def test_packed_numbers_have_their_planes_first_or_last(tmp_path: Path, kind: str) -> None:
    numbers = np.random.default_rng(0).integers(100, 900, (4, 8, 12)).astype(np.uint16)
    for name, planes in (("first", numbers), ("last", np.ascontiguousarray(numbers.transpose(1, 2, 0)))):
        for end in ("noisy", "clean"):
            file = tmp_path / name / f"a_{end}.{kind}"
            file.parent.mkdir(exist_ok=True)
            np.save(file, planes) if kind == "npy" else np.savez(file, planes)
    given: dict[str, Any] = {"cfa": "GRBG", "black": 64, "white": 1023}
    first, last = (open_pairs(f"pairs:{tmp_path / name}", **given)[0] for name in ("first", "last"))
    assert torch.equal(first.clean.mosaic, last.clean.mosaic)
    packed = torch.from_numpy((numbers.astype(np.float32) - 64) / (1023 - 64))
    assert torch.allclose(pack(first.clean.mosaic, CFA.GRBG), packed)
    if kind == "npy":
        (part,) = check(tmp_path / "last").parts
        assert part.what == "noisy/clean pairs", "not an unknown dataset of crops"


def test_npy_never_unpickles_and_says_what_it_declares(tmp_path: Path) -> None:
    for end in ("noisy", "clean"):
        np.save(tmp_path / f"a_{end}.npy", np.array([{}], dtype=object), allow_pickle=True)
        with (tmp_path / f"b_{end}.npy").open("wb") as file:
            header = {"descr": "<f4", "fortran_order": False, "shape": (2**20, 2**20)}
            np.lib.format.write_array_header_1_0(file, header)
    pairs = open_pairs(f"pairs:{tmp_path}", cfa="RGGB", black=64, white=1023)
    for index, message in ((0, "allow_pickle"), (1, "above the limit")):
        with pytest.raises(OSError, match=message):
            pairs[index]


def test_a_kind_that_is_not_read_is_named(tmp_path: Path) -> None:
    for end in ("noisy", "clean"):
        (tmp_path / f"a_{end}.fits").write_bytes(b"SIMPLE")
    with pytest.raises(ValueError, match="fits"):
        open_pairs(f"pairs:{tmp_path}")


@pytest.mark.parametrize("axis", [0, 2])
def test_one_plane_may_have_an_axis_of_its_own_and_a_pattern_may_be_bytes(tmp_path: Path, axis: int) -> None:
    numbers = np.random.default_rng(0).integers(64, 1000, (16, 24), np.uint16)
    noisy = np.expand_dims(numbers, axis)
    np.savez(tmp_path / "a.npz", noisy=noisy, clean=numbers, cfa=b"GRBG", black=64, white=1023)
    pair = open_pairs(f"pairs:{tmp_path}")[0]
    assert pair.cfa == CFA.GRBG and pair.noisy is not None and torch.equal(pair.noisy.mosaic, pair.clean.mosaic)
