"""End-to-end training goes only as far as frames that are left out gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pair import Pair
from rawaug.isp.fit import FitConfig, descent, fit_isp, joint, pipeline
from rawaug.isp.fit.losses import decibels
from rawaug.isp.fit.samples import sample_pixels

CONFIG = FitConfig(steps=5, pixels=512, batch=128, shading="off", joint_steps=0)


@pytest.fixture(scope="module")
def frames(exact_pair: Callable[..., Pair]) -> list[Pair]:
    return [exact_pair(f"shot{k}", (1.6, 1.0, 1.7), k, size=(32, 40)) for k in range(3)]


@pytest.fixture(autouse=True)
def look_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(descent, "REPORT_STEPS", 5)
    monkeypatch.setattr(pipeline, "CURVE_STEPS", 20)


def test_the_watched_frame_gains(frames: list[Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint, "LEARNING_RATE", 1e-2)
    isp = fit_isp(frames, CONFIG, progress=False)
    assert "joint" not in isp.info
    with torch.no_grad():
        isp.gain.log_gains.add_(0.1)
    samples, shots = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    before = decibels(isp, samples, shots, [0])
    joint.train_jointly(isp, samples, shots, replace(CONFIG, joint_steps=20), descent.Descent(None, "", 0, False))
    gain, info = decibels(isp, samples, shots, [0]) - before, isp.info["joint"]
    assert gain > 3.0 and info["gain_db"] == pytest.approx(gain, abs=0.006)
    assert info["steps"] == 20 and info["kept_step"] in (5, 10, 15, 20)


def test_where_every_step_is_worse_the_start_remains(frames: list[Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint, "LEARNING_RATE", 1.0)
    before = fit_isp(frames, CONFIG, progress=False).state_dict()
    after = fit_isp(frames, replace(CONFIG, joint_steps=10), progress=False)
    assert after.info["joint"] == {"steps": 10, "kept_step": 0, "gain_db": 0.0}
    assert all(torch.equal(value, before[key]) for key, value in after.state_dict().items())


def test_many_frames_are_trained_jointly_by_themselves(frames: list[Pair], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joint, "STEPS", 1)
    by_itself = replace(CONFIG, joint_steps=None)
    assert "joint" not in fit_isp(frames, by_itself, progress=False).info
    monkeypatch.setattr(joint, "MANY_FRAMES", 3)
    assert fit_isp(frames, by_itself, progress=False).info["joint"]["steps"] == 1


def test_a_single_frame_leaves_none_to_watch(frames: list[Pair]) -> None:
    with pytest.raises(ValueError, match="two frames or more"):
        fit_isp(frames[:1], replace(CONFIG, joint_steps=5), progress=False)
