"""The check of dependencies: what it asks, what it says, and that it passes where there is no network."""

from __future__ import annotations

import importlib.util
import io
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def check() -> ModuleType:
    spec = importlib.util.spec_from_file_location("advisories", ROOT / ".ci" / "advisories.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_advisory_fails_the_check(
    check: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[Any] = []

    def answer(request: Any, timeout: float) -> io.BytesIO:
        asked.extend(json.loads(request.data)["queries"])
        return io.BytesIO(json.dumps({"results": [{}, {"vulns": [{"id": "GHSA-1"}]}]}).encode())

    monkeypatch.setattr(check.urllib.request, "urlopen", answer)
    pins = tmp_path / "constraints.txt"
    pins.write_text('# pins\nabsl-py==2.5.1\ncontourpy==1.3.3; python_version >= "3.11"\n')
    assert check.main([str(pins)]) == 1
    assert [(q["package"]["name"], q["version"]) for q in asked] == [("absl-py", "2.5.1"), ("contourpy", "1.3.3")]
    assert capsys.readouterr().out.startswith("contourpy 1.3.3: GHSA-1\n")


def test_without_a_network_it_says_so_in_one_line(
    check: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unreachable(request: Any, timeout: float) -> None:
        raise OSError("no route")

    monkeypatch.setattr(check.urllib.request, "urlopen", unreachable)
    assert check.main([str(ROOT / "constraints.txt")]) == 0
    out = capsys.readouterr().out
    assert "not checked" in out and out.count("\n") == 1
