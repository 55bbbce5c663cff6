"""Files are whole or the old ones, equal content makes equal files, and what cannot be read is one line."""

from __future__ import annotations

import gc
import json
import os
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
import torch

from rawaug.data.mat import mat_version
from rawaug.experiment.recipe import read_recipe
from rawaug.files import (
    MOST_BYTES,
    WEIGHTS,
    cached,
    digest,
    find_weights,
    fingerprint,
    parse_object,
    read_header,
    read_tensors,
    replacing,
    require_file,
    require_folder,
    require_output,
    sha256,
    write_json,
    write_tensors,
)
from rawaug.io import read_picture, read_raw


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.txt"
    with replacing(path) as partial:
        partial.write_text("old")
    with pytest.raises(OSError, match="disk full"), replacing(path) as partial:
        partial.write_text("half")
        raise OSError("disk full")
    assert path.read_text() == "old" and [file.name for file in path.parent.iterdir()] == ["a.txt"]
    with pytest.raises(TypeError):
        write_json({"a": object()}, path)
    assert path.read_text() == "old"


def test_equal_tensors_make_equal_files(tmp_path: Path) -> None:
    tensors, header = {"b": torch.arange(6.0).reshape(2, 3).T, "a": torch.ones(1)}, {"format": "rawaug", "kind": "x"}
    for k in range(5):
        write_tensors(tensors, dict(sorted(header.items(), reverse=bool(k % 2))), tmp_path / f"{k}.safetensors")
    assert len({sha256(tmp_path / f"{k}.safetensors") for k in range(5)}) == 1
    found, back = read_tensors(tmp_path / "0.safetensors", "")
    assert found == header == read_header(tmp_path / "0.safetensors")
    assert back.keys() == tensors.keys() and all(torch.equal(back[name], tensors[name]) for name in tensors)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs a timer that sends a signal")
def test_ctrl_c_while_weights_load_is_no_damage(tmp_path: Path) -> None:
    """PyTorch loses the interrupt in some places and reports another error, here in four of ten loads."""
    file = tmp_path / "many.safetensors"
    write_tensors({f"t{k}": torch.zeros(2) for k in range(1000)}, {}, file)
    start = time.perf_counter()
    read_tensors(file, "convert it again")
    seconds = time.perf_counter() - start
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    gc.disable()  # an interrupt within a callback of the collector is reported, not raised
    try:
        for k in range(20):
            with suppress(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, (k + 0.5) / 20 * seconds)
                read_tensors(file, "convert it again")
                signal.setitimer(signal.ITIMER_REAL, 0)
    finally:
        gc.enable()
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_weights_are_found_by_name_and_by_path(tmp_path: Path) -> None:
    found = find_weights("universal")
    assert found == WEIGHTS / "universal.safetensors" == find_weights(found)
    with pytest.raises(FileNotFoundError, match=r"nothing.*universal"):
        find_weights("nothing")


def test_hashes() -> None:
    assert digest(b"abc") == digest(b"a", b"bc") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1}) != fingerprint({"a": 2, "b": 1})


def test_what_cannot_be_written_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    require_output(tmp_path / "new" / "folder" / "report.html")
    require_output(tmp_path / "file", overwrite=True)
    require_folder(tmp_path)
    require_folder(tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    with pytest.raises(OSError, match="is a folder; give the name of a file"):
        require_output(tmp_path)
    with pytest.raises(OSError, match="file is not a folder"):
        require_output(tmp_path / "file" / "report.html")
    with pytest.raises(OSError, match="file is not a folder"):
        require_folder(tmp_path / "file")


def test_an_output_replaces_nothing_unasked_and_an_input_never(tmp_path: Path) -> None:
    photograph = tmp_path / "a.png"
    photograph.write_bytes(b"irreplaceable")
    (tmp_path / "link.png").symlink_to(photograph)
    (tmp_path / "copy.png").hardlink_to(photograph)

    with pytest.raises(ValueError, match="exists; give another name, or overwrite=True"):
        require_output(photograph)
    require_output(photograph, overwrite=True)
    for name in ("a.png", "link.png", "copy.png"):
        with pytest.raises(ValueError, match=f"{name}: is the input file"):
            require_output(tmp_path / name, True, inputs=["demo:", photograph])
    with pytest.raises(ValueError, match=r"ends in \.json or \.txt"):
        require_output(photograph, True, (".json", ".txt"))
    with pytest.raises(ValueError, match="empty"):
        require_output("")


def test_the_files_that_lie_beside_an_output_replace_nothing_either(
    tmp_path: Path, refused: Callable[..., str]
) -> None:
    (tmp_path / "page_scores.tex").write_text("a paper's")
    (tmp_path / "mine-noise.png").write_bytes(b"a photograph")
    evaluate = ["evaluate", "rawaug-small", "--data", "demo:test"]
    assert "page_scores.tex: exists" in refused(*evaluate, "--report", tmp_path / "page.html")
    assert "mine-noise.png: exists" in refused("fit", "demo:", "--out", tmp_path / "mine.safetensors")
    assert (tmp_path / "mine-noise.png").read_bytes() == b"a photograph"


def test_two_writers_take_turns_and_what_a_killed_one_left_is_removed(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 251 + ".txt")  # as long as a name can be

    def write_second() -> None:
        with replacing(path) as partial:
            partial.write_text("second")

    other = Thread(target=write_second)
    with replacing(path) as partial:
        other.start()
        partial.write_text("first")
        other.join(0.2)
        assert other.is_alive() and partial.read_text() == "first"
        abandoned = partial.name
    other.join(10)
    assert path.read_text() == "second"
    (tmp_path / abandoned).write_text("half of a file, and the process was killed")
    with pytest.raises(FileNotFoundError), replacing(path) as partial:
        assert partial.name == abandoned and not partial.exists()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_file_has_the_rights_of_the_umask(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_json({}, tmp_path / "a.json")
        write_tensors({"a": torch.ones(1)}, {"format": "rawaug"}, tmp_path / "a.safetensors")
    finally:
        os.umask(before)
    assert [file.stat().st_mode & 0o777 for file in tmp_path.iterdir()] == [0o640] * 2


def test_numbers_of_others_are_finite_and_ours_are_written_so(tmp_path: Path) -> None:
    write_json({"psnr": [float("nan"), 1.0], "more": {"a": float("inf")}}, tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text()) == {"psnr": [None, 1.0], "more": {"a": None}}
    for text, reason in (
        ('{"a": NaN}', "NaN is not a finite number"),
        ('{"a": -1e400}', "-1e400 is not"),
        ('{"a":' * 100_000, "too deeply nested"),
        ("[1]", "must be a JSON object, got list"),
        ("{", "not JSON"),
    ):
        with pytest.raises(ValueError, match=reason):
            parse_object(text)


def test_what_cannot_be_read_is_named_with_what_to_do(tmp_path: Path) -> None:
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"not weights")
    with pytest.raises(ValueError, match=r"bad\.safetensors: .*safetensors"):
        read_tensors(bad, "copy it again")
    with pytest.raises(ValueError, match=r"bad\.safetensors"):
        read_header(bad)
    for header in ({"format": "other", "kind": "x"}, {"format": "rawaug"}):
        write_tensors({"a": torch.ones(1)}, header, bad)
        with pytest.raises(ValueError, match="not a rawaug file"):
            read_header(bad)
    write_tensors({"a": torch.tensor([1.0, torch.nan])}, {"format": "rawaug", "kind": "x"}, bad)
    with pytest.raises(ValueError, match="tensor"):
        read_tensors(bad, "copy it again")


@pytest.mark.parametrize("kind", ["fifo", "endless", "itself", "folder", "large"])
def test_only_regular_files_of_bounded_size_are_read(kind: str, tmp_path: Path) -> None:
    """A pipe is not waited for, and a device not read without end."""
    path = tmp_path / "a.png"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "large":
        path.touch()
        os.truncate(path, MOST_BYTES + 1)
    else:
        path.symlink_to("/dev/zero" if kind == "endless" else path)
    for read in (require_file, sha256, read_picture, read_raw, mat_version, read_recipe):
        with pytest.raises(OSError, match=r"a\.png: (is a pipe|cannot be opened|has \d+ bytes)"):
            read(path)


def test_what_was_made_of_the_same_inputs_is_not_made_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "deep" / "figures.json"
    made: list[Any] = []

    def figures(inputs: Any) -> dict[str, Any]:
        def make() -> dict[str, Any]:
            made.append(inputs)
            return {"psnr": float(len(made))}

        return cached(path, inputs, make, done="already measured")

    assert figures({"seed": 0}) == figures({"seed": 0}) == {"psnr": 1.0}
    assert capsys.readouterr().out == f"already measured: {path}\n"
    assert figures({"seed": 1}) == {"psnr": 2.0} and figures({"seed": 0}) == {"psnr": 3.0}
    for damaged in ("", "[1]", '{"psnr": 9.0}', '{"key": '):  # of another version, or cut short
        path.write_text(damaged)
        assert figures({"seed": 0})["psnr"] == float(len(made))
    assert len(made) == 7
