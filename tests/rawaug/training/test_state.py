"""Where a training starts: drawn weights, or those of a file whose architecture must agree."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

import denoisers
from rawaug.bayer import CFA
from rawaug.data import demo_pairs
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.trials import make_trial
from rawaug.experiment.run import find_pattern
from rawaug.experiment.settings import ArmConfig, Recipe
from rawaug.experiment.task import change_cfa
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.state import TrainingState, first_network


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "trained.safetensors"
    denoisers.save(
        denoisers.build("NAFNet", width=4, encoder=[1], middle=1, decoder=[1], seed=9), path, {"cfa": "GBRG"}
    )
    return path


def test_a_start_gives_its_weights_and_its_architecture(weights: Path) -> None:
    expected = denoisers.load(weights)[0].state_dict()
    agreeing = DenoiserConfig("NAFNet", {"width": 4, "encoder": [1], "middle": 1, "decoder": [1]}, str(weights))
    for config in (DenoiserConfig(start=str(weights)), agreeing):
        model = first_network(config, seed=0)
        assert model.training
        assert all(torch.equal(value, expected[key]) for key, value in model.state_dict().items())
    started = Recipe(arms={"on": ArmConfig(denoiser=agreeing), "anew": ArmConfig()})
    isp = DictionaryISP(ISPConfig(cfa="BGGR"))
    assert (find_pattern(started, "on", isp), find_pattern(started, "anew", isp)) == (CFA.GBRG, CFA.BGGR)


def test_another_architecture_is_refused_in_one_line(weights: Path) -> None:
    for config in (DenoiserConfig("UNet", {"width": 4}, str(weights)), DenoiserConfig("NAFNet", {}, str(weights))):
        with pytest.raises(ValueError, match=r"denoiser\.start: .*denoiser") as error:
            first_network(config, seed=0)
        assert "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match="nothing"):
        first_network(DenoiserConfig(start="nothing"), seed=0)


def test_a_network_grows_from_one_with_fewer_blocks_which_it_equals_at_first(tmp_path: Path) -> None:
    small = denoisers.DRUNet(width=4, blocks=1, seed=3)
    torch.nn.init.normal_(small.tail.weight, std=0.1)
    path = tmp_path / "small.safetensors"
    denoisers.save(small, path, {})
    noisy = torch.rand(1, 4, 32, 32, generator=torch.Generator().manual_seed(0))
    variance = torch.full_like(noisy, 1e-3)

    grown = first_network(DenoiserConfig("DRUNet", {"width": 4, "blocks": 3}, str(path)), seed=0)
    assert isinstance(grown, denoisers.DRUNet) and grown.config["blocks"] == 3
    assert (grown(noisy, variance) - small(noisy, variance)).abs().max() < 1e-5

    with pytest.raises(ValueError, match=r"denoiser\.start"):
        first_network(DenoiserConfig("DRUNet", {"width": 8, "blocks": 1}, str(path)), seed=0)
    denoisers.save(grown, path, {})
    with pytest.raises(ValueError, match=r"denoiser\.start"):
        first_network(DenoiserConfig("DRUNet", {"width": 4, "blocks": 1}, str(path)), seed=0)


def test_without_a_start_the_seed_draws_the_weights() -> None:
    config = DenoiserConfig("UNet", {"width": 4, "scales": 2})
    first, again, other = (first_network(config, seed).state_dict() for seed in (1, 1, 2))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


@pytest.mark.parametrize("decay", [0.5, 0.9])
def test_the_average_forgets_at_the_decay_of_the_recipe(decay: float) -> None:
    net = first_network(DenoiserConfig("UNet", {"width": 4, "scales": 2}), seed=0)
    state = TrainingState(net, TrainConfig(ema=decay))
    for _ in range(150):  # at first it forgets faster
        state.average.update_parameters(net)
    before = [weights.clone() for weights in state.average_network.parameters()]
    with torch.no_grad():
        for weights in net.parameters():
            weights.add_(1.0)
    state.average.update_parameters(net)
    for old, new in zip(before, state.average_network.parameters(), strict=True):
        torch.testing.assert_close(new, old + (1.0 - decay), rtol=0.0, atol=1e-5)


def test_the_network_to_keep_lies_between_the_average_and_the_start() -> None:
    net = first_network(DenoiserConfig("DnCNN", {"width": 4, "depth": 3}), seed=0)
    start = [weights.clone() for weights in net.parameters()]
    state = TrainingState(net, TrainConfig(ema=0.0, start_share=0.25))
    with torch.no_grad():
        for weights in state.average_network.parameters():
            weights.add_(1.0)

    state.keep_average(30.0, choose=True)
    for old, new in zip(start, state.best_network("arm").parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.75, rtol=0.0, atol=1e-6)

    alone = TrainingState(net, TrainConfig())
    assert alone.network_to_keep() is alone.average_network
    with pytest.raises(ValueError, match="start_share"):
        TrainConfig(start_share=1.0)


def test_an_isp_behind_another_pattern_has_the_same_colours() -> None:
    isp = DictionaryISP(ISPConfig(cfa="GRBG"), seed=0)
    other = change_cfa(isp, CFA.RGGB)
    assert (str(isp.cfa), str(other.cfa)) == ("GRBG", "RGGB") and change_cfa(isp, CFA.GRBG) is isp
    grey = torch.full((1, 3, 8, 8), 128, dtype=torch.uint8)
    ours, theirs = (x.reverse(grey).raw for x in (isp, other))
    torch.testing.assert_close(
        ours[..., 0::2, 1::2], theirs[..., 0::2, 0::2], rtol=0.0, atol=2e-5
    )  # red, but for shading


def test_a_mosaic_of_another_pattern_is_denoised_in_the_network_s_own() -> None:
    class Red(denoisers.UNet):
        def forward(self, noisy: torch.Tensor, variance: torch.Tensor | None = None) -> torch.Tensor:
            red_is_first = noisy[:, :1].mean() < noisy[:, 1:2].mean()
            assert red_is_first
            return noisy * torch.tensor([2.0, 3.0, 5.0, 7.0]).reshape(1, 4, 1, 1)

    pair = demo_pairs("test", count=1)[0]
    trial = make_trial(pair, noise_model("cycleisp_sidd"))
    for own in CFA:
        denoised = RawDenoiser.of(Red(width=4, scales=2), cfa=own)(trial.input)
        # The two greens may exchange their names where the pattern moves by a line.
        ratio = denoised.sum((0, 2, 3)) / trial.noisy.sum((0, 2, 3))
        assert ratio[[0, 3]].tolist() == pytest.approx([2.0, 7.0], rel=1e-4)
        assert sorted(ratio[1:3].tolist()) == pytest.approx([3.0, 5.0], rel=1e-4)
