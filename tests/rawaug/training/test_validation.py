"""Scores of a training: RAW and sRGB, the mean over the frames."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rawaug.data import demo_pairs
from rawaug.evaluation.scores import compare_images
from rawaug.evaluation.trials import Trial, make_trial
from rawaug.noise import noise_model
from rawaug.training.loop import validate

CPU = torch.device("cpu")


class Nothing(torch.nn.Module):
    """Gives back its input."""

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return noisy


def test_the_score_is_the_mean_over_frames_and_by_condition() -> None:
    clean = torch.full((1, 4, 8, 8), 0.5)
    frames = [Trial(clean + error, clean, condition=name) for error, name in ((0.1, "a"), (0.001, "a"), (0.01, "b"))]
    scores = validate(Nothing(), frames, CPU)
    assert scores == pytest.approx({"psnr": 40.0, "psnr_a": 40.0, "psnr_b": 40.0}, abs=0.01)
    assert set(validate(Nothing(), [Trial(clean + 0.1, clean)], CPU)) == {"psnr"}


class Dropping(Nothing):
    """Drops half of what it is given, in train mode."""

    def forward(self, noisy: Tensor, variance: Tensor) -> Tensor:
        return torch.nn.functional.dropout(noisy, 0.5, self.training)


def test_a_network_is_validated_in_eval_mode_and_goes_on_in_train_mode() -> None:
    net, clean = Dropping().train(), torch.full((1, 4, 32, 32), 0.5)
    frame = Trial(clean + 0.01, clean, clean)
    assert validate(net, [frame], CPU)["psnr"] == pytest.approx(40.0, abs=0.01) and net.training


def test_srgb_is_that_of_the_evaluation() -> None:
    pair = demo_pairs("validation", count=1)[0]
    trial = make_trial(pair, noise_model("cycleisp_sidd"))
    scores = validate(Nothing(), [trial], CPU)
    expected = compare_images(trial.noisy, trial)
    assert (scores["psnr"], scores["psnr_srgb"]) == pytest.approx((expected[0], expected[2]), abs=1e-3)
