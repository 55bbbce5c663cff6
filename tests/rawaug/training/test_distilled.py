"""Distillation: what the targets are, and which teachers are refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import nn

import denoisers
from rawaug.data.pairs import Sample
from rawaug.training.distilled import Distilled
from rawaug.training.estimators import ESTIMATORS


def save_teacher(file: Path, seed: int = 0, channels: int = 4) -> denoisers.Denoiser:
    """Write a network that changes its input to a file."""
    network = denoisers.build("DRUNet", width=4, blocks=1, channels=channels, seed=seed).eval()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for weight in network.get_submodule("tail").parameters():
            weight.copy_(0.1 * torch.randn(weight.shape, generator=generator))
    denoisers.save(network, file, {})
    return network


@pytest.fixture
def sample() -> Sample:
    clean = torch.rand(2, 4, 32, 32, generator=torch.Generator().manual_seed(3))
    noisy = clean + 0.1 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(4))
    return Sample(noisy, clean, torch.full_like(clean, 0.01))


def test_the_target_lies_between_the_clean_picture_and_the_result_of_the_teacher(
    tmp_path: Path, sample: Sample
) -> None:
    teacher = save_teacher(tmp_path / "teacher.safetensors")
    with torch.no_grad():
        result = teacher(sample.noisy, sample.variance)
    assert (result - sample.clean).abs().mean() > 1e-2

    for share in (0.0, 0.3, 1.0):
        estimator = ESTIMATORS.make(
            {"name": "distilled", "settings": {"teacher": str(tmp_path / "teacher.safetensors"), "share": share}}
        )

        def perfect(noisy: torch.Tensor, variance: torch.Tensor, share: float = share) -> torch.Tensor:
            return (1 - share) * sample.clean + share * result

        # The teacher computes in bfloat16 where that is fast.
        assert estimator.loss(perfect, sample, nn.L1Loss()) < 2e-3
        assert estimator.loss(lambda noisy, variance: noisy, sample, nn.L1Loss()) > 1e-2


def test_no_gradient_reaches_the_teacher(tmp_path: Path, sample: Sample) -> None:
    save_teacher(tmp_path / "teacher.safetensors")
    estimator = Distilled(str(tmp_path / "teacher.safetensors"))
    student = denoisers.build("DRUNet", width=4, blocks=1, seed=5)

    estimator.loss(student, sample, nn.MSELoss()).backward()
    gradients = [parameter.grad for parameter in student.get_submodule("tail").parameters()]
    assert gradients[0] is not None
    assert gradients[0].abs().max() > 0
    assert all(parameter.grad is None for parameter in estimator.network.parameters())


def test_the_weights_depend_on_the_teacher(tmp_path: Path) -> None:
    revisions = []
    for seed in (0, 1):
        save_teacher(tmp_path / "teacher.safetensors", seed)
        revisions.append(Distilled(str(tmp_path / "teacher.safetensors")).revision)
    assert revisions[0] != revisions[1]


def test_a_teacher_of_other_pictures_is_refused(tmp_path: Path) -> None:
    save_teacher(tmp_path / "teacher.safetensors", channels=3)
    with pytest.raises(ValueError, match="channels"):
        Distilled(str(tmp_path / "teacher.safetensors")).require(denoisers.build("DRUNet", width=4))
    with pytest.raises(FileNotFoundError, match="nobody"):
        Distilled("nobody").require(denoisers.build("DRUNet", width=4))
    with pytest.raises(ValueError, match="share"):
        Distilled(share=1.5)
