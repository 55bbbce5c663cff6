"""Pictures of pairs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rawaug.data import demo_pairs
from rawaug.data.pairs import PairPictures
from rawaug.experiment.plan import planned
from rawaug.experiment.recipe import ArmConfig, DataConfig, Recipe


def test_a_recipe_augments_the_pictures_of_the_pairs_that_it_trains_on() -> None:
    pairs, test = demo_pairs("train", count=3), demo_pairs("test", count=1)
    data = DataConfig(count=2, pictures="pairs", validation=None)
    recipe = Recipe(data=data, arms={"ours": ArmConfig(augmented=0.5)})
    plan = planned(recipe, {"pairs": pairs, "test": test})
    assert isinstance(plan.pictures, PairPictures) and len(plan.pictures) == 2 == len(plan.pictures[:])
    assert torch.equal(plan.pictures[1], pairs[1].srgb)
    with pytest.raises(ValueError, match=r"data\.pictures: pairs takes those of data\.pairs, which is null"):
        replace(data, pairs=None)
