"""End-to-end training goes only as far as frames that are left out gain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch

from rawaug.data.pairs import Pair
from rawaug.isp.fit import FitConfig, fit_isp
from rawaug.isp.fit.descent import Descent, decibels
from rawaug.isp.fit.encoders import joint_steps, train_jointly
from rawaug.isp.fit.samples import sample_pixels
from rawaug.isp.model import DictionaryISP

CONFIG = FitConfig(steps=5, curve_steps=20, pixels=512, batch=128, shading="off", joint_steps=0, prior_steps=50)


@pytest.fixture(scope="module")
def frames(exact_pair: Callable[..., Pair]) -> list[Pair]:
    return [exact_pair(f"shot{k}", (1.6, 1.0, 1.7), k, size=(32, 40)) for k in range(3)]


@pytest.fixture
def isp(frames: list[Pair]) -> DictionaryISP:
    return fit_isp(frames, CONFIG, progress=False)


def trained(isp: DictionaryISP, frames: list[Pair], steps: int, learning_rate: float) -> None:
    """Looked at every 5 steps."""
    samples, shots = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    config, descent = replace(CONFIG, joint_steps=steps), Descent(None, "", 0, False, report_steps=5)
    train_jointly(isp, samples, shots, config, descent, learning_rate)


def test_the_watched_frame_gains(isp: DictionaryISP, frames: list[Pair]) -> None:
    assert "joint" not in isp.info
    with torch.no_grad():
        isp.gain.log_gains.add_(0.1)
    samples, shots = sample_pixels(frames, CONFIG.pixels, CONFIG.seed)
    before = decibels(isp, samples, shots, [0])
    trained(isp, frames, steps=20, learning_rate=1e-2)
    gain, info = decibels(isp, samples, shots, [0]) - before, isp.info["joint"]
    assert gain > 3.0 and info["gain_db"] == pytest.approx(gain, abs=0.006)
    assert info["steps"] == 20 and info["kept_step"] in (5, 10, 15, 20)


def test_where_every_step_is_worse_the_start_remains(isp: DictionaryISP, frames: list[Pair]) -> None:
    before = {key: value.clone() for key, value in isp.state_dict().items()}
    trained(isp, frames, steps=10, learning_rate=1.0)
    assert isp.info["joint"] == {"steps": 10, "kept_step": 0, "gain_db": 0.0}
    assert all(torch.equal(value, before[key]) for key, value in isp.state_dict().items())


def test_it_ends_a_fit_that_asks_for_it_and_one_of_many_frames(frames: list[Pair]) -> None:
    assert fit_isp(frames, replace(CONFIG, joint_steps=1), progress=False).info["joint"]["steps"] == 1
    by_itself = replace(CONFIG, joint_steps=None)
    assert [joint_steps(by_itself, count) for count in (3, 49, 50)] == [0, 0, 1000]
    assert joint_steps(replace(CONFIG, joint_steps=7), 100) == 7


def test_a_single_frame_leaves_none_to_watch(frames: list[Pair]) -> None:
    with pytest.raises(ValueError, match="two frames or more"):
        fit_isp(frames[:1], replace(CONFIG, joint_steps=5), progress=False)
