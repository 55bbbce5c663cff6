"""The check of dependencies: what it asks, what it says, and that it passes where there is no network."""

from __future__ import annotations

import importlib.util
import json
import socket
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
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


def test_an_advisory_fails_the_check(check: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[Any] = []

    class Database(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            asked.extend(json.loads(self.rfile.read(int(self.headers["Content-Length"])))["queries"])
            self.send_response(200)
            self.end_headers()
            self.wfile.write(json.dumps({"results": [{}, {"vulns": [{"id": "GHSA-1"}]}]}).encode())

        def log_message(self, *_: Any) -> None:
            """Nothing on stderr."""

    pins = tmp_path / "constraints.txt"
    pins.write_text('# pins\nabsl-py==2.5.1\ncontourpy==1.3.3; python_version >= "3.11"\n')
    with HTTPServer(("127.0.0.1", 0), Database) as server:
        answering = threading.Thread(target=server.handle_request)
        answering.start()
        assert check.main([str(pins)], f"http://127.0.0.1:{server.server_port}") == 1
        answering.join()
    assert [(q["package"]["name"], q["version"]) for q in asked] == [("absl-py", "2.5.1"), ("contourpy", "1.3.3")]
    assert capsys.readouterr().out.startswith("contourpy 1.3.3: GHSA-1\n")


def test_without_a_network_it_says_so_in_one_line(check: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as nobody:  # bound, and not listened on
        nobody.bind(("127.0.0.1", 0))
        assert check.main([str(ROOT / "constraints.txt")], f"http://127.0.0.1:{nobody.getsockname()[1]}") == 0
    out = capsys.readouterr().out
    assert "not checked" in out and out.count("\n") == 1
