"""Encoders and end-to-end training are kept only where frames left out gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, end_to_end, fit_isp, pipeline
from rawaug.isp.fit.atoms import measure_lights
from rawaug.isp.fit.descent import Descent, mean_psnr
from rawaug.isp.fit.end_to_end import joint_steps, train_jointly
from rawaug.isp.fit.samples import FitFrames, sample_pixels
from rawaug.isp.fit.start import FrameColour
from rawaug.isp.model import DictionaryISP
from rawaug.isp.stages import LensShading

LIGHTS = [(1.6, 1.0, 1.9), (1.9, 1.0, 1.6)]
SETTINGS = {"encoder_widths": (8, 8, 16)}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    quick = {
        "FRAMES_A_STEP": 2,
        "ENCODER_PIXELS": 64,
        "ENCODER_RATE": 1.5e-2,
        "FOLDS": 2,
        "PUBLISHED_RATE": 1e-2,
        "PUBLISHED_FRAMES": 4,
    }
    for name, value in quick.items():
        monkeypatch.setattr(end_to_end, name, value)


def config(wanted: str, encoder_steps: int = 30) -> FitConfig:
    """With ``mse_floor`` the constants are a compromise between the two lights, not one of them."""
    few = {"steps": 0, "curve_steps": 20, "pixels": 512, "batch": 64, "mse_floor": 1e-3, "prior_steps": 40}
    settings: dict[str, Any] = {**few, "encoder_steps": encoder_steps, "encoders": wanted}
    return FitConfig(atoms=2, reach=1.0, shading="off", isp=SETTINGS, **settings)


def lit_frames(exact_pair: Callable[..., Pair], count: int, informative: bool) -> list[Pair]:
    """Tiny frames in one of two lights. Brightness shows which, or misleads every other time."""
    pairs = []
    for k in range(count):
        colours = torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(k)).repeat_interleave(4, 1)
        light = k // 2 % 2
        bright = light if informative or k % 2 else 1 - light
        picture = colours.repeat_interleave(4, 2) * 0.4 + (0.45 if bright else 0.15)
        pairs.append(exact_pair(f"shot{k}", LIGHTS[light], k, picture=picture))
    return pairs


def test_on_they_look_at_the_picture(exact_pair: Callable[..., Pair]) -> None:
    pairs = lit_frames(exact_pair, 4, informative=True)
    isp = fit_isp(pairs, config("on"), progress=False)
    assert isp.config.encoders
    dark, bright = (isp.choose(pairs[k].srgb[None]).gains[0] for k in (0, 2))
    assert dark[0] < bright[0] - 0.01 and dark[2] > bright[2] + 0.01
    theirs = isp.choose_forward(torch.rand(1, 3, 8, 8)).gain_weights
    assert not torch.allclose(theirs, isp.choose_forward(0.1 * torch.rand(1, 3, 8, 8)).gain_weights)


def test_auto_leaves_the_constants_to_few_frames(exact_pair: Callable[..., Pair]) -> None:
    isp = fit_isp(lit_frames(exact_pair, 4, informative=True), config("auto"), progress=False)
    assert not isp.config.encoders and "encoders_gain_db" not in isp.info


def test_auto_keeps_them_where_the_picture_shows_the_light(exact_pair: Callable[..., Pair]) -> None:
    isp = fit_isp(lit_frames(exact_pair, 12, informative=True), config("auto"), progress=False)
    assert isp.config.encoders and isp.info["encoders_gain_db"] > 1.0


def test_auto_drops_them_where_it_does_not(exact_pair: Callable[..., Pair]) -> None:
    pairs = lit_frames(exact_pair, 12, informative=False)
    isp = fit_isp(pairs, config("auto"), progress=False)
    assert not isp.config.encoders and isp.info["encoders_gain_db"] < -0.2
    off = fit_isp(pairs, config("off"), progress=False)
    assert all(torch.equal(value, off.state_dict()[key]) for key, value in isp.state_dict().items())


def test_frames_that_judge_were_left_out_of_curve_tone_and_atoms_too(
    exact_pair: Callable[..., Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = config("auto", encoder_steps=1)
    monkeypatch.setattr(end_to_end, "FEWEST_FRAMES", 4)
    fitted: list[set[str]] = []
    judged: list[tuple[set[str], set[str]]] = []

    fit_reverse = pipeline.fit_reverse

    def noted(frames: FitFrames, *args: Any, **settings: Any) -> tuple[DictionaryISP, FrameColour]:
        isp, colour = fit_reverse(frames, *args, **settings)
        assert len(frames.pixels.srgb) == len(colour.matrix) == len(frames.shots)
        fitted.append({shot.name for shot in frames.shots})
        return isp, colour

    def mean_psnr(isp: DictionaryISP, frames: FitFrames) -> float:
        judged.append((fitted[-1], {shot.name for shot in frames.shots}))
        return 0.0

    monkeypatch.setattr(pipeline, "fit_reverse", noted)
    monkeypatch.setattr(end_to_end, "mean_psnr", mean_psnr)
    fit_isp(lit_frames(exact_pair, 4, informative=True), settings, progress=False)
    everything = {f"shot{k}" for k in range(4)}
    assert fitted[0] == everything and len(fitted) == 3 and len(judged) == 4
    for seen, scored in judged:
        assert scored and not seen & scored and seen | scored == everything


CONFIG = FitConfig(steps=5, curve_steps=20, pixels=512, batch=128, shading="off", joint_steps=0, prior_steps=50)


@pytest.fixture(scope="module")
def frames(exact_pair: Callable[..., Pair]) -> list[Pair]:
    return [exact_pair(f"shot{k}", (1.6, 1.0, 1.7), k, size=(32, 40)) for k in range(3)]


@pytest.fixture
def isp(frames: list[Pair]) -> DictionaryISP:
    return fit_isp(frames, CONFIG, progress=False)


@pytest.fixture
def trained(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """End-to-end training of an ISP on frames, looked at every 5 steps."""
    monkeypatch.setattr(Descent, "report_steps", 5)

    def train(isp: DictionaryISP, frames: FitFrames, steps: int, learning_rate: float) -> None:
        monkeypatch.setattr(end_to_end, "LEARNING_RATE", learning_rate)
        train_jointly(isp, frames, replace(CONFIG, joint_steps=steps), Descent(None, "", 0, False))

    return train


def test_the_watched_frame_gains(
    isp: DictionaryISP, frames: list[Pair], trained: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(end_to_end, "CURVE_POINTS", 3)
    assert "joint" not in isp.info
    with torch.no_grad():
        isp.gain.log_gains.add_(0.1)
    drawn = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    before = mean_psnr(isp, drawn.some([0]))
    trained(isp, drawn, steps=20, learning_rate=1e-2)
    gain, info = mean_psnr(isp, drawn.some([0])) - before, isp.info["joint"]
    assert gain > 3.0 and info["gain_db"] == pytest.approx(gain, abs=0.006)
    assert info["steps"] == 20 and info["kept_step"] in (5, 10, 15, 20)
    first, _, last = info["curve"]  # of five scores
    assert first == pytest.approx(before, abs=0.006)
    assert (last == pytest.approx(before + gain, abs=0.006)) == (info["kept_step"] == 20)


def test_where_every_step_is_worse_the_start_remains(
    isp: DictionaryISP, frames: list[Pair], trained: Callable[..., None]
) -> None:
    before = {key: value.clone() for key, value in isp.state_dict().items()}
    trained(isp, sample_pixels(frames, CONFIG.pixels, CONFIG.seed), steps=10, learning_rate=1.0)
    record = isp.info["joint"]
    assert (record["steps"], record["kept_step"], record["gain_db"]) == (10, 0, 0.0)
    assert record["curve"][0] == max(record["curve"])
    assert all(torch.equal(value, before[key]) for key, value in isp.state_dict().items())


def test_as_shot_gains_know_the_atoms_that_training_has_moved(
    isp: DictionaryISP, frames: list[Pair], trained: Callable[..., None]
) -> None:
    drawn = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    before = mean_psnr(isp, drawn, as_shot=True)
    with torch.no_grad():
        isp.gain.log_gains.add_(0.2)  # makes the descent move everything
    trained(isp, drawn, steps=60, learning_rate=1e-2)
    assert isp.info["joint"]["kept_step"] > 0
    assert mean_psnr(isp, drawn, as_shot=True) > before - 5.0


def test_lights_of_atoms_are_measured(isp: DictionaryISP, frames: list[Pair]) -> None:
    drawn = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    before = mean_psnr(isp, drawn, as_shot=True)
    gamma = isp.stages["gamma"].reverse_gamma
    assert isinstance(gamma, torch.Tensor)
    with torch.no_grad():
        gamma.add_(0.1)
        isp.colour.matrices.mul_(torch.tensor([1.0, 1.2, 0.9])[:, None])
        isp.colour.neutral.add_(0.3)
    spoilt = mean_psnr(isp, drawn, as_shot=True)
    measure_lights(isp, drawn)
    assert spoilt < before - 10.0
    assert mean_psnr(isp, drawn, as_shot=True) > spoilt + 8.0


def test_it_ends_a_fit_that_asks_for_it_and_one_of_many_frames(frames: list[Pair]) -> None:
    assert fit_isp(frames, replace(CONFIG, joint_steps=1), progress=False).info["joint"]["steps"] == 1
    by_itself = replace(CONFIG, joint_steps=None)
    assert [joint_steps(by_itself, count) for count in (3, 49, 50)] == [0, 0, 1000]
    assert joint_steps(replace(CONFIG, joint_steps=7), 100) == 7


def test_a_single_frame_leaves_none_to_watch(frames: list[Pair]) -> None:
    with pytest.raises(ValueError, match="two frames"):
        fit_isp(frames[:1], replace(CONFIG, joint_steps=5), progress=False)


def test_the_published_fit_learns_encoders_and_both_masks_end_to_end(exact_pair: Callable[..., Pair]) -> None:
    pairs = lit_frames(exact_pair, 8, informative=True)
    settings: dict[str, Any] = {"pixels": 512, "batch": 64, "atoms": 2, "reach": 1.0, "isp": SETTINGS}
    short = FitConfig(method="published", steps=0, curve_steps=20, prior_steps=40, joint_steps=40, **settings)
    isp = fit_isp(pairs, short, progress=False)
    assert isp.config.encoders and isp.config.attention and isp.config.stages[-1] == "shading"
    assert isp.info["joint"]["steps"] == 40 and isp.info["joint"]["kept_step"] > 0
    chosen = [isp.choose(pairs[k].srgb[None]) for k in (0, 2)]
    assert not torch.allclose(chosen[0].colour_weights, chosen[1].colour_weights)
    lens = isp.stages.find(LensShading)
    assert lens is not None and lens.reverse_attention is not None
    assert lens.reverse_attention.place_layers[-1].weight.abs().max() > 0  # type: ignore[operator]


def test_the_method_settles_what_belongs_to_it() -> None:
    settled = FitConfig(method="published").settled()
    assert (settled.encoders, settled.shading, settled.attention, settled.tone) == ("on", "on", True, "learned")
    assert settled.joint_steps == 3000 and FitConfig().settled() == FitConfig()
    with pytest.raises(ValueError, match="method"):
        FitConfig(method="other")  # type: ignore[arg-type]
