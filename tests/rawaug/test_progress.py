"""Progress: nothing of what is quick, a line now and then of what is slow, a bar in a terminal."""

from __future__ import annotations

import io
import time

import pytest

from rawaug.progress import hide_progress, progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_what_is_quick_leaves_no_line_in_a_log() -> None:
    log = io.StringIO()
    assert list(progress(range(2000), label="train", unit="step", stream=log)) == list(range(2000))
    assert log.getvalue() == ""


def test_a_log_gets_a_plain_line_per_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAWAUG_PROGRESS_SECONDS", "0.05")
    log = io.StringIO()
    bar = progress(range(200), label="train", unit="step", stream=log)
    began = time.perf_counter()
    for step in bar:
        time.sleep(0.001)
        bar.set_postfix_str(f"loss {step}", refresh=False)
    lines = log.getvalue().splitlines()
    assert 2 <= len(lines) <= (time.perf_counter() - began) / 0.05 + 1
    assert all(line.startswith("train: ") and "/200 steps, " in line and ", loss " in line for line in lines)
    assert lines[-1].startswith("train: 200/200 steps")
    assert not {"\r", "\x1b"} & set(log.getvalue())


def test_a_terminal_gets_a_bar_and_keeps_it_if_asked() -> None:
    for leave in (True, False):
        screen = Terminal()
        list(progress(range(3), label="denoise", unit="file", leave=leave, stream=screen))
        assert screen.getvalue().startswith("\rdenoise:   0%|")
        assert (screen.getvalue()[-1] == "\r") != leave


def test_what_is_nested_has_lines_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAWAUG_PROGRESS_SECONDS", "0.02")
    log = io.StringIO()
    for _ in progress(range(3), label="evaluate", unit="image", stream=log):
        for _ in progress(range(20), label="frame", unit="tile", stream=log):
            time.sleep(0.002)
    lines = log.getvalue().splitlines()
    assert any(line.startswith("frame: ") for line in lines) and lines[-1].startswith("evaluate: 3/3 images")


def test_what_is_quiet_or_not_shown_prints_nothing() -> None:
    screen = Terminal()
    list(progress(range(3), label="read", unit="frame", shown=False, stream=screen))
    with hide_progress():
        bar = progress(range(3), label="train", unit="step", stream=screen)
        bar.set_postfix_str("loss 1", refresh=False)
        assert list(bar) == [0, 1, 2]
    with hide_progress(False):
        assert list(progress(range(3), label="train", unit="step", stream=screen)) == [0, 1, 2]
    assert screen.getvalue().count("train:   0%") == 1
