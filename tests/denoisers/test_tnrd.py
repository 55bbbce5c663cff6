"""TNRD: the published number of parameters, filters that do not see light, functions as sums of Gaussians."""

from __future__ import annotations

import pytest
import torch

from denoisers.files import build
from denoisers.tnrd import GAUSSIANS, TNRD, Diffusion, cosine_filters


def test_a_stage_has_the_published_number_of_parameters() -> None:
    for side, published in ((5, 2_089), (7, 5_329)):
        model = TNRD(stages=5, side=side)
        assert sum(weight.numel() for weight in model.parameters()) == 5 * published


def test_filters_are_orthonormal_and_sum_to_nothing() -> None:
    filters = cosine_filters(5).flatten(1)
    torch.testing.assert_close(filters @ filters.T, torch.eye(24), atol=1e-5, rtol=0)
    assert filters.sum(1).abs().max() < 1e-5


def test_the_functions_are_sums_of_gaussians() -> None:
    stage = Diffusion(side=3, reach=1.0)
    heights = torch.randn(8, GAUSSIANS, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        stage.heights.copy_(heights)

    response = torch.linspace(-1.3, 1.3, 200).expand(1, 8, 1, 200)
    spacing = 2.0 / (GAUSSIANS - 1)
    centres = torch.linspace(-1.0, 1.0, GAUSSIANS)
    gaussians = torch.exp(-0.5 * ((response[0, 0, 0] - centres[:, None]) / spacing).square())
    expected = heights @ gaussians
    torch.testing.assert_close(stage.influence(response)[0, :, 0].detach(), expected, atol=5e-3, rtol=0)


def test_light_does_not_matter_and_untrained_it_is_the_identity() -> None:
    noisy = torch.rand(1, 4, 17, 20, generator=torch.Generator().manual_seed(0))
    model = TNRD(stages=2, side=3)
    assert torch.equal(model(noisy), noisy)
    with torch.no_grad():
        for stage in model.stages:
            stage.get_parameter("heights").normal_(0.0, 0.01, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(model(noisy + 0.3), model(noisy) + 0.3, atol=1e-5, rtol=0)
    assert not torch.allclose(model(noisy), noisy)


def test_a_few_steps_remove_noise() -> None:
    generator = torch.Generator().manual_seed(0)
    model = TNRD(stages=2, side=3)
    optimiser = torch.optim.Adam(model.parameters(), lr=2e-3)
    ramp = torch.linspace(0.2, 0.6, 16)
    clean = (ramp[:, None] * ramp).expand(2, 4, 16, 16)

    for _ in range(30):
        noisy = clean + 0.03 * torch.randn(clean.shape, generator=generator)
        loss = (model(noisy) - clean).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.5 * 0.03**2


def test_it_is_built_from_its_settings_and_refuses_others() -> None:
    model = TNRD(stages=2, side=3, reach=40.0, domain="anscombe")
    again = build("TNRD", **model.config)
    assert again.config == model.config
    for settings, message in (({"side": 4}, "side"), ({"stages": 0}, "stages"), ({"variance_map": True}, "noise map")):
        with pytest.raises(ValueError, match=message):
            TNRD(**settings)
