"""What runs beside the tests: the check of dependencies, with and without a network, and what a release shows."""

from __future__ import annotations

import importlib.util
import json
import re
import socket
import threading
from configparser import ConfigParser
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def check() -> ModuleType:
    return script("advisories")


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


def test_a_package_index_gets_absolute_links_and_urls() -> None:
    release, url = script("release"), "https://host/owner/name"
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    places = re.findall(r"\]\(([^)]+)\)", release.absolute(readme, url))
    assert len(places) > 10 and all(place.startswith(("https://", "#")) for place in places)
    for place in re.findall(r"\]\((?!http|#)([^)]+)\)", readme):
        assert (ROOT / place).is_file(), f"README.md: {place} is not there"
    setup = ConfigParser()
    setup.read_string(release.with_urls((ROOT / "setup.cfg").read_text(encoding="utf-8"), url))
    assert f"Homepage = {url}" in setup["metadata"]["project_urls"] and setup["metadata"]["name"] == "rawaug"
