"""A cascade of two networks: what it starts from, what it computes, and its views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import denoisers
from denoisers.domains import fit_levels
from denoisers.ensemble import to_view
from rawaug.bayer import CFA, noise_variance
from rawaug.training.config import DenoiserConfig
from rawaug.training.state import first_network


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noisy_frame(shot_var: float = 4e-3, read_var: float = 1e-5) -> tuple[Tensor, Tensor]:
    clean = torch.full((1, 4, 34, 46), 0.2)
    variance = noise_variance(clean, shot_var, read_var)
    noisy = clean + variance.sqrt() * torch.randn(clean.shape, generator=generator())
    return noisy, noise_variance(noisy, shot_var, read_var)


@pytest.fixture
def base() -> denoisers.DRUNet:
    """A network that changes its input, of the settings that a cascade takes."""
    settings: dict[str, Any] = {"limits": True, "mend": True, "pyramid": 2, "variance_map": False, "domain": "anscombe"}
    network = denoisers.DRUNet(width=4, blocks=1, seed=2, **settings)
    with torch.no_grad():
        network.tail.weight.copy_(0.02 * torch.randn(network.tail.weight.shape, generator=generator()))
    return network.eval()


def test_an_untrained_cascade_changes_nothing() -> None:
    noisy, variance = noisy_frame()
    denoised = denoisers.CascadeDRUNet(width=4)(noisy, variance)
    assert (denoised - noisy).abs().max() < 1e-5


def test_from_a_drunet_the_cascade_runs_it_twice_told_less_noise_the_second_time(base: denoisers.DRUNet) -> None:
    cascade = denoisers.CascadeDRUNet(width=4).eval()
    assert cascade.can_start_from(base)
    cascade.start_from(base)
    noisy, variance = noisy_frame()

    first = base(noisy, variance)
    shot_var, _ = fit_levels(noisy, variance)
    assert torch.allclose(shot_var, torch.tensor(4e-3), rtol=1e-2)
    once_more = denoisers.DRUNet(width=4, blocks=1, limits=True, variance_map=False, domain="anscombe").eval()
    once_more.load_state_dict(base.state_dict())
    expected = once_more(first, noise_variance(first, 0.05 * 4e-3, 0.05 * 1e-5))

    assert (first - noisy).abs().max() > 1e-3
    assert (expected - first).abs().max() > 1e-4
    assert (cascade(noisy, variance) - expected).abs().max() < 1e-4


def test_the_second_network_sees_what_the_first_removed(base: denoisers.DRUNet) -> None:
    cascade = denoisers.CascadeDRUNet(width=4).eval()
    cascade.start_from(base)
    noisy, variance = noisy_frame()
    before = cascade(noisy, variance)
    torch.nn.init.normal_(cascade.second.removed.weight, std=0.5, generator=generator())
    assert (cascade(noisy, variance) - before).abs().max() > 1e-4


def test_the_second_network_cannot_take_a_light_away_but_may_restore_what_the_first_removed() -> None:
    cascade = denoisers.CascadeDRUNet(width=4).eval()
    noisy, variance = noisy_frame()
    noisy[..., 10, 10] += 0.5
    variance = noise_variance(noisy, 4e-3, 1e-5)
    deviation = variance.sqrt()
    levels = fit_levels(noisy, variance)

    with torch.no_grad():
        cascade.second.residual = lambda features: torch.full_like(features[:, :4], -1e3)  # type: ignore[method-assign]
        lowered = cascade._correct(noisy, noisy, levels)
        cascade.second.residual = lambda features: torch.full_like(features[:, :4], 1e3)  # type: ignore[method-assign]
        raised = cascade._correct(noisy - 0.1, noisy, levels)

    site = (0, 0, 10, 10)
    assert 2.5 < (noisy - lowered)[site] / deviation[site] < 3.5
    assert 2.5 < (raised - noisy)[site] / deviation[site] < 3.5


def test_frozen_the_first_network_keeps_its_weights(base: denoisers.DRUNet) -> None:
    for frozen in (True, False):
        cascade = denoisers.CascadeDRUNet(width=4, frozen=frozen).train()
        cascade.start_from(base)
        noisy, variance = noisy_frame()
        cascade(noisy, variance).square().mean().backward()
        assert cascade.second.tail.weight.grad is not None
        assert (cascade.first.tail.weight.grad is None) == frozen


def test_views_average_the_turned_frames_outside_of_training(base: denoisers.DRUNet) -> None:
    single = denoisers.CascadeDRUNet(width=4).eval()
    single.start_from(base)
    several = denoisers.CascadeDRUNet(width=4, views=8).eval()
    several.load_state_dict(single.state_dict())
    noisy, variance = noisy_frame()

    expected = denoisers.SelfEnsemble(single, CFA.RGGB, 8)(noisy, variance)
    assert torch.allclose(several(noisy, variance), expected, atol=1e-6)
    assert not torch.allclose(expected, single(noisy, variance), atol=1e-5)
    assert torch.allclose(several.train()(noisy, variance), single(noisy, variance), atol=1e-6)
    assert to_view(noisy, CFA.RGGB, 1).shape != noisy.shape


def test_where_no_noise_is_stated_the_frame_stays(base: denoisers.DRUNet) -> None:
    cascade = denoisers.CascadeDRUNet(width=4, views=4).eval()
    cascade.start_from(base)
    noisy, variance = noisy_frame()
    variance[..., :10] = 0.0
    assert torch.equal(cascade(noisy, variance)[..., :10], noisy[..., :10])


def test_a_cascade_is_saved_and_loaded(base: denoisers.DRUNet, tmp_path: Path) -> None:
    cascade = denoisers.CascadeDRUNet(width=4, blocks=2, views=4).eval()
    cascade.start_from(base)
    denoisers.save(cascade, tmp_path / "cascade.safetensors", {})
    again, _ = denoisers.load(tmp_path / "cascade.safetensors")
    noisy, variance = noisy_frame()
    assert again.config == cascade.config
    assert torch.allclose(again.eval()(noisy, variance), cascade(noisy, variance), atol=1e-6)


def test_blocks_of_each_scale_grow_from_weights_with_fewer_and_change_nothing_at_first(
    base: denoisers.DRUNet, tmp_path: Path
) -> None:
    small = denoisers.CascadeDRUNet(width=4, views=4).eval()
    small.start_from(base)
    large = denoisers.CascadeDRUNet(width=4, blocks=[3, 2, 1, 1], views=4).eval()
    assert large.can_start_from(small)
    large.start_from(small)
    assert [len(list(blocks.children())) for blocks in large.second.encoder] == [3, 2, 1, 1]
    assert [len(list(blocks.children())) for blocks in large.second.decoder] == [1, 2, 3]

    noisy, variance = noisy_frame()
    assert torch.equal(large(noisy, variance), small(noisy, variance))
    denoisers.save(large, tmp_path / "cascade.safetensors", {})
    again, _ = denoisers.load(tmp_path / "cascade.safetensors")
    assert again.config == large.config

    with pytest.raises(ValueError, match="blocks"):
        denoisers.CascadeDRUNet(width=4, blocks=[3, 2])


def test_a_cascade_of_fewer_blocks_takes_the_first_of_each_scale(base: denoisers.DRUNet) -> None:
    large = denoisers.CascadeDRUNet(width=4, blocks=[3, 2, 1, 1]).eval()
    large.start_from(base)
    small = denoisers.CascadeDRUNet(width=4, blocks=[2, 1, 1, 0], views=4).eval()
    assert small.can_start_from(large)

    small.start_from(large)
    for name, weight in small.state_dict().items():
        assert torch.equal(weight, large.state_dict()[name]), name


def test_a_network_of_another_kind_starts_from_the_first_of_a_cascade(base: denoisers.DRUNet, tmp_path: Path) -> None:
    cascade = denoisers.CascadeDRUNet(width=4).eval()
    cascade.start_from(base)
    denoisers.save(cascade, tmp_path / "cascade.safetensors", {})

    settings = {**base.config, "blocks": 2}
    network = first_network(DenoiserConfig("DRUNet", settings, str(tmp_path / "cascade.safetensors")), seed=0)
    assert torch.equal(network.state_dict()["tail.weight"], base.tail.weight)
    with pytest.raises(ValueError, match="start"):
        first_network(DenoiserConfig("UNet", {"width": 4}, str(tmp_path / "cascade.safetensors")), seed=0)


def test_wrong_settings_and_inputs_are_refused(base: denoisers.DRUNet) -> None:
    for settings, word in (({"views": 3}, "views"), ({"domain": "linear"}, "domain"), ({"width": 0}, "width")):
        with pytest.raises(ValueError, match=word):
            denoisers.CascadeDRUNet(**{"width": 4, **settings})  # type: ignore[arg-type]

    cascade = denoisers.CascadeDRUNet(width=4, views=8).eval()
    with pytest.raises(ValueError, match="variance"):
        cascade(torch.rand(1, 4, 16, 16))
    with pytest.raises(ValueError, match="takes"):
        cascade(torch.rand(4, 16, 16), torch.rand(4, 16, 16))
    assert not denoisers.CascadeDRUNet(width=8).can_start_from(base)
