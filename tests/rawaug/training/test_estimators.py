"""What the estimators converge to, by least squares; and that corrections and neighbours are what they say."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

import denoisers
from rawaug.bayer import noise_variance
from rawaug.training.estimators import (
    R2R,
    Noise2Noise,
    Noisier,
    NoisyCrop,
    SelfSupervised,
    Supervised,
)
from rawaug.training.neighbor2neighbor import NEIGHBOURS, Neighbor2Neighbor, neighbours

SHOT_VAR, READ_VAR = 2e-3, 1e-4
SIGNAL_VAR = 4e-4


def scene_and_shots(shots: int = 1, clean: Tensor | None = None, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Clean (4, 256, 256) of mean 0.4, variance SIGNAL_VAR, and noisy shots of it."""
    generator = torch.Generator().manual_seed(seed)
    if clean is None:
        clean = 0.4 + SIGNAL_VAR**0.5 * torch.randn(4, 256, 256, generator=generator)
    noise = torch.randn(shots, *clean.shape, generator=generator) * noise_variance(clean, SHOT_VAR, READ_VAR).sqrt()
    return clean, clean + noise


def crop_of(shots: Tensor, signal: Tensor, shot_var: float = SHOT_VAR, read_var: float = READ_VAR) -> NoisyCrop:
    return NoisyCrop(shots, signal.expand_as(shots[0]), shot_var, read_var)


def sampled(estimator: SelfSupervised, crop: NoisyCrop, seed: int) -> Any:
    """The training sample that ``estimator`` makes of ``crop``."""
    return estimator.apply(crop, estimator.sample(crop.shots.shape[1:], torch.Generator().manual_seed(seed)))


def slope(target: Tensor, given: Tensor) -> float:
    """Of the best linear estimate of ``target``: its covariance with ``given`` over the variance of ``given``."""
    given = given - given.mean()
    return float((target * given).mean() / given.square().mean())


def trained_slope(estimator: SelfSupervised) -> tuple[float, float]:
    """Slope that l2 training converges to, and the one that clean targets would give."""
    clean, shots = scene_and_shots(estimator.shots)
    sample = sampled(estimator, crop_of(shots, clean), 7)
    return slope(sample.clean, sample.noisy), slope(clean, sample.noisy)


@pytest.mark.parametrize("estimator", [Noise2Noise(), R2R(0.5), R2R(1.0)], ids=["noise2noise", "r2r-0.5", "r2r-1"])
def test_unbiased_targets_teach_what_clean_ones_would(estimator: SelfSupervised) -> None:
    taught, right = trained_slope(estimator)
    assert taught == pytest.approx(right, abs=0.01)


@pytest.mark.parametrize("signal", [0.0, 0.02, 0.1])
@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_the_mean_of_r2rs_target_is_the_signal_whatever_its_input_is(alpha: float, signal: float) -> None:
    """Of a known constant scene every input teaches the same; noise drawn with the variance at the noisy signal is
    uncorrelated with the input too, but its targets go down by up to a standard deviation at both ends."""
    shot_var, read_var = 8e-3, 3e-4
    clean = torch.full((4, 512, 512), signal)
    deviation = (shot_var * signal + read_var) ** 0.5
    shots = clean + deviation * torch.randn(1, *clean.shape, generator=torch.Generator().manual_seed(0))
    sample = sampled(R2R(alpha), crop_of(shots, clean, shot_var, read_var), 7)
    offset = (sample.noisy - clean) / (deviation * (1 + alpha**2) ** 0.5)
    for low, high in ((-9.0, -1.5), (-1.5, -0.5), (-0.5, 0.5), (0.5, 1.5), (1.5, 9.0)):
        error = ((sample.clean - clean) / deviation)[(offset > low) & (offset < high)]
        assert abs(float(error.mean())) < 5 * (1 + alpha**-2) ** 0.5 / len(error) ** 0.5


@pytest.mark.parametrize("alpha", [0.5, 1.0])
def test_noisier_is_biased_and_its_correction_is_not(alpha: float) -> None:
    taught, right = trained_slope(Noisier(alpha))
    noise = SHOT_VAR * 0.4 + READ_VAR
    assert taught - right == pytest.approx(noise / (SIGNAL_VAR + (1 + alpha**2) * noise), abs=0.01)
    assert ((1 + alpha**2) * taught - 1) / alpha**2 == pytest.approx(right, abs=0.01 * (1 + alpha**-2))


def test_targets_keep_the_mean_in_the_shadows() -> None:
    """At 0.2 standard deviations above black, where clipping would show at once."""
    clean, shots = scene_and_shots(2, torch.full((4, 256, 256), 2e-3))
    tolerance = 4 * (5 * READ_VAR / clean.numel()) ** 0.5
    for estimator in (Noisier(), Noise2Noise(), R2R(0.5)):
        target = sampled(estimator, crop_of(shots, clean), 3).clean
        assert float((target - clean).mean()) == pytest.approx(0.0, abs=tolerance)


@pytest.mark.parametrize("alpha", [0.5, 1.0, 2.0])
def test_the_variance_map_is_that_of_the_input(alpha: float) -> None:
    clean, shots = scene_and_shots(1, torch.full((4, 256, 256), 0.4))
    for estimator in (Noisier(alpha), R2R(alpha)):
        sample = sampled(estimator, crop_of(shots, clean), 5)
        assert float(sample.variance.mean()) == pytest.approx(float((sample.noisy - clean).var()), rel=0.02)


def test_the_noise_map_of_two_shots_is_that_of_the_one_that_is_the_input() -> None:
    clean, shots = scene_and_shots(2)
    chosen = set()
    for seed in range(8):
        sample = sampled(Noise2Noise(), crop_of(shots, clean), seed)
        assert torch.equal(sample.variance, noise_variance(sample.noisy, SHOT_VAR, READ_VAR))
        chosen.add(torch.equal(sample.noisy, shots[0]))
    assert chosen == {True, False}, "either shot may be the input"


def test_inputs_are_clipped_at_white_and_targets_are_not() -> None:
    shots = torch.ones(1, 4, 32, 32)
    for estimator in (Noisier(), R2R()):
        sample = sampled(estimator, crop_of(shots, shots[0]), 0)
        assert sample.noisy.max() == 1.0 and sample.noisy.min() < 1.0
    assert sample.clean.max() > 1.0  # r2r's


@pytest.mark.parametrize(
    ("name", "settings"),
    [("UNet", {"width": 4, "scales": 2}), ("DHDN", {"width": 4}), ("DnCNN", {"width": 8, "depth": 3})],
)
def test_the_correction_is_the_extrapolation_of_the_network(name: str, settings: dict[str, Any]) -> None:
    net = denoisers.build(name, **settings)
    net.initialise(seed=3)  # an untrained network's residual is zero
    net.eval()
    generator = torch.Generator().manual_seed(0)
    noisy, variance = torch.rand(1, 4, 16, 16, generator=generator), torch.full((1, 4, 16, 16), 1e-3)
    alpha = 0.5
    with torch.no_grad():
        taught, corrected = net(noisy, variance), Noisier(alpha, correct=True).correct_network(net)(noisy, variance)
        expected = ((1 + alpha**2) * taught - noisy) / alpha**2
        torch.testing.assert_close(corrected, expected, rtol=1e-4, atol=1e-4)
        assert torch.equal(net(noisy, variance), taught)  # the trained network itself is left as it was
    assert Noisier(alpha).correct_network(net) is net and Supervised().correct_network(net) is net


@pytest.mark.parametrize("domain", ["linear", "ksigma", "anscombe"])
def test_a_network_whose_correction_is_no_extrapolation_is_refused(domain: str) -> None:
    net = denoisers.build("UNet", width=4, scales=2, domain=domain)
    net.initialise(seed=3)
    noisy = 0.1 + 0.5 * torch.rand(1, 4, 16, 16, generator=torch.Generator().manual_seed(0))
    variance, estimator = noise_variance(noisy, SHOT_VAR, READ_VAR), Noisier(1.0, correct=True)
    with torch.no_grad():
        exact = torch.allclose(
            estimator.correct_network(net)(noisy, variance), 2 * net(noisy, variance) - noisy, atol=1e-4
        )
    assert exact == (domain != "anscombe")
    Noisier(1.0).require(net)
    if exact:
        estimator.require(net)
    else:
        with pytest.raises(ValueError, match="anscombe"):
            estimator.require(net)


def test_neighbours_touch_and_differ() -> None:
    """On a plane that holds its own coordinates, the two are one step apart, within one cell."""
    rows, columns = torch.meshgrid(torch.arange(8.0), torch.arange(12.0), indexing="ij")
    image = torch.stack([rows, columns, rows, columns])[None]
    choice = Neighbor2Neighbor().sample(image.shape, torch.Generator().manual_seed(0))[None]
    first, second = neighbours(F.pad(image, (0, 1, 0, 1)), choice)  # an odd last line is left out
    assert first.shape == second.shape == (1, 4, 4, 6)
    distance = (first - second).abs()
    assert torch.equal(distance[:, 0] + distance[:, 1], torch.ones(1, 4, 6))
    assert torch.equal(first // 2, second // 2)
    assert set(choice.flatten().tolist()) == set(range(len(NEIGHBOURS)))


def test_the_neighbours_loss_of_the_identity() -> None:
    """f = identity on a flat field: the second term's differences cancel, the first is twice the noise's variance."""
    clean, shots = scene_and_shots(1, torch.full((4, 256, 256), 0.4))
    estimator = Neighbor2Neighbor(gamma=5.0)
    sample = sampled(estimator, crop_of(shots, clean), 0)
    batch = type(sample)(*(x[None] for x in sample))
    identity: Any = lambda noisy, variance: noisy  # noqa: E731
    loss = estimator.loss(identity, batch, torch.nn.functional.mse_loss)
    assert float(loss) == pytest.approx(2 * (SHOT_VAR * 0.4 + READ_VAR), rel=0.02)


def test_no_gradient_passes_through_the_neighbours_of_the_denoised_frame() -> None:
    """f = w y, whose loss and gradient can be written down; with a gradient through f(y) it would be another."""
    clean, shots = scene_and_shots(1)
    estimator = Neighbor2Neighbor(gamma=3.0)
    sample = sampled(estimator, crop_of(shots, clean), 0)
    batch = type(sample)(*(x[None] for x in sample))
    first, second = neighbours(batch.noisy, batch.choice)
    w = torch.tensor(0.7, requires_grad=True)
    estimator.loss(lambda noisy, _: w * noisy, batch, torch.nn.functional.mse_loss, progress=0.5).backward()
    excess = (0.7 * first - second) - 0.7 * (first - second)
    expected = 2 * ((0.7 * first - second) * first).mean() + 0.5 * 3.0 * 2 * (excess * first).mean()
    assert w.grad is not None and float(w.grad) == pytest.approx(float(expected), rel=1e-3)


def test_settings_out_of_range_are_refused() -> None:
    for make, said in (
        (lambda: R2R(0.0), "alpha must be positive"),
        (lambda: Neighbor2Neighbor(-1.0), "gamma must be at least 0"),
    ):
        with pytest.raises(ValueError, match=said):
            make()
