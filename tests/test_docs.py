"""Every Python snippet of the README and of docs/ runs, every link leads somewhere, and the README changes one line."""

from __future__ import annotations

import ast
import re
import runpy
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


CARDS = runpy.run_path(str(ROOT / ".ci" / "cards.py"))["pages"]()
DOCUMENTS = [
    *ROOT.glob("*.md"),
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "rawaug").rglob("*.md"),
    *(ROOT / "denoisers").rglob("*.md"),
]


def anchors(document: Path) -> set[str]:
    """The anchors of the headings of a page."""
    text = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    slugs = set()
    for heading in re.findall(r"^#+ +(.+)$", text, re.MULTILINE):
        words = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading)
        words = re.sub(r"[^\w\s-]", "", words.lower()).strip()
        slugs.add(re.sub(r"\s+", "-", words))
    return slugs


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda document: document.relative_to(ROOT).as_posix())
def test_every_relative_link_leads_somewhere(document: Path) -> None:
    text = re.sub(r"^```.*?^```", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"https?://|mailto:", link):
            continue
        place, _, anchor = link.partition("#")
        target = (document.parent / place).resolve() if place else document
        assert target.exists(), f"{document.name}: {link} leads nowhere"
        if anchor and target.parent.name == "cards":
            target = ROOT / re.findall(r'"(.*)"', target.read_text(encoding="utf-8"))[0]
        if anchor and target.suffix == ".md":
            assert anchor in anchors(target), f"{document.name}: {link} has no such heading"


def test_every_card_is_a_page_of_the_site() -> None:
    pages = {page.name: page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "cards").glob("*.md")}
    assert pages == CARDS, "run python .ci/cards.py"
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for page in [*pages, *(page.name for page in (ROOT / "docs").glob("*.md"))]:
        assert re.search(rf"[ /]{re.escape(page)}$", navigation, re.MULTILINE), f"mkdocs.yml does not list {page}"
