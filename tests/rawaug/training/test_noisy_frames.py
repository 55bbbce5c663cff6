"""Noisy frames alone: the noise of a picture is frozen for good, and nothing of a clean frame is left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA, noise_variance
from rawaug.data import demo_pairs, demo_photographs
from rawaug.data.pairs import Pair
from rawaug.evaluation.trials import Trial
from rawaug.experiment.raw import RawTask
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.noise import FixedLevels, SensorNoise
from rawaug.plugin.augment import RawAugment
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.estimators import R2R, Noise2Noise, Noisier, NoisyCrop, SelfSupervised
from rawaug.training.loop import train, validate
from rawaug.training.neighbor2neighbor import Neighbor2Neighbor
from rawaug.training.noisy_frames import (
    FrozenPictures,
    NoisyCrops,
    NoisyFrame,
    drop_clean,
    noisy_frame,
    r2r_trials,
    signal_estimate,
)
from rawaug.training.stream import TrainingStream

LEVELS = (0.01, 1e-3)


@pytest.fixture(scope="module")
def pictures() -> list[torch.Tensor]:
    return [photograph[:, :120, :160] for photograph in demo_photographs("train").values()]


@pytest.fixture(scope="module")
def augment() -> RawAugment:
    return RawAugment(DictionaryISP(), LEVELS)


class Whole(SelfSupervised):
    """Gives the crop as it comes."""

    adds_noise = True

    def apply(self, crop: NoisyCrop, drawn: torch.Tensor) -> Any:
        return crop


def test_two_epochs_see_the_same_base_noise(pictures: list[torch.Tensor], augment: RawAugment) -> None:
    """Every crop that an epoch draws is a piece of one noisy frame; with fresh noise it would not be."""
    known = set(FrozenPictures(pictures, augment, seed=3)[0].shots.flatten().tolist())
    for epoch in range(2):
        crops = NoisyCrops(FrozenPictures(pictures[:1], augment, seed=3), Whole(), 32, CFA.RGGB)
        for k in range(3):
            crop = crops.draw(torch.Generator().manual_seed(10 * epoch + k))
            assert set(crop.shots.flatten().tolist()) <= known


def test_frames_depend_on_seed_and_index_alone(pictures: list[torch.Tensor], augment: RawAugment) -> None:
    frames = FrozenPictures(pictures, augment, seed=3)
    _ = frames[0]
    assert torch.equal(frames[1].shots, FrozenPictures(pictures, augment, seed=3)[1].shots)
    assert not torch.equal(frames[1].shots, FrozenPictures(pictures, augment, seed=4)[1].shots)
    assert frames[1] is frames[1]
    assert (frames[0].shot_var, frames[0].read_var) == pytest.approx(LEVELS)


def test_two_shots_differ_by_independent_noise(pictures: list[torch.Tensor], augment: RawAugment) -> None:
    frame = FrozenPictures(pictures, augment, seed=0, shots=2)[0]
    first, second = frame.shots
    alone = FrozenPictures(pictures, augment, seed=0)[0]
    assert torch.equal(alone.shots[0], first)
    dark = (first + second) / 2 < 0.5
    expected = 2 * (frame.read_var + frame.shot_var * ((first + second) / 2).clamp_min(0))[dark].mean()
    assert float((first - second)[dark].var()) == pytest.approx(float(expected), rel=0.05)


def test_noise_of_unknown_levels_is_refused(pictures: list[torch.Tensor]) -> None:
    with pytest.raises(ValueError, match="shot_var and read_var"):
        FrozenPictures(pictures, RawAugment(DictionaryISP(), SensorNoise(FixedLevels(*LEVELS))), seed=0)


def test_a_self_supervised_recipe_never_meets_a_clean_frame(pictures: list[torch.Tensor]) -> None:
    """Its samples and its validation are the same whatever the clean frames are."""
    pairs = demo_pairs("train", count=2)
    spoilt = []
    for pair in pairs:
        black = replace(pair.clean, mosaic=0 * pair.clean.mosaic)
        spoilt.append(replace(pair, clean=black, srgb=0 * pair.srgb))
    recipe = Recipe(arms={"r2r": ArmConfig(0.5, estimator="r2r")}, train=TrainConfig(batch=2, crop=32))

    def seen(pairs: list[Pair]) -> list[torch.Tensor]:
        known = [drop_clean(pair) for pair in pairs]
        task = RawTask(recipe, DictionaryISP(), {"pairs": known, "validation": known, "pictures": pictures})
        stream = task.stream("r2r", pairs[0].cfa, seed=0)
        watched = task.validation(pairs[0].cfa)
        assert watched[0].develop is None
        return [*stream[0], *stream[1], watched[0].noisy, watched[0].clean, watched[0].variance]

    assert all(torch.equal(a, b) for a, b in zip(seen(pairs), seen(spoilt), strict=True))


def test_frames_as_shot_need_measured_levels() -> None:
    pair = replace(demo_pairs("train", count=1)[0], noisy=None)
    assert drop_clean(pair) is pair
    with pytest.raises(ValueError, match=r"train_00_astronaut: .*levels"):
        noisy_frame(pair, None)
    levels = [{"shot_var": 1e-3, "read_var": 1e-5}]
    law = {"name": "MeasuredNoise", "settings": {"camera": "Maker Model", "levels": levels}}
    assert noisy_frame(pair, law).read_var == 1e-5


def test_of_pictures_the_signal_is_known(pictures: list[torch.Tensor], augment: RawAugment) -> None:
    frame = FrozenPictures(pictures, augment, seed=3)[0]
    below_white = frame.signal < 0.6
    deviation = noise_variance(frame.signal, frame.shot_var, frame.read_var).sqrt()
    noise = ((frame.shots - frame.signal) / deviation)[below_white]
    assert float(noise.mean()) == pytest.approx(0.0, abs=0.03) and float(noise.var()) == pytest.approx(1.0, rel=0.05)


def test_held_out_frames_are_recorrupted_at_their_signal() -> None:
    clean = torch.full((1, 128, 128), 0.02)
    shot = clean + 0.02 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    (sample,) = r2r_trials([NoisyFrame("known", shot, 8e-3, 3e-4, CFA.RGGB, clean)], CFA.RGGB)
    added = (sample.noisy - bayer.pack(shot[None], CFA.RGGB)) / (0.5 * (8e-3 * 0.02 + 3e-4) ** 0.5)
    assert float(added.var()) == pytest.approx(1.0, rel=0.03)


def test_held_out_frames_have_noise_of_their_own_by_name() -> None:
    scene = torch.full((1, 32, 32), 0.2)
    first, other, again = (
        r2r_trials([NoisyFrame(name, scene, 8e-3, 3e-4, CFA.RGGB, scene)], CFA.RGGB)[0] for name in ("a", "b", "a")
    )
    assert torch.equal(first.noisy, again.noisy)
    noise, others = ((sample.noisy - 0.2).flatten() for sample in (first, other))
    assert abs(torch.corrcoef(torch.stack([noise, others]))[0, 1].item()) < 0.15


def test_real_frames_are_estimated_once_and_only_for_estimators_that_add_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    estimated: list[int] = []

    def counted(noisy: torch.Tensor, *_: Any) -> torch.Tensor:
        estimated.append(1)
        return noisy

    monkeypatch.setattr("rawaug.training.noisy_frames.signal_estimate", counted)
    frame = NoisyFrame("real", torch.rand(1, 40, 48), 1e-3, 1e-5, CFA.RGGB)
    NoisyCrops([frame], Neighbor2Neighbor(), 16, CFA.RGGB).draw(torch.Generator())
    assert not estimated
    for estimator in (R2R(), Noisier()):
        NoisyCrops([frame], estimator, 16, CFA.RGGB).draw(torch.Generator())
    assert len(estimated) == 1


def test_what_an_estimator_lacks_is_named() -> None:
    frame = NoisyFrame("small", torch.zeros(1, 32, 32), 1e-3, 1e-5, CFA.RGGB)
    with pytest.raises(ValueError, match=r"small: .*Noise2Noise"):
        NoisyCrops([frame], Noise2Noise(), 16, CFA.RGGB).draw(torch.Generator())
    with pytest.raises(ValueError, match=r"small: .*small"):
        NoisyCrops([frame], R2R(), 32, CFA.RGGB).draw(torch.Generator())


def test_the_held_out_score_ranks_as_clean_frames_do() -> None:
    """Scores against held-out noisy targets order blends of noisy and clean as their true errors do."""
    pair = demo_pairs("validation", count=1)[0]
    frame = noisy_frame(drop_clean(pair), None)
    (sample,) = r2r_trials([frame], pair.cfa)
    clean = bayer.pack(pair.clean.mosaic[None], pair.cfa)
    errors = [float(((1 - t) * clean + t * sample.noisy - sample.clean).square().mean()) for t in (0.0, 0.1, 0.3, 1.0)]
    assert errors == sorted(errors)
    (again,) = r2r_trials([frame], pair.cfa)
    assert torch.equal(again.clean, sample.clean)


def test_without_validation_pairs_pictures_are_watched(pictures: list[torch.Tensor]) -> None:
    recipe = Recipe(
        data=DataConfig(pairs=None, validation=None),
        isp=ISPSource(),
        noise=LEVELS,
        arms={"convex": ArmConfig(1.0)},
        train=TrainConfig(crop=32),
    )
    task = RawTask(recipe, DictionaryISP(), {"pairs": [], "validation": [], "pictures": pictures})
    samples = task.validation(CFA.RGGB)
    assert len(samples) == 16 and samples[0].noisy.shape == (1, 4, 16, 16)


@pytest.mark.parametrize(
    "estimator",
    [Noisier(1.0), Noisier(1.0, correct=True), Noise2Noise(), R2R(0.5), Neighbor2Neighbor(1.0)],
    ids=["noisier", "noisier_corrected", "noise2noise", "r2r", "neighbor2neighbor"],
)
def test_each_estimator_learns_to_denoise_from_one_noisy_frame(estimator: SelfSupervised, tmp_path: Path) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 6, 128), torch.linspace(0, 6, 128), indexing="ij")
    clean = (0.4 + 0.15 * torch.sin(x) * torch.cos(y)).expand(3, -1, -1)
    shots = clean + torch.randn(3, 128, 128, generator=torch.Generator().manual_seed(0)) * (0.01 * clean + 1e-3).sqrt()
    frame = NoisyFrame("smooth", shots[:2], 0.01, 1e-3, CFA.RGGB)
    stream = TrainingStream(NoisyCrops([frame], estimator, 32, CFA.RGGB), None, 4, 0.0, seed=0)
    config = TrainConfig(steps=80, batch=4, crop=32, learning_rate=5e-3, warmup=5, loss="l2", ema=0.9)
    network = DenoiserConfig("UNet", {"width": 8, "scales": 2})
    frames = r2r_trials([frame], CFA.RGGB)
    net = train(stream, frames, network, config, tmp_path, device="cpu", estimator=estimator)
    packed, unseen = (bayer.pack(image[None], CFA.RGGB) for image in (clean[2:], shots[2:]))
    sample = Trial(unseen, packed, noise_variance(unseen, 0.01, 1e-3))
    assert validate(net, [sample], torch.device("cpu"))["psnr"] > float(psnr(unseen, packed)) + 1.0


def test_r2rs_target_hardly_depends_on_the_noise_of_its_input() -> None:
    """What of the target a cubic in the input's noise explains, in standard deviations of the noise."""
    pair = demo_pairs("validation", count=1)[0]
    deviation = (8e-3 * pair.clean.mosaic + 3e-4).sqrt()
    noisy = pair.clean.mosaic + deviation * torch.randn(
        pair.clean.mosaic.shape, generator=torch.Generator().manual_seed(0)
    )
    clean, shot, sd = (bayer.pack(mosaic[None], pair.cfa)[0] for mosaic in (pair.clean.mosaic, noisy, deviation))

    def explained(signal: torch.Tensor) -> float:
        crop = NoisyCrop(shot[None], bayer.pack(signal[None], pair.cfa)[0], 8e-3, 3e-4)
        estimator = R2R()
        sample = estimator.apply(crop, estimator.sample(shot.shape, torch.Generator().manual_seed(1)))
        noise, error = (((x - clean) / sd).flatten().double() for x in (sample.noisy, sample.clean))
        powers = noise[:, None] ** torch.arange(4)
        return float((powers @ torch.linalg.lstsq(powers, error[:, None]).solution).square().mean().sqrt())

    assert explained(pair.clean.mosaic) < 0.05, "the true signal"
    assert explained(signal_estimate(noisy, 8e-3, 3e-4, pair.cfa)) < 0.1
    assert explained(noisy) > 0.2, "the noisy signal"


def test_the_estimate_is_nearer_to_the_scene_than_the_frame_finite_and_left_out_without_shot_noise() -> None:
    pair = demo_pairs("validation", count=1)[0]
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    estimate = signal_estimate(pair.noisy.mosaic, *pair.noisy.noise_profile, pair.cfa)
    before, after = ((x - pair.clean.mosaic).square().mean() for x in (pair.noisy.mosaic, estimate))
    assert after < 0.7 * before
    dark = 1e-2 * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
    for frame in (dark, 0 * dark):
        assert signal_estimate(frame, 1e-6, 1e-4, CFA.RGGB).isfinite().all()
    assert signal_estimate(dark, 0.0, 3e-4, CFA.RGGB) is dark
