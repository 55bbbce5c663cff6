"""What would stop a run late is one line before any work."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from rawaug.errors import MissingExtra
from rawaug.experiment import denoising
from rawaug.experiment.early_checks import require_runnable
from rawaug.experiment.recipe import ArmConfig, DataConfig, Recipe
from rawaug.training.config import TrainConfig


@pytest.fixture
def recipe(tmp_path: Path) -> Recipe:
    return Recipe(name="mine", arms={"real": ArmConfig()}, out=str(tmp_path), device="cpu")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"device": "cdua"}, r"device 'cdua' is unknown; .*nearest: cuda"),
        ({"device": "cuda"}, r"device 'cuda': 1 needed, this machine has none"),
        ({"device": "cuda:1"}, "CUDA_VISIBLE_DEVICES"),
        ({"devices": 0}, "devices must be at least 1"),
        ({"train": TrainConfig(precision="bf16-mixde")}, r"train\.precision: .*'bf16-mixde' is invalid"),
        ({"classical": ["Wavelet"]}, r"classical: Wavelet: pywt is not installed; run: pip install"),
        ({"name": "../mine"}, "must be a folder within"),
        ({"out": "/dev/null"}, "/dev/null/mine: cannot be written"),
    ],
)
@pytest.mark.usefixtures("no_gpu")
def test_it_is_found_before_any_work(
    recipe: Recipe, unread: str, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], message: str
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pywt", None)
    recipe = replace(recipe, data=DataConfig(pairs=unread, validation=unread, test=unread))
    with pytest.raises((ValueError, OSError), match=message):
        denoising.run(replace(recipe, **change))
    assert not list(Path(recipe.out).iterdir())


def test_compilation_is_tried_first(recipe: Recipe, unread: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def compiled(function: object) -> object:
        def call(*_: object) -> None:
            raise RuntimeError("InvalidCxxCompiler: No working C++ compiler found\nSet TORCHDYNAMO_VERBOSE=1")

        return call

    monkeypatch.setattr("torch.compile", compiled)
    data = DataConfig(pairs=unread, validation=unread, test=unread)
    said = r"train\.compile: PyTorch cannot compile here \(InvalidCxxCompiler: .* found\); install a C\+\+ compiler, or"
    with pytest.raises(ValueError, match=said):
        denoising.run(replace(recipe, data=data, train=TrainConfig(compile=True)))
    assert not list(Path(recipe.out).iterdir())


def test_a_run_that_can_go_on_passes_and_leaves_nothing(recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    require_runnable(replace(recipe, train=TrainConfig(precision="bf16-mixed"), classical=["NonLocalMeans"]))
    assert not list(Path(recipe.out).iterdir())
    monkeypatch.setitem(__import__("sys").modules, "tensorboard", None)
    with pytest.raises(MissingExtra, match="tensorboard is not installed"):
        require_runnable(recipe)
