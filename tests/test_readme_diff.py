"""The change that the README shows: the plain script runs, and runs on RAW with the change; the change is one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def lines_of_the_diff() -> list[tuple[str, str]]:
    """(mark, line) of the README's diff; the mark is a space, - or +."""
    (diff,) = re.findall(r"^```diff\n(.*?)^```", README.read_text(), re.MULTILINE | re.DOTALL)
    return [(line[:1] or " ", line[1:]) for line in diff.splitlines()]


def script(side: str) -> str:
    """The script before (``"-"``) or after (``"+"``) the change."""
    return "\n".join(line for mark, line in lines_of_the_diff() if mark in (" ", side)) + "\n"


@pytest.mark.parametrize(("side", "channels"), [("-", 3), ("+", 4)])
def test_the_script_runs_before_and_after(side: str, channels: int, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(script(side), f"README{side}", "exec"), {"__name__": "__main__"})
    assert re.fullmatch(rf"{channels} channels, loss \d\.\d+\n", capsys.readouterr().out)


def test_the_change_is_an_import_and_one_line() -> None:
    assert "rawaug" not in script("-")
    removed, added = ([line for mark, line in lines_of_the_diff() if mark == side] for side in "-+")
    assert len(removed) == 1
    assert len(added) == 2 and added[0] == "import rawaug"
