"""Damaged files end in one clear line, and a decoder that goes down takes nothing with it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_damaged_files_are_read_or_refused_in_one_line(tmp_path: Path) -> None:
    figures = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks.fuzz", "--quick", "--json", str(figures)]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    kinds = json.loads(figures.read_text())["kinds"]
    assert {"dng", "jpeg", "picture", "mat5", "mat73", "safetensors", "npy", "recipe"} <= set(kinds)
    assert sum(row["mutated"] for row in kinds.values()) == 100
    assert all(row["refused"] for row in kinds.values()) and sum(row["read"] for row in kinds.values()) > 5


@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_a_worker_that_dies_or_hangs_is_named_and_started_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.chdir(ROOT)
    from benchmarks import fuzz

    monkeypatch.setattr(fuzz, "WAITING_SECONDS", 1.0)
    worker, missing = fuzz.Worker(tmp_path), tmp_path / "missing.jpg"
    try:
        for name, outcome, why in (
            ("SIGSEGV", "crashed", "OpenImageIO: SIGSEGV"),
            ("SIGSTOP", "hung", "more than 10 s of a processor, or 1 s in all"),
        ):
            assert worker.read("jpeg", missing) == ("refused", f"{missing}: no such picture file")
            assert worker.process is not None
            os.kill(worker.process.pid, getattr(signal, name))
            found = worker.read("jpeg", missing)
            assert found[0] == outcome and found[1].startswith(why)
    finally:
        worker.stop()
