"""A setting chosen on validation: what is trained for it, and which is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from rawaug.experiment.arms import chosen
from rawaug.experiment.recipe import ArmConfig, Recipe


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
        "n2n_gamma2": ((30.0, 33.0, 31.0), (32.0, 32.0, 30.0)),
        "n2n_gamma16": ((31.0, 30.0, 32.0), (20.0, 34.0, 33.0)),
    }
    for name, runs in scores.items():
        for seed, values in enumerate(runs):
            log = tmp_path / f"seed{seed}" / name / "log.csv"
            log.parent.mkdir(parents=True)
            log.write_text("step,loss,psnr\n" + "".join(f"{k},0.1,{value}\n" for k, value in enumerate(values)))
    folders = [tmp_path / "seed0", tmp_path / "seed1"]
    best = chosen(arms, folders, best=True)
    assert best == {"n2n": {"n2n_gamma16": 33.0, "n2n_gamma2": 32.5}} and next(iter(best["n2n"])) == "n2n_gamma16"
    last = chosen(arms, folders, best=False)
    assert last == {"n2n": {"n2n_gamma16": 32.5, "n2n_gamma2": 30.5}}
    assert chosen({}, folders, True) == {}
