"""Damaged files end in one clear line, and a decoder that goes down takes nothing with it."""

from __future__ import annotations

import json
import os
import signal
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def fuzz(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.chdir(ROOT)
    return import_module("benchmarks.fuzz")


@pytest.mark.long
def test_damaged_files_are_read_or_refused_in_one_line(
    fuzz: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    figures = tmp_path / "figures.json"
    assert fuzz.main(["--quick", "--json", str(figures)]) == 0, capsys.readouterr().out
    kinds = json.loads(figures.read_text())["kinds"]
    assert {"dng", "jpeg", "picture", "mat5", "mat73", "safetensors", "npy", "recipe"} <= set(kinds)
    assert sum(row["mutated"] for row in kinds.values()) == 100
    assert all(row["refused"] for row in kinds.values()) and sum(row["read"] for row in kinds.values()) > 5


@pytest.mark.long
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_a_worker_that_dies_or_hangs_is_named_and_started_anew(fuzz: ModuleType, tmp_path: Path) -> None:
    worker, missing = fuzz.Worker(tmp_path, seconds=1.0), tmp_path / "missing.jpg"
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
