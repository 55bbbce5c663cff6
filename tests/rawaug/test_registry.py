"""Names: what is registered is found, what is not is refused with the nearest name, and old recipes still load."""

from __future__ import annotations

import math

import pytest

from denoisers.classical import FILTERS
from rawaug.data.pairs import DATASETS
from rawaug.experiment.settings import ArmConfig
from rawaug.isp.fit import FitConfig
from rawaug.noise import EldNoise, SensorNoise, noise_model
from rawaug.paper.baselines.base import BASELINES
from rawaug.registry import Registry, split_spec
from rawaug.training.config import TrainConfig
from rawaug.training.estimators import ESTIMATORS, R2R, Noisier
from rawaug.training.losses import LOSSES


def test_every_kind_finds_the_things_in_its_package() -> None:
    assert {"NonLocalMeans", "Wavelet", "TotalVariation", "BM3D", "KSVD", "WNNM", "GLIDE"} == set(FILTERS)
    assert {"demo", "fivek", "rawir", "sidd", "siddplus", "zurich"} <= set(DATASETS)
    assert {"supervised", "distilled", "noisier", "noise2noise", "r2r", "neighbor2neighbor"} == set(ESTIMATORS)
    assert {"l1", "l2", "rms", "log_mse"} == set(LOSSES)
    assert {name: method.name for name, method in BASELINES.items()} == {name: name for name in BASELINES}


def test_a_name_is_given_once_and_a_module_may_run_again() -> None:
    kinds = Registry("thing", "rawaug.things", "denoisers")
    kinds.register("a")(R2R)
    assert kinds.register("a")(R2R) is R2R and kinds["a"] is R2R and kinds.name_of(R2R) == "a"
    with pytest.raises(ValueError, match="'a'"):
        kinds.register("a")(Noisier)


def test_unknown_names_settings_and_types_are_refused_with_the_nearest() -> None:
    for spec, message in (
        ("r3r", r"estimator 'r3r' is unknown; use one of .*\(nearest: r2r\); one of your own"),
        ({"name": "r2r", "settings": {"alhpa": 1.0}}, r"estimator r2r has no setting 'alhpa'; .*\(nearest: alpha\)$"),
        ({"name": "r2r", "settings": {"alpha": "big"}}, "r2r: alpha must be float, got 'big'"),
        ({"name": "noisier", "settings": {"correct": 1}}, "noisier: correct must be bool, got 1"),
        ({"nmae": "r2r"}, "expected a name or {name: ..., key"),
    ):
        with pytest.raises(ValueError, match=message):
            ArmConfig(estimator=spec)
    with pytest.raises(ValueError, match="'camera'"):
        noise_model("EldNoise")
    with pytest.raises(KeyError, match="unknown"):
        DATASETS["nowhere"]


def test_noise_has_settings_by_name() -> None:
    sensor = noise_model({"name": "SensorNoise", "settings": {"levels": "upi", "row_var": [1e-7, 1e-5], "bits": 10}})
    assert isinstance(sensor, SensorNoise) and len(sensor.models) == 3
    eld = noise_model({"name": "EldNoise", "settings": {"camera": "SonyA7S2", "iso": 800}})
    assert isinstance(eld, EldNoise) and eld.law.iso == (800.0, 800.0)
    with pytest.raises(ValueError, match=r"ISO 1000000\.0 is outside"):
        noise_model({"name": "Google Pixel", "settings": {"iso": 1e6}})
    with pytest.raises(ValueError, match="'isso'"):
        noise_model({"name": "Google Pixel", "settings": {"isso": 100}})


def test_an_arm_names_its_estimator() -> None:
    estimator = ESTIMATORS.make({"name": "noisier", "settings": {"alpha": 0.7, "correct": True}})
    assert isinstance(estimator, Noisier) and (estimator.alpha, estimator.correct) == (0.7, True)
    assert split_spec(ArmConfig().estimator) == ("supervised", {})


def test_bounds_and_choices_hold_for_settings_made_in_python_too() -> None:
    for settings in ({"atoms": 0}, {"reach": 0.9}, {"mse_floor": -1.0}, {"tone": "straight"}, {"joint_steps": 0.5}):
        with pytest.raises(ValueError, match=next(iter(settings))):
            FitConfig(**settings)
    assert FitConfig(joint_steps=None, curve_steps=0).settled()
    for share in (-0.1, 1.0, math.nan):
        with pytest.raises(ValueError, match=r"train\.ema"):
            TrainConfig(ema=share)
    with pytest.raises(ValueError, match="zoom"):
        ArmConfig(zoom=0.5)
