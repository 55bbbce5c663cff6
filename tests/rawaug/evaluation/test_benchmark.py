"""The benchmark: the same input for everyone, any kind of denoiser, and one line for what is none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch

from rawaug import RawDenoiser
from rawaug.bayer import CFA, pack
from rawaug.cli import main
from rawaug.data import open_pairs
from rawaug.evaluation.benchmark import (
    ESTIMATED,
    STRENGTHS,
    TOLD,
    benchmark_trials,
    choose_strengths,
    count_gmac,
    hash_trials,
    ranking,
)
from rawaug.evaluation.table_files import latex_benchmark
from rawaug.evaluation.trials import make_trial
from rawaug.noise import FixedLevels, NoiseEstimate, estimate_noise, noise_model

DOCS = Path(__file__).parents[3] / "docs" / "benchmark.md"


@pytest.mark.long
@pytest.mark.usefixtures("tiny")
def test_the_function_of_the_docs_is_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (snippet,) = re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    (tmp_path / "mine_of_docs.py").write_text(snippet)
    monkeypatch.chdir(tmp_path)
    command = ["benchmark", "mine_of_docs:blur", "--data", "tiny:test", "--count", "1", "--crop", "64"]
    command += ["--table", "b.tex"]
    assert main([*command, "--noise", "[7e-3, 1.8e-4]", "--json", "b.json", "--report", "b.html"]) == 0
    result = json.loads(Path("b.json").read_text())
    rows = result["rows"]
    assert {"noisy input", "NonLocalMeans", "rawaug-small", "mine_of_docs:blur"} <= set(rows)
    told = {name: row["scores"]["levels told"]["[0.007, 0.00018]"]["psnr"] for name, row in rows.items()}
    assert told["noisy input"] < told["mine_of_docs:blur"] and told["noisy input"] < told["rawaug-small"]
    assert rows["rawaug-small"]["gmac"] > 1 and rows["noisy input"]["seconds"] is None
    printed, page = capsys.readouterr().out, Path("b.html").read_text()
    noise = result["noise"]
    assert "synthetic" in noise and "(0.007, 0.00018)" in noise and "seed 0" in noise
    assert result["hash"] in printed and noise in printed
    assert page.index("The noise is synthetic") < page.index("<h2>")
    assert all(shown in page for shown in ("mine_of_docs:blur", "PSNR over GMAC"))
    assert "noisy input" in Path("b.tex").read_text() and r"\toprule" in Path("b.tex").read_text()
    assert "rawaug-joint" not in rows and main(["benchmark", "rawaug-joint"]) == 2
    assert "rawaug-joint: demosaics, too; rawaug run demosaic" in capsys.readouterr().err


def test_noise_has_the_stated_variance_and_the_same_bits_again() -> None:
    frames = list(open_pairs("demo:test", split="test"))[:1]
    strengths = {name: levels for name, levels in choose_strengths().items() if name in ("phone", "very strong")}
    found, again, other = (benchmark_trials(frames, 256, seed, strengths) for seed in (0, 0, 1))
    assert hash_trials(found) == hash_trials(again) != hash_trials(other)
    for trial in found:
        if trial.condition == TOLD:
            unclipped = trial.clean < 0.5
            measured = (trial.noisy - trial.clean)[unclipped].square().mean()
            shot_var, read_var = STRENGTHS[trial.strength]
            assert measured.item() == pytest.approx(
                (shot_var * trial.clean[unclipped] + read_var).mean().item(), rel=0.05
            )


def test_estimated_levels_do_not_depend_on_the_clean_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[torch.Tensor] = []

    def estimate(mosaic: torch.Tensor, cfa: CFA) -> NoiseEstimate:
        seen.append(mosaic)
        return estimate_noise(mosaic, cfa)

    monkeypatch.setattr("rawaug.evaluation.benchmark.estimate_noise", estimate)
    frame = open_pairs("demo:test")[0]
    told, estimated, _ = benchmark_trials([frame], 10_000, strengths={"strong": FixedLevels(*STRENGTHS["strong"])})
    assert (told.condition, estimated.condition) == (TOLD, ESTIMATED) and estimated.levels != told.levels
    assert torch.equal(pack(seen[0][None], frame.cfa), told.noisy) and torch.equal(told.noisy, estimated.noisy)


def test_noise_of_the_callers_is_that_of_evaluate() -> None:
    frame = replace(open_pairs("demo:test")[0], noisy=None)
    found = benchmark_trials([frame], crop=10_000, strengths=choose_strengths("SonyA7S2", [1600, 6400]))
    assert {trial.strength for trial in found} == {"ISO 1600", "ISO 6400"}
    (told,) = (trial for trial in found if (trial.condition, trial.strength) == (TOLD, "ISO 6400"))
    evaluated = make_trial(frame, noise_model("SonyA7S2", iso=6400))
    assert told.variance is not None and evaluated.variance is not None
    assert torch.equal(told.noisy, evaluated.noisy) and torch.allclose(told.variance, evaluated.variance)
    with pytest.raises(ValueError, match=r"iso: .*camera"):
        choose_strengths(isos=[100])


def result_of(**scores: list[float]) -> dict[str, Any]:
    """A benchmark's result at one strength, of these PSNR by frame."""
    rows = {}
    for name, values in {"noisy input": [20.0] * 6, **scores}.items():
        images = [{"psnr": value, "psnr_srgb": value - 10.0} for value in values]
        cell = {"psnr": fmean(values), "psnr_srgb": fmean(values) - 10.0, "images": images, "frames": len(values)}
        rows[name.replace("_", " ")] = {"scores": {TOLD: {"phone": cell}}}
    return {"rows": rows, "frames": [f"frame {k}" for k in range(6)], "hash": "01234567"}


def test_only_a_lead_beyond_the_spread_of_frames_is_bold_in_a_paper() -> None:
    frames = [38.0, 45.0, 41.0, 50.0, 36.0, 43.0]
    clear = result_of(mine=[psnr + 0.5 + k / 100 for k, psnr in enumerate(frames)], theirs=frames)
    assert re.search(
        r"^mine & \\textbf\{42\.\d\d \$\\pm\$ 2\.\d\d\} & \\textbf", latex_benchmark(clear, "cmd"), re.MULTILINE
    )
    (line,) = ranking(clear)
    assert line.startswith("phone: mine against theirs: +0.5") and line.endswith("ahead in 6 of 6 frames")

    open_ = result_of(mine=[psnr + (2.0 if k else -8.0) for k, psnr in enumerate(frames)], theirs=frames)
    assert "textbf" not in latex_benchmark(open_, "cmd")


def test_operations_are_counted_on_a_whole_tile() -> None:
    assert count_gmac(RawDenoiser.of("rawaug-small")) == pytest.approx(12.4, abs=0.1)
    assert count_gmac(RawDenoiser.of("Wavelet")) is None
