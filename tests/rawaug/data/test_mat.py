from __future__ import annotations

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from rawaug.data.mat import MAX_BYTES, mat_version, read_array, read_value

Writer = Callable[[Path, dict[str, Any]], Path]
ARRAY = np.random.default_rng(0).random((3, 4, 5)).astype(np.float32)


@pytest.fixture(params=["5", "7.3"])
def written(request: pytest.FixtureRequest, tmp_path: Path, mat73: Writer) -> Callable[[dict[str, Any]], Path]:
    """The same variables in either version."""

    def write(variables: dict[str, Any]) -> Path:
        path = tmp_path / "a.mat"
        if request.param == "7.3":
            return mat73(path, variables)
        cells = {
            k: np.array(v, object) if isinstance(v, list) and not isinstance(v[0], dict) else v
            for k, v in variables.items()
        }
        savemat(path, cells, do_compression=True)
        return path

    return write


def test_the_version_is_that_of_the_header(tmp_path: Path, mat73: Writer) -> None:
    savemat(tmp_path / "old.mat", {"x": 1.0})
    savemat(tmp_path / "older.mat", {"x": 1.0}, format="4")
    mat73(tmp_path / "new.mat", {"x": 1.0})
    assert mat_version(tmp_path / "old.mat") == "5" and mat_version(tmp_path / "new.mat") == "7.3"
    with pytest.raises(ValueError, match=r"older\.mat: .*MATLAB"):
        mat_version(tmp_path / "older.mat")
    (tmp_path / "empty.mat").touch()
    with pytest.raises(ValueError, match=r"empty\.mat: .*MATLAB"):
        mat_version(tmp_path / "empty.mat")
    with pytest.raises(FileNotFoundError, match=r"none\.mat: .*MATLAB"):
        mat_version(tmp_path / "none.mat")


def test_arrays_keep_matlabs_axes_and_type_through_the_helper(
    written: Callable[[dict[str, Any]], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "60")
    array = read_array(written({"x": ARRAY, "y": np.arange(6).reshape(2, 3)}), "x")
    assert array.dtype == np.float32 and np.array_equal(array, ARRAY)
    assert array.flags["C_CONTIGUOUS"] or array.flags["F_CONTIGUOUS"]


def test_structs_cells_and_text_become_plain(written: Callable[[dict[str, Any]], Path]) -> None:
    shots: list[dict[str, Any]] = [
        {"box": np.arange(8.0).reshape(2, 4) + k, "nlf": {"a": 0.1 * k, "b": 2.0}} for k in range(3)
    ]
    path = written({"s": {"Make": "LGE", "wb": np.array([[0.5, 1.0, 0.6]])}, "shots": shots, "c": [ARRAY[0], ARRAY[1]]})
    plain = read_value(path, "s")
    assert plain["Make"] == "LGE" and np.allclose(plain["wb"], [0.5, 1, 0.6])
    elements = read_value(path, "shots")
    assert [float(shot["nlf"]["a"]) for shot in elements] == pytest.approx([0, 0.1, 0.2])
    assert np.array_equal(elements[2]["box"], shots[2]["box"])
    assert all(np.array_equal(a, b) for a, b in zip(read_value(path, "c"), ARRAY[:2], strict=True))


def test_what_is_not_there_is_reported_with_what_is(written: Callable[[dict[str, Any]], Path]) -> None:
    path = written({"x": ARRAY, "s": {"a": 1.0}})
    with pytest.raises(ValueError, match=r"a\.mat.*variable y"):
        read_array(path, "y")
    with pytest.raises((ValueError, OSError), match=r"a\.mat: "):
        read_array(path, "s")


@pytest.mark.parametrize("share", [0.2, 0.6, 0.95])
def test_a_file_cut_short_is_one_line(written: Callable[[dict[str, Any]], Path], share: float) -> None:
    path = written({"x": np.random.default_rng(0).random((64, 64))})
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(OSError, match=r"a\.mat: .*MATLAB") as caught:
        read_array(path, "x")
    assert "\n" not in str(caught.value)


def _crash(path: Path, name: str, plain: bool) -> None:
    ctypes.string_at(0)


def test_a_reader_that_crashes_is_contained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    savemat(tmp_path / "a.mat", {"x": ARRAY})
    monkeypatch.setattr("rawaug.data.mat._read", _crash)
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "60")
    with pytest.raises(OSError, match=r"a\.mat: .*SIGSEGV"):
        read_array(tmp_path / "a.mat", "x")


def test_variables_beyond_reason_and_in_other_files_are_refused(tmp_path: Path, mat73: Writer) -> None:
    secret = mat73(tmp_path / "secret.mat", {"x": ARRAY})
    path = mat73(tmp_path / "a.mat", {"y": ARRAY})
    with h5py.File(path, "a") as file:
        file.create_dataset("huge", (2**20, 2**20), np.float64, chunks=(64, 64))  # takes no room in the file
        file["elsewhere"] = h5py.ExternalLink(str(secret), "x")
        file.create_dataset("outside", (4,), np.uint8, external=[(str(secret), 0, 4)])
        file.create_group("struct")["elsewhere"] = h5py.SoftLink("/elsewhere")
    with pytest.raises(OSError, match=f"huge declares {2**43} bytes, above the limit of {MAX_BYTES}"):
        read_array(path, "huge")
    for name in ("elsewhere", "struct"):
        with pytest.raises(OSError, match=r"a\.mat: .*elsewhere"):
            read_value(path, name)
    with pytest.raises(OSError, match="outside"):
        read_array(path, "outside")
