"""A folder holds one run: the same settings resume it, others are refused, and no name leads out of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rawaug.experiment.folder import STAMP, claim, require_free
from rawaug.experiment.settings import ArmConfig, Recipe
from rawaug.paper.ablation import Ablation, ablate
from rawaug.training.config import TrainConfig


@pytest.fixture
def recipe(tmp_path: Path) -> Recipe:
    return Recipe(name="mine", arms={"real": ArmConfig()}, out=str(tmp_path / "runs"))


def test_the_same_settings_resume_and_what_changes_no_result_may_change(recipe: Recipe) -> None:
    folder = claim(recipe)
    assert json.loads((folder / STAMP).read_text())["arms"]["real"]["augmented"] == 0.0
    elsewhere = replace(recipe, device="cuda", devices=2, seeds=3, self_ensemble=False)
    faster = replace(recipe, train=TrainConfig(workers=8, checkpoint_every=7), data=replace(recipe.data, memory_mb=9))
    for same in (recipe, elsewhere, faster):
        assert require_free(same) == folder


def test_other_settings_are_refused_by_key(recipe: Recipe) -> None:
    claim(recipe)
    longer = replace(recipe, train=TrainConfig(steps=9))
    with pytest.raises(ValueError, match=r"mine: .*--name"):
        claim(longer)
    with pytest.raises(ValueError, match=r"arms\.more\.augmented.*None"):
        claim(replace(recipe, arms={**recipe.arms, "more": ArmConfig(0.5)}))
    assert json.loads((Path(recipe.out) / "mine" / STAMP).read_text())["train"]["steps"] == 1500
    claim(longer, overwrite=True)
    with pytest.raises(ValueError, match="now 1500"):
        require_free(recipe)


def test_files_of_an_unknown_run_are_not_touched(recipe: Recipe) -> None:
    folder = Path(recipe.out) / "mine"
    folder.mkdir(parents=True)
    assert require_free(recipe) == folder  # empty
    (folder / "results.json").write_text("{}")
    with pytest.raises(ValueError, match=r"run\.json"):
        require_free(recipe)


@pytest.mark.parametrize(
    "name", ["../mine", "/mine", "a/../../mine", "", ".", "a//b", "..\\mine", "a\x1b[31m", "a" * 201]
)
def test_a_name_stays_within_out(recipe: Recipe, name: str) -> None:
    with pytest.raises(ValueError, match=r"^name"):
        require_free(replace(recipe, name=name))
    assert require_free(replace(recipe, name="sidd/few")) == Path(recipe.out) / "sidd" / "few"


@pytest.mark.parametrize("name", ["../outside", "/outside", "a/b", "..", "", "a\x1b[31m", "a\nb"])
def test_an_arm_is_one_folder_of_its_run(recipe: Recipe, name: str) -> None:
    with pytest.raises(ValueError, match=r"^arms: "):
        replace(recipe, arms={name: ArmConfig()})
    replace(recipe, arms={"with 50 %, twice": ArmConfig()})


def test_every_kind_of_experiment_claims_its_folder(tmp_path: Path) -> None:
    settings = Ablation(data="demo:train", out=str(tmp_path))
    claim(settings)
    with pytest.raises(ValueError, match=r"ablation: .*count"):
        ablate(replace(settings, count=3))
