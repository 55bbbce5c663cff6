"""Noise at a stated PSNR: drawn pairs have it on average, and the law's shape is kept."""

from __future__ import annotations

import math

import pytest
import torch

from rawaug.metrics import psnr
from rawaug.noise import CalibratedNoise, noise_levels, noise_model
from rawaug.noise.models import NoiseModel


def measured(model: NoiseModel, clean: torch.Tensor) -> float:
    params = model.sample(len(clean), torch.Generator().manual_seed(1))
    return float(psnr(model.apply(clean, params), clean).mean())


def pictures(*signals: float) -> torch.Tensor:
    """1536 ramps ``(4, 12, 12)``, of these mean signals in turn."""
    ramp = torch.linspace(0.2, 1.8, 144).reshape(12, 12)
    means = torch.tensor(signals).repeat(1536 // len(signals))
    return means[:, None, None, None] * ramp.expand(4, 12, 12)


@pytest.mark.parametrize("levels", [(2e-3, 1e-5), (0.0, 1e-4), "cycleisp_sidd", "Google Pixel"])
@pytest.mark.parametrize("pair_psnr", [36.0, 41.18])
def test_pairs_have_the_stated_psnr(levels: str | tuple[float, float], pair_psnr: float) -> None:
    model = CalibratedNoise(pair_psnr, 0.1, levels)
    spread = 0.05 if isinstance(levels, tuple) else 0.5  # three standard errors of the law's own draws
    assert measured(model, pictures(0.1)) == pytest.approx(pair_psnr, abs=spread)


def test_pictures_of_different_light_have_it_on_average() -> None:
    signals = (0.01, 0.05, 0.3)
    model = CalibratedNoise(40.0, signals, (1e-3, 1e-6))
    assert measured(model, pictures(*signals)) == pytest.approx(40.0, abs=0.05)
    assert measured(model, pictures(0.01)) > 43.0 and measured(model, pictures(0.3)) < 37.0


def test_the_law_keeps_its_shape_and_the_calibration_is_the_same_each_time() -> None:
    one, again = (CalibratedNoise(41.18).sample(5, torch.Generator().manual_seed(2)) for _ in range(2))
    shot_var, read_var = noise_levels("cycleisp_sidd").sample(5, torch.Generator().manual_seed(2))
    assert torch.equal(one["shot_var"], again["shot_var"])
    ratio = one["shot_var"] / shot_var
    assert torch.allclose(ratio, ratio[0].expand(5)) and torch.allclose(one["read_var"] / read_var, ratio)


def test_what_cannot_be_calibrated_is_refused() -> None:
    with pytest.raises(ValueError, match="pair_psnr must be finite, got inf"):
        CalibratedNoise(math.inf)
    none: list[float] = []
    for signal in (0.0, 1.5, none):
        with pytest.raises(ValueError, match="signal: mean signals must be above 0 and at most 1"):
            CalibratedNoise(41.18, signal)
    with pytest.raises(ValueError, match="have no noise"):
        CalibratedNoise(41.18, 0.1, (0.0, 0.0))


def test_recipes_name_it_by_the_figure_alone() -> None:
    bare, full = (
        noise_model(spec)
        for spec in (
            {"pair_psnr": 41.18, "levels": "upi"},
            {"name": "CalibratedNoise", "settings": {"pair_psnr": 41.18, "levels": "upi"}},
        )
    )
    drawn = [model.sample(3, torch.Generator().manual_seed(0)) for model in (bare, full)]
    assert isinstance(bare, CalibratedNoise) and torch.equal(drawn[0]["shot_var"], drawn[1]["shot_var"])
    with pytest.raises(ValueError, match="signl"):
        noise_model({"pair_psnr": 41.18, "signl": 0.1})
