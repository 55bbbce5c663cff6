"""The page of ``rawaug explore``, served by a process of its own."""

from __future__ import annotations

import importlib.util
import multiprocessing
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from rawaug.data import demo_pictures
from rawaug.io import write_picture


@pytest.fixture(scope="session")
def pictures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of two small pictures, and a broken one beside it."""
    folder = tmp_path_factory.mktemp("explore")
    (folder / "in").mkdir()
    for k, name in enumerate(("a.png", "b.png")):
        write_picture(folder / "in" / name, demo_pictures(2)[k][:, 100:164, 120:216])
    write_picture(folder / "own.png", demo_pictures(1)[0][:, :32, :48])
    (folder / "broken.png").write_bytes(b"no picture")
    return folder


SERVE = """
import sys
from rawaug.cli import main
sys.stdout = open(out.fileno(), "w", closefd=False)
raise SystemExit(main(["explore", folder, "--port", "0"]))
"""


@pytest.fixture(scope="session")
def served(pictures: Path) -> Iterator[str]:
    """The address of the page, in a process of its own: Gradio leaves event loops and sockets to Python."""
    if importlib.util.find_spec("gradio") is None:
        pytest.skip("gradio is not installed: pip install 'rawaug[explore]'")
    said, out = multiprocessing.Pipe(duplex=False)
    variables = {"folder": str(pictures / "in"), "out": out}
    process = multiprocessing.get_context("forkserver").Process(target=exec, args=(SERVE, variables))
    process.start()
    out.close()
    assert process.pid is not None
    try:
        with open(said.fileno(), closefd=False) as lines:
            address, _, hint = lines.readline().partition(" ")
            assert "Ctrl-C" in hint
            yield address
            os.kill(process.pid, signal.SIGINT)
            process.join(60)
            assert process.exitcode == 0
    finally:
        process.kill()
