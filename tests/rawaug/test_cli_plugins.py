"""Commands of other packages: broken ones and those that are called like ours take nothing else down."""

from __future__ import annotations

from pathlib import Path

import pytest

from rawaug.cli import app, main

PLUGINS = {
    "unparsed": "def run(:\n",
    "raises": "raise RuntimeError('boom')\n",
    "exits": "import sys; sys.exit(7)\n",
    "denoise": "def run(x: str, /):\n    '''Not ours.'''\n    print('taken over')\n",
    "x y": "def run():\n    '''Blank.'''\n",
    "": "def run():\n    '''No name.'''\n",
    "sound": "def run():\n    '''Say hello.'''\n    print('hello')\n",
}


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = ["[rawaug.commands]"]
    for number, (name, code) in enumerate(PLUGINS.items()):
        (tmp_path / f"abroad{number}.py").write_text(code)
        points.append(f"{name} = abroad{number}:run")
    metadata = tmp_path / "abroad-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: abroad\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("\n".join(points))
    monkeypatch.syspath_prepend(str(tmp_path))


@pytest.mark.usefixtures("installed")
def test_broken_commands_are_named_and_the_others_work(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    help_text, errors = capsys.readouterr()
    assert "Say hello." in help_text and "Denoise a RAW file" in help_text
    for word in ("unparsed", "boom", "exits", "'denoise'", "'x y'"):
        assert word in errors, word
    assert all(line.startswith("rawaug: ") for line in errors.splitlines())

    assert main(["info", "cameras", "Nikon D5000"]) == 0
    assert capsys.readouterr().err == ""
    for name in ("unparsed", "raises", "exits"):
        assert main([name]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert main(["denoise"]) == 2
    assert "taken over" not in capsys.readouterr().out
    assert main(["sound"]) == 0 and capsys.readouterr().out == "hello\n"
    del app["sound"]
