"""A decoder that crashes or hangs ends one file, and what it reads is the same."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from rawaug.io import read_picture, write_picture
from rawaug.io.isolated import isolated, time_limit


def test_values_and_errors_come_back_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert isolated(os.getpid) != os.getpid()
    assert np.array_equal(isolated(np.arange, 100_000.0), np.arange(100_000.0))
    path = tmp_path / "a.png"
    write_picture(path, torch.arange(3 * 64 * 80).reshape(3, 64, 80).to(torch.uint8))
    assert torch.equal(isolated(read_picture, path), read_picture(path))
    with pytest.raises(FileNotFoundError, match=r"none\.png:"):
        isolated(read_picture, tmp_path / "none.png")
    monkeypatch.chdir(tmp_path)
    assert isolated(read_picture, Path("a.png")).shape == (3, 64, 80)


def test_a_crash_and_a_hang_end_one_file(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OSError, match=r"^0: .*SIGSEGV"):
        isolated(ctypes.string_at, 0)
    with pytest.raises(OSError, match=r"^b\.mat: .*EXIT"):
        isolated(os._exit, 3, name="b.mat")
    assert isolated(len, "four") == 4
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0.5")
    with pytest.raises(OSError, match=r"^100: .*RAWAUG_READ_SECONDS"):
        isolated(time.sleep, 100)
    assert "Traceback" not in capfd.readouterr().err
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "soon")
    with pytest.raises(ValueError, match="RAWAUG_READ_SECONDS"):
        time_limit()


def _sent(sending: object) -> None:
    sending.send((isolated(os.getpid), os.getpid()))  # type: ignore[attr-defined]


def test_a_worker_and_a_limit_of_0_read_in_the_same_process(monkeypatch: pytest.MonkeyPatch) -> None:
    receiving, sending = multiprocessing.Pipe(duplex=False)
    worker = multiprocessing.get_context("fork").Process(target=_sent, args=(sending,), daemon=True)
    worker.start()
    helper, own = receiving.recv()
    worker.join()
    assert helper == own != os.getpid()
    monkeypatch.setenv("RAWAUG_READ_SECONDS", "0")
    assert isolated(os.getpid) == os.getpid()


def test_a_script_without_a_guard_runs_once(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("import os\nfrom rawaug.io.isolated import isolated\nprint(isolated(os.getpid) != os.getpid())")
    run = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=300, check=True)
    assert run.stdout == "True\n"
