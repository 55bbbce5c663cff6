"""The command line: each command on small input, and one line for each kind of bad input."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rawaug.cli import main
from rawaug.data import demo_pictures
from rawaug.io import write_picture

QUICK_FIT = ["--steps", "4", "--pixels", "512", "--batch", "128"]
QUICK_RUN = [
    "--train.steps", "4", "--train.validate-every", "2", "--train.batch", "2", "--train.crop", "32", "--isp.steps", "2",
    "--isp.pixels", "512", "--denoiser.settings", '{"width": 4, "scales": 2}',
    "--data.test-count", "2", "--classical", "[]",
]  # fmt: skip


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line on stderr with which ``arguments`` are refused."""
    assert main(arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1, lines
    return lines[0]


def test_fit_evaluate_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    weights, scores = str(tmp_path / "isp.safetensors"), tmp_path / "isp.json"
    assert main(["fit", "demo:train", "--out", weights, *QUICK_FIT]) == 0
    assert main(["evaluate", weights, "--data", "demo:validation", "--json", str(scores)]) == 0
    assert json.loads(scores.read_text())["kind"] == "isp"
    capsys.readouterr()
    assert main(["info", weights]) == 0
    text = capsys.readouterr().out
    assert "colour atoms" in text and "train_00_astronaut" in text


def test_preview_draws_two_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "picture.png"
    write_picture(picture, demo_pictures(3)[2])
    assert main(["preview", str(picture), "--out", str(tmp_path / "stages.png"), "--count", "2"]) == 0
    for name in ("stages.png", "stages-atoms.png"):
        assert (tmp_path / name).stat().st_size > 10_000
    assert "gone.png" in refused(capsys, "preview", str(tmp_path / "gone.png"), "--out", str(tmp_path / "x.png"))


def test_run_is_resumable_and_ends_with_table_and_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["run", "fewshot", *QUICK_RUN, "--out", str(tmp_path)]
    assert main(command) == 0
    text = capsys.readouterr().out
    assert "augmented" in text and "picture.png" in text
    results = json.loads((tmp_path / "fewshot" / "results.json").read_text())
    assert set(results["results"]) == {"real", "augmented", "finetuned", "finetuned_augmented"}
    assert (tmp_path / "fewshot" / "picture.png").stat().st_size > 10_000
    weights = tmp_path / "fewshot" / "seed0" / "real" / "denoiser.safetensors"
    before = weights.stat().st_mtime_ns
    assert main(command) == 0
    assert "already trained" in capsys.readouterr().out
    assert weights.stat().st_mtime_ns == before
    assert main([*command, "--train.learning-rate", "0.002"]) == 0
    assert weights.stat().st_mtime_ns != before  # other settings are another run
    assert main(["evaluate", str(weights), "--data", "demo:validation", "--self-ensemble"]) == 0


def test_test_frames_must_be_unseen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["run", "fewshot", *QUICK_RUN, "--out", str(tmp_path), "--data.test", "demo:train"]
    assert "train_00_astronaut is also in data.pairs" in refused(capsys, *arguments)


def test_bad_input_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], bayer_dng: Callable[..., Path]
) -> None:
    out = ["--out", str(tmp_path / "x.safetensors")]
    assert "nowhere" in refused(capsys, "fit", str(tmp_path / "nowhere"), *out)
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no RAW file" in refused(capsys, "fit", str(empty), *out)
    assert "bogus" in refused(capsys, "fit", "demo:train", *out, "--bogus", "1")
    assert "bogus" in refused(capsys, "fit", "bogus:x", *out)
    assert ".safetensors" in refused(capsys, "fit", "demo:train", "--out", str(tmp_path / "x.pt"))
    assert "no such recipe" in refused(capsys, "run", "nothing")
    assert "atoms" in refused(capsys, "run", "fewshot", "--isp.atoms", "many")
    assert "no picture" in refused(
        capsys, "run", "fewshot", *QUICK_RUN, "--out", str(tmp_path), "--data.pictures", str(empty)
    )
    whole = bayer_dng(tmp_path / "cut.dng", np.full((64, 64), 500, np.uint16))
    whole.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert "cut.dng" in refused(capsys, "fit", str(whole), *out)


def test_an_unknown_key_in_a_recipe_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("name: mine\ntrain: {stepz: 3}\narms: {real: {}}\n")
    assert "stepz" in refused(capsys, "run", str(recipe))


def test_weights_of_no_use_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(b"not weights")
    assert "bad.safetensors" in refused(capsys, "evaluate", str(bad), "--data", "demo:test")
    assert "gone.safetensors" in refused(capsys, "info", str(tmp_path / "gone.safetensors"))
