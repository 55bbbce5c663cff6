"""What a run uses of what: the user's own pairs, held-out frames, and what is refused before anything is fitted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rawaug.bayer import bin_mosaic
from rawaug.cli import main
from rawaug.data import Pair, demo_pairs
from rawaug.data.frames import as_frames
from rawaug.experiment.data import name_given_pairs, open_frames, read_frames, require_usable, use_all_pairs
from rawaug.experiment.recipe import find_recipe, read_recipe, recipe_list, shipped_recipes
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.io import RawFrame, write_picture
from rawaug.training.config import TrainConfig

ARMS = {"real": ArmConfig()}


def write_pairs(folder: Path, names: list[str]) -> Path:
    """Noisy/clean pairs of 64 x 80, as NPZ with all that they can state."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for name in names:
        clean = np.kron(rng.uniform(0.05, 0.6, (4, 8, 10)), np.ones((1, 4, 4))).astype(np.float32)
        noisy = clean + rng.normal(0, 0.01, clean.shape).astype(np.float32)
        colour: dict[str, Any] = {"white_balance": [2.0, 1.0, 1.5], "color_matrix": np.eye(3)}
        np.savez(folder / f"{name}.npz", clean=clean, noisy=noisy, cfa="GRBG", shot_var=1e-6, read_var=1e-4, **colour)
    return folder


@pytest.fixture
def own(tmp_path: Path) -> Path:
    return write_pairs(tmp_path / "own", [f"shot{k}" for k in range(7)])


@pytest.fixture
def data(tmp_path: Path) -> DataConfig:
    """Two frames to test on and two pictures."""
    (tmp_path / "pictures").mkdir()
    for k in range(2):
        write_picture(tmp_path / "pictures" / f"{k}.png", torch.rand(3, 48, 48, generator=torch.manual_seed(k)))
    test = write_pairs(tmp_path / "test", ["a", "b"])
    return DataConfig(count=2, test=f"pairs:{test}", pictures=str(tmp_path / "pictures"))


def opened(recipe: Recipe, **given: Any) -> dict[str, Any]:
    frames, _ = open_frames(name_given_pairs(recipe, given), given)
    return frames


def test_own_pairs_are_all_used_and_a_part_of_them_is_held_out(own: Path, data: DataConfig) -> None:
    content = read_recipe(find_recipe("fewshot"))
    shipped = Recipe(arms=ARMS, data=data)
    mine = replace(shipped, data=replace(shipped.data, pairs=f"pairs:{own}"))
    assert use_all_pairs(shipped, content, set()) == shipped
    reset = use_all_pairs(mine, content, {"data.pairs"}).data
    assert (reset.count, reset.validation, reset.test) == (None, "auto", data.test)
    kept = use_all_pairs(mine, content, {"data.pairs", "data.count", "data.validation"}).data
    assert (kept.count, kept.validation) == (2, "demo:validation")  # as the command line says
    unwatched = replace(mine, data=replace(mine.data, validation=None))
    assert use_all_pairs(unwatched, content, {"data.pairs"}).data.validation is None

    elsewhere = Recipe(arms=ARMS, data=DataConfig(pairs="sidd:/elsewhere", count=56, validation=None))
    assert use_all_pairs(elsewhere, read_recipe(find_recipe("sidd/fewshot")), {"data.pairs"}) == elsewhere

    recipe = use_all_pairs(mine, content, {"data.pairs"})
    frames, lines = open_frames(recipe, {})
    assert as_frames(frames["pairs"]).names == [f"shot{k}" for k in range(6)] and as_frames(
        frames["validation"]
    ).names == ["shot6"]
    train, validate, test, pictures, isp = lines
    assert train.startswith(f"train     6 of 7 of pairs:{own}: shot0,")
    assert validate == f"validate  1 of 7 of pairs:{own}, held out: shot6"
    assert test.endswith("test: a, b") and "2 of " in pictures and isp.endswith("fitted to 6 frames")


def test_damaged_frames_are_named_and_the_rest_is_used(own: Path, data: DataConfig, tmp_path: Path) -> None:
    recipe = Recipe(arms=ARMS, data=replace(data, pairs=f"pairs:{own}", count=None, validation="auto"))
    whole, none = read_frames(recipe, opened(recipe))
    assert none == [] and as_frames(whole["pairs"]).names == [f"shot{k}" for k in range(6)]
    assert as_frames(whole["test"]).stamps() == as_frames(opened(recipe)["test"]).stamps()
    (own / "shot1.npz").write_bytes(b"damaged")
    (tmp_path / "test" / "b.npz").write_bytes((tmp_path / "test" / "b.npz").read_bytes()[:300])
    read, lines = read_frames(recipe, opened(recipe))
    assert as_frames(read["pairs"]).names == ["shot0", "shot2", "shot3", "shot4", "shot5"] and as_frames(
        read["test"]
    ).names == ["a"]
    assert lines[0] == "left out of data.pairs: 1 of 6 frames, unreadable" and "shot1.npz" in lines[1]
    assert lines[2] == "left out of data.test: 1 of 2 frames, unreadable" and "b.npz" in lines[3] and len(lines) == 4
    (own / "shot6.npz").write_bytes(b"damaged")  # all that is held out
    with pytest.raises(ValueError, match="shot6"):
        read_frames(recipe, opened(recipe))


def test_limits_of_reading_are_keys_of_data(data: DataConfig, tmp_path: Path) -> None:
    assert len(opened(Recipe(arms=ARMS, data=data, train=TrainConfig(crop=16)))["pictures"][0]) == 3
    small = Recipe(arms=ARMS, data=replace(data, max_pixels=1000), train=TrainConfig(crop=16))
    with pytest.raises(ValueError, match="pixels"):
        opened(small)["pictures"][0]
    with pytest.raises(ValueError, match=r"data\.max_pixels"):
        DataConfig(max_pixels=0)


def test_pairs_from_python_are_divided_and_seen_by_their_content(data: DataConfig) -> None:
    pairs, test = demo_pairs("train"), demo_pairs("test", count=2)
    recipe = Recipe(arms=ARMS, data=replace(data, count=None, test_count=1, validation_crop=None, test_crop=None))
    frames = opened(recipe, pairs=pairs, test=test)
    assert list(frames["pairs"]) == pairs[:4] and list(frames["validation"]) == pairs[4:]
    assert list(frames["test"]) == test[:1]
    other = replace(pairs[4], clean=replace(pairs[4].clean, mosaic=pairs[4].clean.mosaic * 0.5))
    changed = opened(recipe, pairs=[*pairs[:4], other], test=test)
    assert as_frames(frames["validation"]).stamps() != as_frames(changed["validation"]).stamps()
    assert as_frames(frames["pairs"]).stamps() == as_frames(changed["pairs"]).stamps()
    single = opened(recipe, pairs=pairs[:1])
    assert len(single["pairs"]) == 1 and not single["validation"], "nothing is held out"
    _, lines = open_frames(name_given_pairs(recipe, {"pairs": pairs[:1]}), {"pairs": pairs[:1]})
    assert "final weights are kept" in lines[1]
    with pytest.raises(ValueError, match=r"data\.test: .*train_00_astronaut"):
        opened(recipe, pairs=pairs, test=pairs[:1])
    assert (
        as_frames(opened(recipe, pairs=pairs, validation=test[1:], test=test[:1])["pairs"]).names
        == as_frames(pairs).names
    )


def test_validation_and_test_frames_are_binned_and_cropped_and_training_frames_are_not(data: DataConfig) -> None:
    shots = {split: demo_pairs(split, count=1) for split in ("train", "validation", "test")}
    given = {"pairs": shots["train"], "validation": shots["validation"], "test": shots["test"]}
    recipe = Recipe(arms=ARMS, data=replace(data, bin=4, validation_crop=None, test_crop=32))
    frames = opened(recipe, **given)
    (watched,) = shots["validation"]
    assert torch.equal(frames["validation"][0].clean.mosaic, bin_mosaic(watched.clean.mosaic, watched.cfa, 4))
    assert frames["test"][0].clean.mosaic.shape == (1, 32, 32) and frames["pairs"][0] is shots["train"][0]


def test_two_folders_may_use_the_same_names(own: Path, data: DataConfig, tmp_path: Path) -> None:
    more = write_pairs(tmp_path / "more", ["shot0"])
    mine = replace(data, pairs=f"pairs:{own}", validation="auto", test=f"pairs:{more}")
    assert as_frames(opened(Recipe(arms=ARMS, data=mine))["test"]).names == ["shot0"]
    with pytest.raises(ValueError, match="pairs"):
        opened(Recipe(arms=ARMS, data=replace(mine, test=f"pairs:{own}")))


def test_what_frames_lack_is_found_before_anything_is_fitted() -> None:
    flat = RawFrame(torch.zeros(1, 72, 72), "RGGB")
    pair = Pair("a", flat, torch.zeros(3, 72, 72, dtype=torch.uint8), flat)
    recipe = Recipe(arms={"r2r": ArmConfig(estimator="r2r")}, data=DataConfig())
    with pytest.raises(ValueError, match="levels"):
        require_usable(recipe, [pair], [])
    require_usable(replace(recipe, noise="camera"), [pair], [])
    twice = replace(recipe, arms={"two": ArmConfig(estimator="noise2noise")})
    with pytest.raises(ValueError, match=r"arms\.two.*2 shots"):
        require_usable(twice, [pair], [])
    supervised = Recipe(arms=ARMS, data=DataConfig())
    with pytest.raises(ValueError, match="small"):
        require_usable(replace(supervised, train=replace(supervised.train, crop=68)), [pair], [])
    require_usable(replace(supervised, train=replace(supervised.train, crop=66)), [pair], [])
    with pytest.raises(ValueError, match="white balance"):
        require_usable(supervised, [replace(pair, clean=replace(pair.clean, color_known=False))], [])
    require_usable(replace(supervised, isp=ISPSource(), train=replace(supervised.train, crop=66)), [pair], [])


def test_settings_of_pairs_need_pairs() -> None:
    with pytest.raises(ValueError, match=r"data\.noisy"):
        DataConfig(noisy="*_NOISY_*")
    with pytest.raises(ValueError, match="pairs"):
        DataConfig(pairs=None, validation="auto")
    assert DataConfig(test="pairs:x", cfa="RGGB").pair_settings("pairs:x")["cfa"] == "RGGB"


def test_recipes_are_listed_and_explained_with_their_own_values(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run"]) == 0
    lines = recipe_list().splitlines()
    assert recipe_list() in capsys.readouterr().out
    assert len(lines) == len(shipped_recipes()) >= 10 and all(len(line.split(maxsplit=1)[1]) > 30 for line in lines)
    for name, value in (("unsupervised", " 4000"), ("base", '"DRUNet"')):
        assert main(["run", name, "--help"]) == 0
        shown = capsys.readouterr().out
        assert value in shown and "--train.learning-rate" in shown and "--arms.NAME.augmented" in shown
        assert ":class:" not in shown
        words = " ".join(shown.split())
        for bounds in (
            "At least 1.",
            "From 1 to 1000.",
            "From 0.0 to 1.0.",
            "From 1 to 16.",
            "At least 0.0 and below 1.0.",
        ):
            assert bounds in words


def test_an_arm_has_a_rate_and_a_weighing_of_its_own_and_at_most_its_own_steps() -> None:
    tuned = ArmConfig(learning_rate=3e-4, weigh="stabilised", steps=10)
    train = TrainConfig(steps=40, learning_rate=7e-4, weigh="mixed")
    recipe = Recipe(isp=ISPSource(), train=train, arms={"a": ArmConfig(), "b": tuned, "c": ArmConfig(steps=90)})
    a, b, c = (recipe.loop(arm) for arm in recipe.arms)
    assert (a.steps, a.learning_rate, a.weigh) == (c.steps, c.learning_rate, c.weigh) == (40, 7e-4, "mixed")
    assert (b.steps, b.learning_rate, b.weigh) == (10, 3e-4, "stabilised")
    with pytest.raises(ValueError, match="steps"):
        ArmConfig(steps=0)


@pytest.mark.parametrize(
    ("pairs", "validation"),
    [("demo:train", "demo:validation"), (None, "demo:validation"), ("pairs:x", "auto"), ("RAW_DIR", "auto")],
)
def test_own_frames_are_validated_on_themselves(pairs: str | None, validation: str) -> None:
    assert DataConfig(pairs=pairs).validation == validation
    assert DataConfig(pairs=pairs, validation=None).validation is None
    assert DataConfig(pairs=pairs, validation="demo:validation").validation == "demo:validation"
