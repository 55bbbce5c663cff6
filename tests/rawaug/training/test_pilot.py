"""The first estimate of a frame's signal: noise put on top at it does not follow the noise that is there."""

from __future__ import annotations

import pytest
import torch

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import demo_pairs
from rawaug.training.estimators import R2R, NoisyCrop
from rawaug.training.noisy_frames import first_estimate

SHOT_VAR, READ_VAR = 8e-3, 3e-4


def test_r2rs_target_hardly_depends_on_the_noise_of_its_input() -> None:
    """What of the target a cubic in the input's noise explains, in standard deviations of the noise."""
    pair = demo_pairs("validation", count=1)[0]
    deviation = (SHOT_VAR * pair.raw + READ_VAR).sqrt()
    noisy = pair.raw + deviation * torch.randn(pair.raw.shape, generator=torch.Generator().manual_seed(0))
    clean, shot, sd = (bayer.pack(mosaic[None], pair.cfa)[0] for mosaic in (pair.raw, noisy, deviation))

    def explained(signal: torch.Tensor) -> float:
        crop = NoisyCrop(shot[None], bayer.pack(signal[None], pair.cfa)[0], SHOT_VAR, READ_VAR)
        estimator = R2R()
        sample = estimator.apply(crop, estimator.sample(shot.shape, torch.Generator().manual_seed(1)))
        noise, error = (((x - clean) / sd).flatten().double() for x in (sample.noisy, sample.clean))
        powers = noise[:, None] ** torch.arange(4)
        return float((powers @ torch.linalg.lstsq(powers, error[:, None]).solution).square().mean().sqrt())

    assert explained(pair.raw) < 0.05, "the true signal"
    assert explained(first_estimate(noisy, SHOT_VAR, READ_VAR, pair.cfa)) < 0.1
    assert explained(noisy) > 0.2, "the noisy signal"


def test_it_is_nearer_to_the_scene_than_the_frame_and_of_its_shape() -> None:
    pair = demo_pairs("validation", count=1)[0]
    assert pair.noisy is not None and pair.shot_var is not None and pair.read_var is not None
    estimate = first_estimate(pair.noisy, pair.shot_var, pair.read_var, pair.cfa)
    assert estimate.shape == pair.noisy.shape
    before, after = ((x - pair.raw).square().mean() for x in (pair.noisy, estimate))
    assert after < 0.7 * before


def test_noise_without_shots_needs_no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    noisy = torch.rand(1, 8, 8)
    monkeypatch.delattr("rawaug.training.noisy_frames.NonLocalMeans")
    assert first_estimate(noisy, 0.0, READ_VAR, demo_pairs("train", count=1)[0].cfa) is noisy


def test_it_is_finite_where_shot_noise_is_far_below_read_noise() -> None:
    dark = 1e-2 * torch.randn(1, 256, 256, generator=torch.Generator().manual_seed(0))
    assert first_estimate(dark, 1e-6, 1e-4, CFA.RGGB).isfinite().all()
    assert first_estimate(torch.zeros(1, 256, 256), 1e-6, 1e-4, CFA.RGGB).isfinite().all()
