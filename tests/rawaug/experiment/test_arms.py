"""What an arm is trained on, and a setting chosen on validation: what is trained for it, and which is named."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from rawaug.commands.run import with_values
from rawaug.data import demo_pictures
from rawaug.experiment.arms import rank_candidates, training_stream, validation_samples
from rawaug.experiment.recipe import ArmConfig, DataConfig, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.plugin.targets import Srgb, Target
from rawaug.training.config import TrainConfig


@pytest.mark.parametrize(
    ("aim", "noisy", "clean"), [("rgb", (4, 16, 16), (3, 32, 32)), ("srgb", (3, 32, 32), (3, 32, 32))]
)
def test_other_targets_are_trained_and_watched_on(aim: Target, noisy: tuple[int, ...], clean: tuple[int, ...]) -> None:
    class Aimed(Recipe):
        target: Target = aim  # type: ignore[misc]

    arms = {"one": ArmConfig(1.0, srgb=Srgb(jpeg=(10, 10)) if aim == "srgb" else None), "other": ArmConfig(1.0)}
    recipe = Aimed(data=DataConfig(pairs=None), camera="universal", arms=arms, train=TrainConfig(crop=32))
    isp, noise, pictures = DictionaryISP(), noise_model((1e-4, 1e-6)), demo_pictures(2)
    one, other = (training_stream(recipe, arm, [], pictures, isp, noise, 0)[0] for arm in recipe.arms.values())
    assert one.noisy.shape == one.variance.shape == noisy and one.clean.shape == clean
    assert torch.equal(one.noisy, other.noisy) == (aim == "rgb"), "through JPEG, if any"
    watched = validation_samples(recipe, [], pictures, isp, noise)[0]
    assert watched.noisy.shape == (1, *noisy) and watched.clean.shape == (1, *clean)


def test_a_target_that_an_arm_cannot_have_is_refused() -> None:
    class Developed(Recipe):
        target: Target = "srgb"  # type: ignore[misc]

    with pytest.raises(ValueError, match=r"arms\.one: srgb is for target 'srgb', not 'raw'"):
        Recipe(arms={"one": ArmConfig(1.0, srgb=Srgb(jpeg=(40, 95)))})
    content = {"arms": {"one": {"augmented": 1.0, "srgb": {"jpeg": [40, 101]}}}}
    with pytest.raises(ValueError, match=r"arms\.one\.srgb: jpeg must be .* within 1 to 100"):
        with_values(Developed, content, "recipe")
    for arm in (ArmConfig(0.5), ArmConfig(1.0, estimator="noise2noise")):
        with pytest.raises(ValueError, match="srgb targets are made from pictures"):
            Developed(arms={"one": arm})


def searching(**search: list[float]) -> ArmConfig:
    return ArmConfig(0.5, estimator={"name": "neighbor2neighbor", "settings": {}}, search=search)


def test_an_arm_is_trained_for_every_value_and_others_stay() -> None:
    arms = Recipe(arms={"r2r": ArmConfig(0.5, estimator="r2r"), "n2n": searching(gamma=[2.0, 16.0])}).arms
    assert list(arms) == ["r2r", "n2n_gamma2", "n2n_gamma16"]
    assert arms["n2n_gamma16"].estimator == {"name": "neighbor2neighbor", "settings": {"gamma": 16.0}}
    assert {arm.candidate_of for arm in arms.values()} == {None, "n2n"} and arms["n2n_gamma2"].augmented == 0.5
    assert Recipe(arms=arms).arms == arms, "candidates are not searched again"


def test_what_is_no_setting_is_refused_before_anything_runs() -> None:
    with pytest.raises(ValueError, match="gama"):
        Recipe(arms={"n2n": searching(gama=[2.0])})
    searches: list[dict[str, list[float]]] = [{"gamma": []}, {"gamma": [1.0], "delta": [2.0]}]
    for search in searches:
        with pytest.raises(ValueError, match=r"arms: n2n: search needs one setting with values"):
            Recipe(arms={"n2n": searching(**search)})


def test_the_best_of_every_log_counts_and_runs_are_averaged(tmp_path: Path) -> None:
    arms = {"n2n_gamma2": "n2n", "n2n_gamma16": "n2n"}
    scores = {
        "seed0/n2n_gamma2": (30.0, 33.0, 31.0), "seed1/n2n_gamma2": (32.0, 32.0, 30.0),
        "seed0/n2n_gamma16": (31.0, 30.0, 32.0), "seed1/n2n_gamma16": (20.0, 34.0, 33.0),
    }  # fmt: skip
    for name, values in scores.items():
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "log.csv").write_text("step,psnr\n" + "".join(f"1,{value}\n" for value in values))
    folders = [tmp_path / "seed0", tmp_path / "seed1"]
    best = rank_candidates(arms, folders, best=True)
    assert best == {"n2n": {"n2n_gamma16": 33.0, "n2n_gamma2": 32.5}} and next(iter(best["n2n"])) == "n2n_gamma16"
    last = rank_candidates(arms, folders, best=False)
    assert last == {"n2n": {"n2n_gamma16": 32.5, "n2n_gamma2": 30.5}}
    assert rank_candidates({}, folders, True) == {}
