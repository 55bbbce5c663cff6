"""What an arm is trained on."""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean

import pytest
import torch

from rawaug.bayer import CFA
from rawaug.commands.run import with_values
from rawaug.data import demo_pairs, demo_pictures
from rawaug.experiment.raw import RawTask
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.plugin.targets import Srgb, Target
from rawaug.training import sources
from rawaug.training.config import TrainConfig


@pytest.mark.parametrize(
    ("aim", "noisy", "clean"), [("rgb", (4, 16, 16), (3, 32, 32)), ("srgb", (3, 32, 32), (3, 32, 32))]
)
def test_other_targets_are_trained_and_watched_on(aim: Target, noisy: tuple[int, ...], clean: tuple[int, ...]) -> None:
    class Aimed(Recipe):
        target: Target = aim  # type: ignore[misc]

    arms = {"one": ArmConfig(1.0, srgb=Srgb(jpeg=(10, 10)) if aim == "srgb" else None), "other": ArmConfig(1.0)}
    recipe = Aimed(data=DataConfig(pairs=None), isp=ISPSource(), noise=(1e-4, 1e-6), arms=arms)
    recipe = replace(recipe, train=TrainConfig(crop=32))
    pictures = [picture[:, :96, :128] for picture in demo_pictures(2)]
    task = RawTask(recipe, DictionaryISP(), {"pairs": [], "validation": [], "pictures": pictures})
    one, other = (task.stream(arm, CFA.RGGB, seed=0)[0] for arm in recipe.arms)
    assert one.noisy.shape == one.variance.shape == noisy and one.clean.shape == clean
    assert torch.equal(one.noisy, other.noisy) == (aim == "rgb"), "through JPEG, if any"
    watched = task.validation(CFA.RGGB)[0]
    assert watched.noisy.shape == (1, *noisy) and watched.clean.shape == (1, *clean)


def test_a_target_that_an_arm_cannot_have_is_refused() -> None:
    class Developed(Recipe):
        target: Target = "srgb"  # type: ignore[misc]
        from_pictures = True

    with pytest.raises(ValueError, match=r"arms\.one: srgb"):
        Recipe(arms={"one": ArmConfig(1.0, srgb=Srgb(jpeg=(40, 95)))})
    content = {"arms": {"one": {"augmented": 1.0, "srgb": {"jpeg": [40, 101]}}}}
    with pytest.raises(ValueError, match=r"arms\.one\.srgb: .*jpeg"):
        with_values(Developed, content, "recipe")
    for arm in (ArmConfig(0.5), ArmConfig(1.0, estimator="noise2noise")):
        with pytest.raises(ValueError, match="targets"):
            Developed(arms={"one": arm})


def test_an_arm_sees_as_many_real_crops_with_further_ones_as_without() -> None:
    pairs = demo_pairs("train", count=2)
    arms = {"real": ArmConfig(batch=2)}
    for source in ("pictures", "own", "noise", "more"):
        arms[source] = ArmConfig(0.75, source=source)
    recipe = Recipe(arms=arms, noise=(1e-2, 1e-4), train=TrainConfig(crop=32, batch=8))
    frames = {"pairs": pairs[:1], "validation": [], "pictures": demo_pictures(1), "more": pairs[1:]}
    task = RawTask(recipe, DictionaryISP(), frames)

    known = pairs[0].noisy
    assert known is not None
    for label in arms:
        batch = recipe.loop(label).batch
        stream = task.stream(label, CFA.RGGB, seed=0)
        samples = stream.__getitems__(range(batch))
        captured = [sample for sample in samples if torch.isin(sample.noisy, known.mosaic).all()]
        assert len(captured) == 2, label
        assert len(samples) == batch

    with pytest.raises(ValueError, match=r"arms\.one: source: own"):
        Recipe(isp=ISPSource(), data=DataConfig(pairs=None), arms={"one": ArmConfig(1.0, source="own")})


def test_pairs_have_the_stated_psnr_whatever_the_isp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_CALIBRATED_ON", 96)
    source = ISPSource("phones")
    recipe = Recipe(data=DataConfig(pairs=None), isp=source, noise={"pair_psnr": 36.0}, arms={"one": ArmConfig(1.0)})
    recipe = replace(recipe, train=TrainConfig(crop=32))
    task = RawTask(recipe, source.load(), {"pairs": [], "validation": [], "pictures": demo_pictures(2)})
    stream = task.stream("one", CFA.RGGB, seed=0)
    decibels = [psnr(sample.noisy[None], sample.clean[None]).item() for sample in map(stream.__getitem__, range(96))]
    assert fmean(decibels) == pytest.approx(36.0, abs=2.0), "4 to 5 dB higher by the signal of universal"
