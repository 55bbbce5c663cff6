"""What a run says at its ends: which settings a network has, and the command that uses what the verdict names."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from denoisers.network import DENOISERS
from rawaug.bayer import CFA
from rawaug.commands.run import run
from rawaug.data import demo_pairs
from rawaug.evaluation.verdict import verdict
from rawaug.experiment import report
from rawaug.experiment import run as experiment
from rawaug.experiment.settings import ArmConfig
from rawaug.training.noisy_frames import NoisyFrame, faintness_note, frame_levels


def scores(psnr: float) -> dict[str, Any]:
    images = [{"name": name, "psnr": psnr, "psnr_noisy": 30.0} for name in "ab"]
    return {"psnr": psnr, "psnr_noisy": 30.0, "images": images}


@pytest.mark.parametrize(
    ("arm", "last"),
    [
        ((41.0, 41.2), "to use mine: rawaug denoise IN.dng OUT.dng --denoiser runs/seed1/mine/denoiser.safetensors"),
        ((39.0, 39.2), "to use rawaug-small: rawaug denoise IN.dng OUT.dng --denoiser rawaug-small"),
    ],
)
def test_the_last_line_is_the_command_of_the_verdict(arm: tuple[float, ...], last: str) -> None:
    results = {"mine": [{"plain": scores(psnr)} for psnr in arm]}
    others = {"rawaug-small": scores(40.0), "Wavelet strength=0.5": scores(35.0)}
    said = usage(results, others)
    assert said[-1] == last and verdict(results, others).sentence.startswith(f"Use {last.split(': ')[0][7:]}: ")


def test_a_filter_or_nothing_is_used_as_the_verdict_says() -> None:
    results = {"mine": [{"plain": scores(29.0)}]}
    assert usage(results, {"Wavelet strength=0.5": scores(35.0)})[-1].endswith(
        """--classical '{"name": "Wavelet", "settings": {"strength": 0.5}}'"""
    )
    assert usage(results, {})[-1] == "to use: nothing, the frames are best as they are"


@pytest.mark.parametrize("target", ["raw", "srgb"])
def test_the_command_can_be_pasted_whatever_a_run_is_called(target: str) -> None:
    path = Path("my run; touch PWNED") / "denoiser.safetensors"
    recipe: Any = SimpleNamespace(classical=[], baselines=["a b.safetensors"], target=target)
    assert shlex.split(report.weights_command(recipe, path))[-1] == str(path)
    assert shlex.split(report.method_command(recipe, "a b"))[-1] == "a b.safetensors"


def usage(results: Any, others: Any) -> list[str]:
    recipe: Any = SimpleNamespace(
        arms={"mine": ArmConfig()},
        baselines=["rawaug-small"],
        classical=[{"name": "Wavelet", "settings": {"strength": 0.5}}],
        all_seeds=range(len(results["mine"])),
        target="raw",
    )
    tables = {"": {"results": results, "others": others}}
    return report.usage(recipe, Path("runs"), tables, {"": verdict(results, others).use})


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    found: list[Any] = []
    monkeypatch.setattr(experiment, "dry_run", lambda kind, settings, overwrite: found.append(settings))
    return found


def test_another_network_has_its_own_settings(given: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    run("fewshot", "--denoiser.name", "DnCNN", dry_run=True)
    assert given[-1].denoiser.name == "DnCNN" and given[-1].denoiser.settings == {}
    assert "denoiser: the settings of UNet are dropped for DnCNN's own" in capsys.readouterr().out
    run("fewshot", "--denoiser", "DHDN", "--denoiser.settings.width", "8", dry_run=True)
    assert given[-1].denoiser.name == "DHDN" and given[-1].denoiser.settings == {"width": 8}
    run("fewshot", "--denoiser.name", "UNet", dry_run=True)
    assert given[-1].denoiser.settings == {"width": 16, "scales": 4}
    run("srgb", "--denoiser.name", "DnCNN", dry_run=True)
    assert given[-1].denoiser.settings == {"channels": 3, "deviation": True}


def test_an_unknown_network_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match="'DHDNN'"):
        run("fewshot", "--denoiser", "DHDNN", dry_run=True)


def test_the_help_lists_the_networks_of_the_registry(capsys: pytest.CaptureFixture[str]) -> None:
    run("fewshot", keys=True)
    text = " ".join(capsys.readouterr().out.split())
    assert all(name in text for name in DENOISERS)


def test_frames_without_known_noise_ask_for_the_command_to_type() -> None:
    pair = replace(demo_pairs("train", count=1)[0], noisy=None)
    with pytest.raises(ValueError, match="noise: camera"):
        frame_levels(pair, None)


def test_frames_with_next_to_no_noise_are_named_before_training() -> None:
    mosaic = torch.full((1, 8, 8), 0.2)
    clean = [NoisyFrame("a", mosaic, 1e-5, 1e-7, CFA.RGGB)]
    assert "next to no noise (56.8 dB PSNR)" in faintness_note(clean)
    assert faintness_note([NoisyFrame("a", mosaic, 1e-3, 1e-5, CFA.RGGB)]) == faintness_note([]) == ""


def test_arms_keeps_only_those_that_are_named(given: list[Any]) -> None:
    run("unsupervised", "--arms", "noisier", dry_run=True)
    assert list(given[-1].arms) == ["noisier"] and given[-1].arms["noisier"].augmented == 0.5
    run("unsupervised", "--arms", "[r2r, noisier]", "--arms.r2r.augmented", "1", dry_run=True)
    assert list(given[-1].arms) == ["noisier", "r2r"] and given[-1].arms["r2r"].augmented == 1.0
    with pytest.raises(ValueError, match=r"nearest: noisier"):
        run("unsupervised", "--arms", "noisiest", dry_run=True)


def test_noise_that_is_a_number_is_refused_as_in_python() -> None:
    with pytest.raises(ValueError, match="shot_var"):
        run("fewshot", "--noise", "-1", dry_run=True)
