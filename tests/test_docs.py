"""Every Python snippet of the README and of the pages in docs/ runs."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

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
    monkeypatch.chdir(tmp_path)
    exec(compile(code, name, "exec"), {"__name__": "__main__"})


def test_optional_libraries_are_those_of_some_snippet() -> None:
    shown = set().union(*(imported(code) for _, code in snippets()))
    assert OPTIONAL.keys() <= shown
