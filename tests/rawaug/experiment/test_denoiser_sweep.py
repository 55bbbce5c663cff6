"""Denoisers over noise: every method, every ISO; noise grows with it, and a network that does nothing is the input."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from rawaug.cli import main
from rawaug.experiment.denoiser_sweep import DenoiserSweep, sweep


def test_rows_by_iso_and_an_identity_is_the_noisy_input(tmp_path: Path, identity: Path) -> None:
    settings = DenoiserSweep(
        count=1, crop=64, isos=[400, 25600], denoisers=[str(identity)], classical=["Wavelet"], out=str(tmp_path)
    )
    result = sweep(settings)
    noisy, same, wavelet = (result["rows"][name]["iso"] for name in ("noisy input", "identity", "Wavelet"))
    assert noisy["400"]["psnr"] > noisy["25600"]["psnr"] + 10.0
    assert same["25600"] == pytest.approx(noisy["25600"], abs=1e-4)
    assert wavelet["25600"]["psnr"] > noisy["25600"]["psnr"] + 2.0
    assert json.loads((tmp_path / "denoisers" / "table.json").read_text())["rows"] == result["rows"]
    assert (tmp_path / "denoisers" / "figure.png").stat().st_size > 10_000


def test_the_command_ends_with_table_and_page_and_can_be_tried_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Callable[..., str]
) -> None:
    command = ["run", "denoisers", "--count", "1", "--crop", "64", "--isos", "[400]", "--out", str(tmp_path)]
    assert main([*command, "--dry-run", "--denoisers", "[]"]) == 0
    assert "no problems found" in capsys.readouterr().out and not list(tmp_path.iterdir())
    assert "gone" in refused(*command, "--dry-run", "--denoisers", "[gone]")
    assert main([*command, "--denoisers", "[]"]) == 0
    text = capsys.readouterr().out
    assert "NonLocalMeans" in text and "ISO 400" in text
    assert "ISO 400" in (tmp_path / "denoisers" / "report.html").read_text()


def test_what_cannot_be_run_is_refused() -> None:
    with pytest.raises(ValueError, match="crop is even"):
        DenoiserSweep(crop=33)
    with pytest.raises(ValueError, match="give at least one each"):
        DenoiserSweep(isos=[])
    with pytest.raises(FileNotFoundError, match="gone: no such denoiser"):
        sweep(DenoiserSweep(denoisers=["gone"]))
