"""Every Python snippet of the README and of docs/ runs, and the change that the README shows is one line."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]

OPTIONAL = {
    "datasets": "pip install rawaug[test]",
    "pytorch_lightning": "pip install rawaug[test]",
    "ray": "pip install 'ray[data]'",
    "webdataset": "pip install rawaug[test]",
}
"""Libraries that some snippets show rawaug with, and what installs them."""


def snippets() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for number, code in enumerate(re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)):
            found.append((f"{page.name}-{number}", code))
    return found


def imported(code: str) -> set[str]:
    """Top-level names of the libraries that the code imports."""
    nodes = list(ast.walk(ast.parse(code)))
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    names += [node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    return {name.split(".")[0] for name in names}


@pytest.mark.usefixtures("registries")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # WebDataset leaves closing its shards to Python
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore:.*does not have many workers:UserWarning")  # Lightning's advice
@pytest.mark.parametrize(("name", "code"), snippets(), ids=[name for name, _ in snippets()])
def test_snippet_runs(name: str, code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for library in sorted(imported(code) & OPTIONAL.keys()):
        pytest.importorskip(library, reason=f"shows rawaug with {library}: {OPTIONAL[library]}")
    (folder := tmp_path / "pictures").mkdir()  # what a snippet writes beside it is its own, too
    monkeypatch.chdir(folder)
    monkeypatch.setattr("rawaug.isp.fit.pipeline.CURVE_STEPS", 30)
    exec(compile(code, name, "exec"), {"__name__": "__main__"})


def test_optional_libraries_are_those_of_some_snippet() -> None:
    shown = set().union(*(imported(code) for _, code in snippets()))
    assert OPTIONAL.keys() <= shown


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
