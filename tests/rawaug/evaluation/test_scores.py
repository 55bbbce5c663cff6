"""Scores: of an ISP by patches, of a denoiser on frozen noise, as the JSON that others read."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import denoisers
from rawaug.bayer import CFA
from rawaug.cli import main
from rawaug.commands.evaluate import run as evaluate
from rawaug.data import Pair, demo_pairs
from rawaug.denoising.denoiser import Noisy, RawDenoiser, require_classical
from rawaug.evaluation.scores import NOISY, Row, compare_images, score, summary
from rawaug.evaluation.tables import print_scores
from rawaug.evaluation.trials import make_trial
from rawaug.experiment.task import find_classical
from rawaug.io import write_picture
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model


@pytest.fixture
def middles(given: list[Pair]) -> list[Pair]:
    """The middle of each validation pair of the demo, as ``given:``."""
    given.extend(pair.middle(128) for pair in demo_pairs("validation"))
    return given


def test_the_noise_map_of_a_test_is_that_of_the_noisy_frame() -> None:
    """A test must not know the clean frame, not even through its noise map."""
    captured = demo_pairs("test", count=1)[0]
    assert captured.noisy is not None and captured.noisy.noise_profile is not None
    drawn = replace(captured, noisy=None)
    for pair, levels in ((captured, captured.noisy.noise_profile), (drawn, (1e-2, 1e-4))):
        sample = make_trial(pair, noise_model((1e-2, 1e-4)))
        assert not torch.equal(sample.noisy, sample.clean) and sample.noisy.min() < 0
        expected = levels[0] * sample.noisy.clamp_min(0.0) + levels[1]
        torch.testing.assert_close(sample.variance, expected, rtol=1e-4, atol=1e-8)
        again, other = (make_trial(pair, noise_model((1e-2, 1e-4)), seed=k).noisy for k in (0, 1))
        assert torch.equal(sample.noisy, again) and torch.equal(again, other) == (pair is captured)


def test_scores_whose_levels_came_from_the_clean_frame_are_marked(capsys: pytest.CaptureFixture[str]) -> None:
    pair = demo_pairs("test", count=1)[0].middle(64)
    assert pair.noisy is not None
    bare = replace(pair.noisy, noise_profile=None)
    measured = replace(pair, name="measured", noisy=bare)  # so that they are measured
    noise = noise_model((1e-2, 1e-4))
    trials = [make_trial(frame, noise) for frame in (pair, measured)]
    result = summary(score([RawDenoiser.of(lambda noisy: noisy * 0.99)], trials))
    assert result["levels_from_clean"] == 1
    assert [image.get("levels_from_clean") for image in result["images"]] == [None, True]
    print_scores({"kind": "denoiser", "data": "demo", **result})
    said = capsys.readouterr().out
    assert "measured *" in said and "noise levels of 1 of 2 images were measured against their clean frames" in said


def test_a_denoiser_that_does_nothing_scores_as_its_input(
    identity: Path, middles: list[Pair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = evaluate(str(identity), data="given:")
    assert result["kind"] == "denoiser" and len(result["images"]) == 4
    assert result["psnr"] == pytest.approx(result["psnr_noisy"], abs=1e-4)
    assert result["ssim"] == pytest.approx(result["ssim_noisy"], abs=1e-5)
    assert result["psnr_worst25"] < result["psnr"] < result["psnr_best25"]
    rows = list(score([NOISY], [make_trial(pair, noise_model("upi")) for pair in middles]))
    assert "psnr_worst25" in summary(rows) and "psnr_worst25" not in summary(rows[:3]), "three have no quarter"
    figures = {"psnr", "ssim", "psnr_srgb", "ssim_srgb"}
    assert set(result["images"][0]) == {"name", "shot_var", "read_var", *figures, *(f"{f}_noisy" for f in figures)}
    assert all(result[f"{key}_worst25"] <= result[key] <= result[f"{key}_best25"] for key in figures)
    assert result["psnr_srgb"] == pytest.approx(result["psnr_srgb_noisy"], abs=1e-3)
    shown: list[dict[str, Any]] = []
    monkeypatch.setattr("rawaug.commands.evaluate.print_scores", shown.append)
    again = evaluate(str(identity), data="given:", self_ensemble=True, report=str(tmp_path / "new" / "page.html"))
    assert shown == [result, again]  # known before the views are scored
    assert again["plain"]["psnr"] == pytest.approx(again["psnr"], abs=1e-3)  # the network changes nothing
    page = (tmp_path / "new" / "page.html").read_text()
    assert page.count("<h3>") == 4 and "Self-ensemble" in page and f"{again['psnr']:.2f}" in page
    assert again["self_ensemble"] and again["psnr"] == pytest.approx(result["psnr"], abs=1e-4)


def test_an_isps_json_leaves_out_what_does_not_apply(tmp_path: Path, middles: list[Pair]) -> None:
    DictionaryISP(ISPConfig(cfa="GRBG")).save(tmp_path / "isp.safetensors")
    figures = tmp_path / "new" / "isp.json"
    result = evaluate(str(tmp_path / "isp.safetensors"), data="given:", json=str(figures))
    assert result["kind"] == "isp"
    assert not {"ssim", "psnr_noisy", "self_ensemble", "seed"} & set(result)
    assert len(result["weights_sha256"]) == 64 and result["version"]
    assert json.loads(figures.read_text()) == result
    for flags in ({"self_ensemble": True}, {"noise": "upi"}, {"classical": ["Wavelet"]}, {"report": "a.html"}):
        with pytest.raises(ValueError, match="is an ISP"):
            evaluate("universal-small", data="given:", **flags)


@pytest.mark.parametrize("kind", ["isp", "denoiser"])
def test_the_first_result_that_is_not_finite_ends_it(kind: str, tmp_path: Path, refused: Callable[..., str]) -> None:
    """Weights that are finite and make results that are not."""
    isp, network = DictionaryISP.from_pretrained("canon-powershot"), denoisers.UNet(width=4, scales=2)
    for weights in [*isp.get_submodule("stages").parameters(), *network.parameters()]:
        weights.data.fill_(3e38)
    file = tmp_path / "absurd.safetensors"
    isp.save(file) if kind == "isp" else denoisers.save(network, file, {"cfa": "RGGB"})
    said = refused("evaluate", file, "--data", "demo:test", "--quiet")
    assert "test_00_coffee: the result is not finite" in said


def test_a_capture_without_levels_is_the_test_case_and_its_levels_are_measured() -> None:
    pair = demo_pairs("test", count=1)[0]
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    bare = replace(pair, noisy=replace(pair.noisy, noise_profile=None))
    noise = noise_model("cycleisp_sidd")
    with_levels, measured = (make_trial(p, noise) for p in (pair, bare))
    assert measured.variance is not None and with_levels.variance is not None
    assert torch.equal(measured.noisy, with_levels.noisy)
    assert (measured.variance / with_levels.variance).mean() == pytest.approx(1.0, abs=0.1)
    levels = measured.levels
    assert levels is not None
    y = pair.clean.mosaic.mean().item()
    shot_var, read_var = pair.noisy.noise_profile
    assert levels[0] * y + levels[1] == pytest.approx(shot_var * y + read_var, rel=0.1)


def test_classical_denoisers_stand_beside_it(identity: Path, given: list[Pair]) -> None:
    given.extend(demo_pairs("test", count=1))
    result = evaluate(str(identity), data="given:", classical=["Wavelet", "TotalVariation"])
    for name, gain in {"Wavelet": 3.0, "TotalVariation": 2.0}.items():
        scores = result["classical"][name]
        assert scores["psnr"] > result["psnr_noisy"] + gain and scores["psnr_srgb"] > result["psnr_srgb_noisy"] + gain
    with pytest.raises(ValueError, match="'Median'"):
        evaluate(str(identity), data="given:", classical=["Median"])


def test_noise_of_another_kind_is_scored_without_stabilisation() -> None:
    pair = replace(demo_pairs("test", count=1)[0], noisy=None)
    noise = noise_model((0.0, 1e-3))
    noisy, denoised = score([NOISY, RawDenoiser.of("Wavelet")], [make_trial(pair, noise)])
    assert denoised.psnr > noisy.psnr + 3.0


def test_the_development_is_the_same_for_both() -> None:
    """Halving clean and result alike changes nothing after development, since the exposure is the clean frame's."""
    pair = demo_pairs("test", count=1)[0]
    trial = make_trial(pair, noise_model("cycleisp_sidd"))
    whole = compare_images(trial.noisy, trial)
    halved = replace(pair, clean=replace(pair.clean, mosaic=pair.clean.mosaic / 2))
    dark = replace(make_trial(halved, noise_model((0.0, 0.0))), noisy=trial.noisy / 2)
    half = compare_images(dark.noisy, dark)
    assert half[2:] == pytest.approx(whole[2:], rel=1e-4) and half[0] == pytest.approx(whole[0] + 6.02, abs=0.01)


def test_progress_within_a_frame(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("RAWAUG_PROGRESS_SECONDS", "0")
    packed = torch.rand(1, 4, 4, 2000, generator=torch.Generator().manual_seed(0))
    model = denoisers.build("UNet", width=4, scales=2)
    denoiser = RawDenoiser.of(model, cfa=CFA.GRBG)
    assert torch.equal(denoiser(Noisy(packed, packed, cfa=CFA.GRBG)), packed)
    assert "frame: 1/2 tiles, 00:00 elapsed" in capsys.readouterr().err
    replace(denoiser, views=8)(Noisy(packed[..., :8], packed[..., :8], cfa=CFA.GRBG))
    assert "view groups, " in capsys.readouterr().err


def test_a_filter_whose_library_is_missing_is_refused_and_bm3d_left_out_of_recipes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "bm3d", None)
    with pytest.raises(ValueError, match=r"classical: .*installed"):
        require_classical(["Wavelet", "BM3D"])
    assert find_classical(["Wavelet", "BM3D"]) == ["Wavelet"]
    assert find_classical(["BM3D"]) == []
    monkeypatch.setitem(sys.modules, "skimage", None)
    with pytest.raises(ValueError, match=r"classical: .*NonLocalMeans"):
        find_classical(["NonLocalMeans"])


@pytest.fixture
def crops(tmp_path: Path) -> Path:
    """Two pairs of RAWIR, which have no noise of their own."""
    folder = tmp_path / "crops"
    folder.mkdir()
    packed = np.random.default_rng(0).integers(0, 1024, (2, 16, 16, 4)).astype(np.uint16)
    for k in range(2):
        np.save(folder / f"{k}.npy", packed[k])
        write_picture(folder / f"{k}.jpg", torch.full((3, 32, 32), 90, dtype=torch.uint8))
    return folder


def test_a_score_that_is_no_number_is_named_and_left_out_of_the_mean(
    identity: Path, crops: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scores = {"a": (30.0, 0.5), "b": (float("inf"), 0.7), "c": (20.0, float("nan"))}
    rows = [Row("mine", name, "", "", "raw", *both) for name, both in scores.items()]
    result = summary(rows)
    assert result["psnr"] == 25.0 and result["ssim"] == pytest.approx(0.6)
    assert [set(image) for image in result["images"]] == [{"name", "psnr", "ssim"}, {"name", "ssim"}, {"name", "psnr"}]
    assert result["no_numbers"] == ["b: psnr is inf", "c: ssim is nan"]
    assert "no_numbers" not in summary(rows[:1])
    figures = crops / "scores.json"
    arguments = ["evaluate", str(identity), "--data", f"rawir:{crops}", "--noise", "[0, 0]", "--json", str(figures)]
    assert main(arguments) == 2  # nothing to denoise: the frames are equal
    printed = capsys.readouterr()
    (refused,) = (line for line in printed.err.splitlines() if line.startswith("rawaug: "))  # besides progress
    assert "PSNR_d" in printed.out and "0: psnr is inf" in refused
    written = json.loads(figures.read_text())
    assert "psnr" not in written and written["ssim"] == pytest.approx(1.0)


def test_frames_that_cannot_be_read_are_named_and_the_rest_is_scored(
    identity: Path, crops: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (crops / "1.npy").write_bytes(b"PK\x03\x04 no archive")
    figures, page = crops / "scores.json", crops / "page.html"
    arguments = ["evaluate", str(identity), "--data", f"rawir:{crops}", "--json", str(figures)]
    assert main([*arguments, "--report", str(page)]) == 2
    assert "1.npy: cannot be read as packed RAW" in capsys.readouterr().err
    result = json.loads(figures.read_text())
    assert [image["name"] for image in result["images"]] == ["0"] and len(result["broken"]) == 1 and page.is_file()
    (crops / "0.npy").write_bytes(b"")
    assert main([*arguments, "--overwrite"]) == 2 and "none of the 2 frames can be read" in capsys.readouterr().err


def test_whatever_is_benchmarked_can_be_evaluated(middles: list[Pair], tmp_path: Path) -> None:
    """A filter, published weights and an ONNX file, by the one resolver."""
    generator = torch.Generator().manual_seed(0)
    shapes = {"conv00": (4, 1, 3, 3), "conv01": (1, 4, 3, 3)}
    weights = {name: 1e-3 * torch.randn(shape, generator=generator) for name, shape in shapes.items()}
    save_file(weights, tmp_path / "published.safetensors")
    del middles[1:]

    filtered = evaluate("NonLocalMeans", data="given:")
    published = evaluate(str(tmp_path / "published.safetensors"), data="given:")
    assert filtered["psnr"] > filtered["psnr_noisy"] + 1 and "weights_sha256" not in filtered
    assert published["psnr"] == pytest.approx(published["psnr_noisy"], abs=0.5) and published["weights_sha256"]
    with pytest.raises(FileNotFoundError, match="no such file"):
        evaluate("nowhere.onnx", data="given:")
    with pytest.raises(ValueError, match="no such denoiser"):
        evaluate("rawaug-smal", data="given:")


def test_an_isp_may_be_told_what_a_file_states() -> None:
    blind = evaluate("universal", data="real:validation")
    given = evaluate("universal", data="real:validation", as_shot=True, tone="linear")
    assert given["psnr"] > blind["psnr"] + 2.0
    assert (given["as_shot"], given["tone"]) == (True, "linear") and "tone" not in blind
    with pytest.raises(ValueError, match="--tone"):
        evaluate("rawaug-small", data="real:validation", tone="linear")
