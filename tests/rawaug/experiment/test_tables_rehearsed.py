"""``--dry-run`` of a sweep of denoisers: what it says, what it finds, and that it writes nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rawaug.cli import main
from rawaug.experiment.denoiser_sweep import DenoiserSweep
from rawaug.experiment.tables_rehearsed import rehearse_sweep


def test_a_sweep_tries_every_denoiser(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = DenoiserSweep(data=["demo:test"], count=2, crop=32, denoisers=[], isos=[100, 800], out=str(tmp_path))
    rehearse_sweep(settings)
    said = capsys.readouterr().out
    assert "2 of 2 of demo:test" in said and "noise     Sony ILCE-7M3 at ISO 100, 800" in said
    assert "noisy input, NonLocalMeans" in said and not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="ISO 1 "):
        rehearse_sweep(replace(settings, isos=[1]))


def test_the_command_line_asks_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = [
        "run",
        "denoisers",
        "--dry-run",
        "--out",
        str(tmp_path),
        "--isos",
        "[100]",
        "--crop",
        "32",
        "--count",
        "1",
    ]
    assert main([*command, "--denoisers", "[]"]) == 0
    assert "nothing wrong found" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert main([*command, "--denoisers", "[gone]"]) == 2
    assert "gone" in capsys.readouterr().err
