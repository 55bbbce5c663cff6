"""``--dry-run`` of comparisons, ablations and sweeps: what it says, what it finds, and that it writes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rawaug.cli import main
from rawaug.data.pairs import Pair
from rawaug.experiment import tables_rehearsed
from rawaug.experiment.denoiser_sweep import DenoiserSweep
from rawaug.experiment.tables_rehearsed import (
    rehearse_ablation,
    rehearse_comparison,
    rehearse_learned,
    rehearse_sweep,
)
from rawaug.isp.fit import FitConfig
from rawaug.paper import ablation, reconstruction
from rawaug.paper.ablation import Ablation
from rawaug.paper.component_ablation import LearnedParts
from rawaug.paper.downstream import DownstreamConfig
from rawaug.paper.reconstruction import Comparison

FrameOf = Callable[..., Pair]


@pytest.fixture
def frames(frame_of: FrameOf, monkeypatch: pytest.MonkeyPatch) -> list[Pair]:
    """Three frames, which every dataset consists of but the demo's."""
    made = [frame_of(name) for name in "abc"]
    for module in (reconstruction, ablation, tables_rehearsed):
        monkeypatch.setattr(module, "open_pairs", lambda spec, split: made)
    return made


def test_a_comparison_tries_every_method_and_writes_nothing(
    frames: list[Pair], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    downstream = DownstreamConfig(methods=["upi"]).smoke()
    comparison = Comparison(data="mine", methods=["upi", "upi-tuned"], downstream=downstream, out=str(tmp_path))
    rehearse_comparison(comparison)
    said = capsys.readouterr().out
    assert "data      3 of 3 of mine: a, b, c" in said and "methods   upi, upi-tuned" in said
    assert "frames read: 3 of 3" in said and "nothing wrong found" in said and not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="b has a different CFA"):
        frames[1] = frames[1].in_pattern("RGGB")
        rehearse_comparison(comparison)


def test_a_comparison_reads_only_what_time_allows(frames: list[Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(reconstruction.PreparedComparison(Comparison(data="mine"), seconds=0.0).pairs) == 2
    with pytest.raises(ValueError, match="test: a is also in data"):
        rehearse_comparison(Comparison(data="mine", test="theirs"))


def test_an_ablation_leaves_a_frame_and_every_stage_out(
    frames: list[Pair], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = Ablation(data="mine", out=str(tmp_path))
    rehearse_ablation(settings)
    assert "every stage left out once; frames read: 3 of 3" in capsys.readouterr().out and not list(tmp_path.iterdir())
    del frames[1:]
    with pytest.raises(ValueError, match="mine has 1 frame; leave-one-out needs two or more"):
        rehearse_ablation(settings)


def test_every_variant_of_the_learned_parts_is_fitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fitted: list[tuple[str, int, int]] = []

    def scores(place: Path, config: FitConfig, frames: list[Pair], left_out: list[Pair]) -> None:
        fitted.append((config.encoders, len(frames), len(left_out)))

    monkeypatch.setattr(tables_rehearsed, "variant_scores", scores)
    variants: dict[str, dict[str, Any]] = {"all parts": {}, "without encoders": {"encoders": "off"}}
    settings = LearnedParts(frames=3, left_out=2, variants=variants, out=str(tmp_path))
    rehearse_learned(settings)
    assert fitted == [("on", 2, 1), ("off", 2, 1)] and not list(tmp_path.iterdir())
    assert "variants  all parts, without encoders" in capsys.readouterr().out
    with pytest.raises(ValueError, match="give a larger folder or smaller numbers"):
        rehearse_learned(replace(settings, frames=1000))


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
