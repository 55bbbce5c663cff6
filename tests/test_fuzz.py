"""Damaged files end in one clear line, and a decoder that goes down takes nothing with it."""

from __future__ import annotations

import json
import os
import signal
from functools import partial
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
    assert {"dng", "picture", "mat5", "mat73", "safetensors", "npy", "pair", "recipe"} <= set(kinds)
    assert sum(row["mutated"] for row in kinds.values()) == 40
    assert all(row["refused"] for row in kinds.values()) and sum(row["read"] for row in kinds.values()) > 2


@pytest.mark.long
def test_a_crash_and_a_hang_of_a_reader_are_told_apart(
    fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = tmp_path / "missing.jpg"
    assert fuzz.judged("picture", missing) == ("refused", f"{missing}: no such picture file")
    for name, outcome in (("SIGSEGV", "crashed"), ("SIGXCPU", "hung")):
        monkeypatch.setattr(fuzz, "attempt", partial(killed, getattr(signal, name)))
        found = fuzz.judged("picture", missing)
        assert found[0] == outcome and name in found[1] and "missing.jpg" in found[1]


def killed(number: int, path: Path, kind: str) -> None:
    os.kill(os.getpid(), number)
