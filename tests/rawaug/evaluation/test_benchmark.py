"""The benchmark: the same input for everyone, any kind of denoiser, and one line for what is none."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

import denoisers
from rawaug.bayer import CFA
from rawaug.cli import main
from rawaug.data import open_pairs
from rawaug.evaluation import benchmark as ruler
from rawaug.evaluation.benchmark import STRENGTHS, benchmark, columns_of, hash_of, strengths_of
from rawaug.evaluation.contestants import Contestant, bf_dncnn, contestant
from rawaug.evaluation.scores import frozen_sample
from rawaug.noise import noise_model

DOCS = Path(__file__).parents[3] / "docs" / "benchmark.md"
LEVELS = STRENGTHS["phone"]


@pytest.fixture
def noisy() -> tuple[torch.Tensor, torch.Tensor]:
    """A grey ramp with the noise of a phone, and its variance."""
    clean = torch.linspace(0.1, 0.9, 64).expand(1, 4, 64, 64)
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    seen = clean + noise * (LEVELS[0] * clean + LEVELS[1]).sqrt()
    return seen, LEVELS[0] * seen.clamp_min(0) + LEVELS[1]


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
    assert result["hash"] in capsys.readouterr().out
    assert all(shown in Path("b.html").read_text() for shown in ("mine_of_docs:blur", "PSNR over GMAC"))
    assert "rawaug-joint" not in rows and main(["benchmark", "rawaug-joint"]) == 2
    assert "rawaug-joint: demosaics, too; rawaug run demosaic" in capsys.readouterr().err


def test_noise_has_the_stated_variance_and_the_same_bits_again() -> None:
    frames = list(open_pairs("demo:test", split="test"))[:1]
    strengths = {name: levels for name, levels in strengths_of().items() if name in ("phone", "very strong")}
    columns, again, other = (columns_of(frames, 256, seed, strengths) for seed in (0, 0, 1))
    assert hash_of(columns) == hash_of(again) != hash_of(other)
    for (condition, strength), (sample,) in columns.items():
        if condition == "levels told" and sample is not None:
            unclipped = sample.clean < 0.5
            measured = (sample.noisy - sample.clean)[unclipped].square().mean()
            shot_var, read_var = STRENGTHS[strength]
            assert measured.item() == pytest.approx(
                (shot_var * sample.clean[unclipped] + read_var).mean().item(), rel=0.05
            )


def test_noise_of_the_callers_is_that_of_evaluate() -> None:
    frame = replace(open_pairs("demo:test")[0], noisy=None, shot_var=None, read_var=None)
    columns = columns_of([frame], crop=10_000, strengths=strengths_of("SonyA7S2", [1600, 6400]))
    assert {strength for _, strength in columns} == {"ISO 1600", "ISO 6400"}
    (told,) = columns["levels told", "ISO 6400"]
    evaluated = frozen_sample(frame, noise_model("SonyA7S2", iso=6400), frame.cfa, seed=0)
    assert told is not None and torch.equal(told.noisy, evaluated.noisy)
    assert torch.allclose(told.variance, evaluated.variance)
    with pytest.raises(ValueError, match="iso: needs the name of a camera as noise"):
        strengths_of(isos=[100])


@pytest.mark.parametrize(
    ("run", "said"),
    [
        (lambda noisy, variance, cfa: noisy[..., 1:], "mine: the result is not finite, or of another shape"),
        (lambda noisy, variance, cfa: noisy / 0, "mine: the result is not finite"),
        (lambda noisy, variance, cfa: noisy @ noisy[..., 1:, :], "mine: RuntimeError: "),
    ],
)
def test_a_denoiser_that_fails_is_named(run: object, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ruler, "STRENGTHS", {"phone": LEVELS})
    monkeypatch.setattr(ruler, "OF_SENSORS", ("phone",))
    frames = [pair.middle(64) for pair in list(open_pairs("demo:test", split="test"))[:1]]
    with pytest.raises(ValueError, match=said) as error:
        benchmark([Contestant("mine", run)], frames, crop=64)  # type: ignore[arg-type]
    assert "\n" not in str(error.value)


def test_a_blind_function_is_called_without_variance(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "blind_one.py").write_text("def half(noisy):\n    return (noisy / 2).numpy()\n")
    monkeypatch.chdir(tmp_path)
    one = torch.ones(1, 4, 8, 8)
    assert (contestant("blind_one:half").run(one, one, CFA.RGGB) == 0.5).all()


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("rawaug-smal", r"no such denoiser \(nearest: rawaug-small\)"),
        ("nowhere:function", "nowhere:function: cannot be imported"),
        ("json:nothing", "json:nothing: cannot be imported"),
        ("gone.onnx", "gone.onnx: no such file"),
        ("gone.safetensors", "gone.safetensors"),
    ],
)
def test_what_is_no_denoiser_is_one_line(spec: str, said: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=said):
        contestant(spec)


def test_weights_of_others_are_known_by_their_tensors(tmp_path: Path, noisy: tuple[torch.Tensor, torch.Tensor]) -> None:
    save_file({f"conv{k:02}": torch.zeros(1, 1, 3, 3) for k in range(20)}, tmp_path / "bf.safetensors")
    save_file(denoisers.PMRID().state_dict(), tmp_path / "pmrid.safetensors")
    save_file({"a": torch.zeros(1)}, tmp_path / "other.safetensors")
    assert contestant(str(tmp_path / "bf.safetensors")).name == "BF-DnCNN"
    pmrid = contestant(str(tmp_path / "pmrid.safetensors"))
    assert pmrid.name.startswith("PMRID") and pmrid.run(*noisy, CFA.RGGB).shape == noisy[0].shape
    (tmp_path / "finetuned").mkdir()
    denoisers.save(denoisers.build("DnCNN", width=4, depth=3), tmp_path / "finetuned" / "denoiser.safetensors", {})
    assert contestant(str(tmp_path / "finetuned" / "denoiser.safetensors")).name == "finetuned"  # an arm of a run
    with pytest.raises(ValueError, match="weights of no known denoiser"):
        contestant(str(tmp_path / "other.safetensors"))


def test_bf_dncnn_takes_white_noise_out_of_the_stabilised_planes(noisy: tuple[torch.Tensor, torch.Tensor]) -> None:
    mean = torch.zeros(1, 1, 3, 3)
    mean[..., 1, 1] = 1.0
    away = mean - 1 / 9  # u - (u - mean of u)
    denoised = bf_dncnn({"conv00": torch.cat([away, -away]), "conv01": torch.cat([mean, -mean], dim=1)})(*noisy)
    clean = torch.linspace(0.1, 0.9, 64).expand(1, 4, 64, 64)
    inner = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    before, after = (((x - clean)[inner]).square().mean() for x in (noisy[0], denoised))
    assert after < before / 7  # of nine sites
    assert (denoised - clean)[inner].mean().abs() < 5e-4  # the exact unbiased inverse
