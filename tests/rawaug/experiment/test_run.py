"""What would stop a run late is one line before any work."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rawaug.errors import MissingExtra
from rawaug.experiment import run as running
from rawaug.experiment.raw import RawTask
from rawaug.experiment.run import dry_run, run, warn_of_noise
from rawaug.experiment.settings import ArmConfig, DataConfig, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.training.config import TrainConfig
from rawaug.training.launch import require_trainable


@pytest.fixture
def recipe(tmp_path: Path) -> Recipe:
    return Recipe(name="mine", arms={"real": ArmConfig()}, out=str(tmp_path), device="cpu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"device": "cdua"}, r"'cdua'.*nearest: cuda"),
        ({"device": "cuda"}, "'cuda'"),
        ({"devices": 0}, "devices"),
        ({"train": TrainConfig(precision="bf16-mixde")}, r"train\.precision: .*'bf16-mixde'"),
        ({"classical": ["Wavelet"]}, r"Wavelet: pywt .*pip install"),
        ({"name": "../mine"}, r"^name"),
        ({"out": "/dev/null"}, "/dev/null/mine"),
    ],
)
@pytest.mark.usefixtures("no_gpu")
def test_it_is_found_before_any_work(
    recipe: Recipe, unread: str, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], message: str
) -> None:
    monkeypatch.setitem(sys.modules, "pywt", None)
    recipe = replace(recipe, data=DataConfig(pairs=unread, validation=unread, test=unread))
    with pytest.raises((ValueError, OSError), match=message):
        run(replace(recipe, **change))
    assert not list(Path(recipe.out).iterdir())


def test_a_run_says_that_bm3d_is_missing_and_goes_on(
    recipe: Recipe, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "bm3d", None)
    with pytest.raises(ValueError, match="'upii'"):
        run(replace(recipe, classical=["BM3D"], noise="upii"))
    assert "BM3D is left out: bm3d is not installed" in capsys.readouterr().out
    monkeypatch.setattr(running, "is_leader", lambda: False)
    with pytest.raises(ValueError, match="'upii'"):
        run(replace(recipe, classical=["BM3D"], noise="upii"))
    assert not capsys.readouterr().out, "another process says so"


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    require_trainable("cpu", 1, "bf16-mixed")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match="matplotlib"):
        require_trainable("cpu", 1, "32-true")


def test_a_dry_run_repeats_the_notes_of_the_run(
    recipe: Recipe, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(running, "added_noise_note", lambda trials: "the references are noisy")
    monkeypatch.setattr(running, "training_noise_note", lambda *_: "")
    task = RawTask(recipe, DictionaryISP(), {"pairs": [], "validation": []})
    monkeypatch.setattr(running, "run_kind", lambda *_: warn_of_noise(task, []))

    dry_run("ablation", SimpleNamespace(name="x", out=recipe.out, shortest=lambda: recipe))
    assert "note: the references are noisy" in capsys.readouterr().out
