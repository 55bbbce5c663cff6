"""The benchmark: the same input for everyone, any kind of denoiser, and one line for what is none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rawaug.bayer import CFA, pack
from rawaug.cli import main
from rawaug.data import open_pairs
from rawaug.evaluation.benchmark import ESTIMATED, STRENGTHS, TOLD, hash_of, strengths_of, trials
from rawaug.evaluation.trials import trial_of
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
    assert "rawaug-joint" not in rows and main(["benchmark", "rawaug-joint"]) == 2
    assert "rawaug-joint: demosaics, too; rawaug run demosaic" in capsys.readouterr().err


def test_noise_has_the_stated_variance_and_the_same_bits_again() -> None:
    frames = list(open_pairs("demo:test", split="test"))[:1]
    strengths = {name: levels for name, levels in strengths_of().items() if name in ("phone", "very strong")}
    found, again, other = (trials(frames, 256, seed, strengths) for seed in (0, 0, 1))
    assert hash_of(found) == hash_of(again) != hash_of(other)
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
    told, estimated, _ = trials([frame], 10_000, strengths={"strong": FixedLevels(*STRENGTHS["strong"])})
    assert (told.condition, estimated.condition) == (TOLD, ESTIMATED) and estimated.levels != told.levels
    assert torch.equal(pack(seen[0][None], frame.cfa), told.noisy) and torch.equal(told.noisy, estimated.noisy)


def test_noise_of_the_callers_is_that_of_evaluate() -> None:
    frame = replace(open_pairs("demo:test")[0], noisy=None, shot_var=None, read_var=None)
    found = trials([frame], crop=10_000, strengths=strengths_of("SonyA7S2", [1600, 6400]))
    assert {trial.strength for trial in found} == {"ISO 1600", "ISO 6400"}
    (told,) = (trial for trial in found if (trial.condition, trial.strength) == (TOLD, "ISO 6400"))
    evaluated = trial_of(frame, noise_model("SonyA7S2", iso=6400))
    assert told.variance is not None and evaluated.variance is not None
    assert torch.equal(told.noisy, evaluated.noisy) and torch.allclose(told.variance, evaluated.variance)
    with pytest.raises(ValueError, match=r"iso: .*camera"):
        strengths_of(isos=[100])
