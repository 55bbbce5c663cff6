"""Reading apart: what a decoder does to its process ends one file, and the pixels are the same."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from rawaug.data import PictureFolder
from rawaug.io import apart as reading
from rawaug.io import read_picture, write_picture
from rawaug.io.apart import apart, apart_each, prepare, time_limit
from rawaug.io.helper import Helper
from rawaug.io.pictures import decode_picture
from rawaug.io.reading_process import FULL

pytestmark = pytest.mark.skipif(not time_limit(), reason="needs Unix sockets")


def test_values_and_errors_come_back_as_they_are(tmp_path: Path) -> None:
    array = apart(np.arange, 100_000.0)
    assert np.array_equal(array, np.arange(100_000.0)) and array.flags.writeable
    assert apart(np.zeros, (0, 3)).shape == (0, 3)
    assert apart(np.arange, 10)[9] == 9 and array[9] == 9  # the memory of the first answer is not the second's
    path = tmp_path / "a.png"
    write_picture(path, torch.arange(3 * 64 * 80).reshape(3, 64, 80).to(torch.uint8))
    assert torch.equal(apart(read_picture, path), read_picture(path))
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such picture file"):
        apart(read_picture, tmp_path / "none.png")
    with pytest.raises(ValueError, match="above the limit of 100"):
        apart(read_picture, path, 100)


def test_a_relative_path_is_found_after_a_change_of_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        write_picture(Path(f"{name}.png"), torch.zeros(3, 8, 8, dtype=torch.uint8))
        assert apart(read_picture, Path(f"{name}.png")).shape == (3, 8, 8)


def test_a_crash_and_a_hang_end_one_file(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(OSError, match=r"^0: crashes the decoder \(killed by SIGSEGV\)"):
        apart(ctypes.string_at, 0)
    with pytest.raises(OSError, match=r"^3: crashes the decoder \(exited with status 3\)"):
        apart(os._exit, 3)
    assert apart(len, "four") == 4
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0.1")
    with pytest.raises(OSError, match=r"^100: cannot be read within 0\.1 s \(RAWAUG_READ_SECONDS\)"):
        apart(time.sleep, 100)
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "soon")
    with pytest.raises(ValueError, match="RAWAUG_READ_SECONDS=soon: must be a number of seconds"):
        apart(len, "four")
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")
    assert apart(os.getpid) == os.getpid()


def _crash_at_three(number: int, size: int) -> np.ndarray:
    if number == 3:
        ctypes.string_at(0)
    if number == 5:
        raise ValueError("five")
    return np.full(size, number)


@pytest.mark.parametrize("size", [4, FULL // 16])  # of the second, a message holds two
def test_files_by_many_are_those_one_by_one(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def found(numbers: list[int]) -> list[int | str]:
        values = list(apart_each(_crash_at_three, numbers, size))
        return [f"{value}" if isinstance(value, Exception) else int(value[-1]) for value in values]

    assert found([]) == [] and found([1]) == [1]
    assert found([0, 1, 2, 5, 4]) == [0, 1, 2, "five", 4]
    helper = apart(os.getpid)
    assert found(list(range(6)))[:3] == [0, 1, 2] and apart(os.getpid) != helper
    assert "3: crashes the decoder (killed by SIGSEGV)" in str(found([3, 4])[0]) and found([3, 4])[1] == 4
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")
    assert found([0, 5]) == [0, "five"]


def _marked(path: Path) -> np.ndarray:
    path.touch()
    return np.full(1000, int(path.name))


def test_the_next_files_are_read_while_the_caller_works_on_one(tmp_path: Path) -> None:
    values = apart_each(_marked, [tmp_path / f"{k}" for k in range(5)])
    first = next(values)
    _wait_for((tmp_path / "1").exists)
    assert apart(np.arange, 3).tolist() == [0, 1, 2]  # by another helper
    assert not (tmp_path / "4").exists()  # not too far ahead
    assert [int(value[-1]) for value in (first, *values) if isinstance(value, np.ndarray)] == [0, 1, 2, 3, 4]


def test_a_loop_that_is_left_early_leaves_no_answer_behind() -> None:
    for value in apart_each(abs, [4, 5, 6, 7]):
        assert value == 4
        break
    assert apart(len, "four") == 4


def _busy(seconds: float) -> float:
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
    return seconds


def test_a_hang_among_many_is_waited_for_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "_of_this_thread", threading.local())  # whose helper knows no pace yet
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0.3")
    kills, kill = list[Helper](), Helper.kill

    def counted(helper: Helper) -> None:
        kills.append(helper)
        kill(helper)

    monkeypatch.setattr(Helper, "kill", counted)
    values = list(apart_each(_busy, [0.02, 0.03, 60.0, 0.04]))
    assert [value for value in values if isinstance(value, float)] == [0.02, 0.03, 0.04]
    assert "60.0: cannot be read within 0.3 s" in str(values[2]) and len(kills) == 1


def test_as_many_values_as_there_are_leave_the_helper_there() -> None:
    helper = [apart(os.getpid) for _ in range(3)][-1]  # so fast that all calls go in one message
    values = apart_each(np.zeros, [FULL // 8, *range(9)])
    assert [len(next(values)) for _ in range(10)] == [FULL // 8, *range(9)]  # type: ignore[arg-type]
    values.close()  # type: ignore[attr-defined]
    assert apart(os.getpid) == helper


def test_a_helper_that_was_killed_while_it_had_nothing_to_do_is_no_fault_of_the_next_file() -> None:
    os.kill(apart(os.getpid), signal.SIGKILL)
    _wait_for(lambda: not reading._of_this_thread.helper.idle)
    assert apart(len, "four") == 4


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="counts page faults as Linux does")
def test_a_helper_keeps_its_memory_from_picture_to_picture(tmp_path: Path) -> None:
    """Mapping 2.3 MiB anew, twice, would be 1,170 pages, and a quarter of the time of decoding a photograph."""
    write_picture(tmp_path / "a.jpg", torch.zeros(3, 800, 1000, dtype=torch.uint8))

    def faults() -> int:
        return int(Path(f"/proc/{apart(os.getpid)}/stat").read_text().rpartition(")")[2].split()[7])

    picture, *_ = [apart(decode_picture, tmp_path / "a.jpg") for _ in range(3)]
    before = faults()
    for _ in range(10):
        apart(decode_picture, tmp_path / "a.jpg")
    assert (faults() - before) / 10 < 300
    assert picture.is_contiguous() and not decode_picture(tmp_path / "a.jpg").is_contiguous()


def _wait_for(there: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 30
    while not there():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_helper_ends_with_whoever_it_helps() -> None:
    prepare()
    receiving, sending = multiprocessing.Pipe(duplex=False)
    worker = os.fork()
    if not worker:
        sending.send(apart(os.getpid))
        time.sleep(60)
        os._exit(0)
    helper = receiving.recv()
    assert helper not in (worker, os.getpid(), apart(os.getpid))  # each process has its own
    os.kill(worker, signal.SIGKILL)
    os.waitpid(worker, 0)
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        try:
            os.kill(helper, 0)
        except ProcessLookupError:
            return
        time.sleep(0.01)
    pytest.fail("the helper is still there")


def _crash_on_marked(path: Path, max_pixels: int) -> torch.Tensor:
    if path.stem == "2":
        ctypes.string_at(0)
    return read_picture(path, max_pixels)


@pytest.mark.parametrize("batch", [None, 3])
def test_a_folder_names_the_file_that_crashed_in_a_worker_and_goes_on(
    batch: int | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for k in range(4):
        write_picture(tmp_path / f"{k}.png", torch.full((3, 8, 8), k, dtype=torch.uint8))
    monkeypatch.setattr("rawaug.data.folders.decode_picture", _crash_on_marked)
    pictures = PictureFolder(tmp_path, allowed_share=0.5)
    loader = DataLoader(pictures, batch, num_workers=1, multiprocessing_context="fork")
    found = torch.cat([batch_of.reshape(-1, 3, 8, 8) for batch_of in loader])
    assert found[:, 0, 0, 0].tolist() == [0, 1, 3, 3]
    assert [path.name for path in pictures.skipped] == ["2.png"]
    assert "2.png: crashes the decoder (killed by SIGSEGV)" in pictures.report()


def test_where_no_helper_can_start_files_are_read_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "_of_this_thread", threading.local())
    monkeypatch.setattr(reading, "_unavailable", False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    monkeypatch.delenv("RAWAUG_READERS", raising=False)
    prepare()
    with pytest.warns(UserWarning, match="files are read in this process, so a damaged one may crash it"):
        assert apart(os.getpid) == os.getpid()
    assert apart(os.getpid) == os.getpid()  # once is enough
