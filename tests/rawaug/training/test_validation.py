"""Scores of a training: RAW and sRGB, and the thirds by noise."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.data import demo_pairs
from rawaug.evaluation.scores import compare
from rawaug.evaluation.trials import Trial, trial_of
from rawaug.noise import noise_model
from rawaug.training.loop import panels, validate

CPU = torch.device("cpu")


class Nothing(torch.nn.Module):
    """Gives back its input."""

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return noisy


def test_thirds_by_noise_whatever_the_order() -> None:
    clean = torch.full((1, 4, 8, 8), 0.5)
    errors = [0.1, 0.001, 0.01, 0.1, 0.001, 0.01, 0.01]
    frames = [Trial(clean + error, clean, torch.full_like(clean, error**2)) for error in errors]
    scores = validate(Nothing(), frames, CPU)
    assert set(scores) == {"psnr", "psnr_low", "psnr_middle", "psnr_high"}
    assert scores["psnr_low"] == pytest.approx(60.0, abs=0.01) and scores["psnr_middle"] == pytest.approx(
        40.0, abs=0.01
    )
    assert scores["psnr_high"] == pytest.approx((40.0 + 20.0 + 20.0) / 3, abs=0.01)
    assert scores["psnr"] == pytest.approx((2 * 60.0 + 3 * 40.0 + 2 * 20.0) / 7, abs=0.01)
    assert set(validate(Nothing(), frames[:2], CPU)) == {"psnr"}


class Dropping(Nothing):
    """Drops half of what it is given, in train mode."""

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return torch.nn.functional.dropout(noisy, 0.5, self.training)


def test_a_network_is_validated_in_eval_mode_and_goes_on_in_train_mode() -> None:
    net, clean = Dropping().train(), torch.full((1, 4, 32, 32), 0.5)
    frame = Trial(clean + 0.01, clean, clean)
    assert validate(net, [frame], CPU)["psnr"] == pytest.approx(40.0, abs=0.01) and net.training
    assert torch.equal(panels(net, frame), panels(Nothing(), frame)) and net.training


class Doubled(torch.nn.Module):
    """Full colour of packed RAW."""

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return torch.nn.functional.interpolate(noisy[:, [0, 1, 3]], scale_factor=2)


def test_full_colour_is_shown_beside_the_raw_that_it_is_made_of() -> None:
    clean = torch.rand(1, 3, 200, 240, generator=torch.Generator().manual_seed(0))
    shown = panels(Doubled(), Trial(torch.rand(1, 4, 100, 120), clean, torch.ones(1, 4, 100, 120)))
    assert shown.shape == (3, 192, 3 * 192) and torch.equal(shown[..., 384:], clean[0, :, 4:196, 24:216])


def test_srgb_is_that_of_the_evaluation() -> None:
    pair = demo_pairs("validation", count=1)[0]
    trial = trial_of(pair, noise_model("cycleisp_sidd"))
    scores = validate(Nothing(), [trial], CPU)
    expected = compare(trial.noisy, trial)
    assert (scores["psnr"], scores["psnr_srgb"]) == pytest.approx((expected[0], expected[2]), abs=1e-3)
