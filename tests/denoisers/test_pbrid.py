"""PBRID keeps its shapes, sees the mosaic and not its planes, and denoises with its authors' weights."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from torch.nn import functional as F

from denoisers.pbrid import PBRID


def test_sizes() -> None:
    model = PBRID().eval()
    assert sum(weight.numel() for weight in model.parameters()) == 97_207
    noisy = torch.rand(1, 4, 34, 51, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        assert model(noisy).shape == noisy.shape


def test_without_a_correction_it_clips_and_keeps_the_sites() -> None:
    model = PBRID().eval()
    torch.nn.init.zeros_(model.rec_blocks.m_tail.weight)
    noisy = torch.randn(2, 4, 32, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        torch.testing.assert_close(model(noisy), noisy.clamp(0.0, 1.0))


def test_a_step_of_one_takes_the_noisy_mosaic_in_place_of_the_estimate() -> None:
    model = PBRID().eval()
    seen = []
    model.rec_blocks.m_head.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    torch.nn.init.constant_(model.ee[5].bias, 50.0)  # type: ignore[arg-type]
    noisy = torch.rand(1, 4, 32, 32, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        model(noisy)
    assert len(seen) == 10
    for features in seen:
        torch.testing.assert_close(features[:, -1:], F.pixel_shuffle(noisy, 2))


def test_published_weights_denoise(camera_files: Path) -> None:
    from rawaug.data import open_pairs
    from rawaug.evaluation.trials import make_trial
    from rawaug.metrics import psnr
    from rawaug.noise import noise_model

    weights = camera_files.parent / "baselines/pbrid.safetensors"
    if not weights.is_file():
        pytest.skip(f"no published weights in {weights}")
    model = PBRID().eval()
    model.load_state_dict(load_file(weights))
    frame = open_pairs(str(camera_files / "raw/canon"))[0].middle(128)
    sample = make_trial(frame, noise_model("cycleisp_sidd"))
    with torch.no_grad():
        denoised = model(sample.noisy)
    assert psnr(denoised, sample.clean).item() > psnr(sample.noisy, sample.clean).item() + 10.0
