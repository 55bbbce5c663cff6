"""Physics of the noise models on fixed seeds, 262144 pixels a level; the contract of sample and apply; Poisson."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from rawaug.noise import (
    BlackOffset,
    ColourBias,
    Compose,
    DefectPixels,
    EldNoise,
    FixedLevels,
    NoiseModel,
    PoissonGaussianNoise,
    Preset,
    Quantisation,
    RowNoise,
    SensorNoise,
    ShotReadNoise,
    TukeyLambdaNoise,
)
from rawaug.noise.models import INVERSION_LIMIT, _invert_sum, poisson

LEVELS = torch.tensor([0.0, 1e-4, 1e-3, 0.01, 0.05, 0.2, 0.5, 0.8])
STRONG = FixedLevels(1e-3, 2e-5)
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]

ZERO_MEAN: dict[str, Callable[[], NoiseModel]] = {
    "gaussian": lambda: ShotReadNoise(STRONG),
    "gaussian, no shot": lambda: ShotReadNoise(FixedLevels(0, 2e-5)),
    "gaussian, no read": lambda: ShotReadNoise(FixedLevels(1e-3, 0)),
    "poisson": lambda: PoissonGaussianNoise(STRONG),
    "poisson, few photons": lambda: PoissonGaussianNoise(FixedLevels(0.02, 1e-5)),
    "tukey lambda": lambda: TukeyLambdaNoise(STRONG, -0.05),
    "rows": lambda: RowNoise(1e-5),
    "rounded": lambda: SensorNoise(STRONG, bits=10, black_level=64),
    "all at once": lambda: SensorNoise(STRONG, tukey_lambda=0.1, row_var=2e-6, bits=12),
}
EVERY: dict[str, Callable[[], NoiseModel]] = ZERO_MEAN | {
    "preset": lambda: ShotReadNoise(Preset("cycleisp_sidd")),
    "eld": lambda: EldNoise("SonyA7S2"),
    "offsets": lambda: Compose([BlackOffset(1e-3), ColourBias(1e-3)]),
    "defects": lambda: DefectPixels(1e-2, 1e-2),
    "full sensor": lambda: SensorNoise(
        STRONG,
        poisson=True,
        row_var=(1e-7, 1e-5),
        black_offset_sd=1e-3,
        colour_bias_sd=1e-3,
        dead=1e-3,
        hot=1e-3,
        bits=14,
    ),
}


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def flat(height: int = 256, width: int = 256) -> torch.Tensor:
    """One picture a level."""
    return LEVELS[:, None, None, None].expand(-1, 4, height, width).contiguous()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", ZERO_MEAN)
def test_variance_is_the_claimed_one_within_2_percent_and_the_mean_is_unbiased(name: str, device: str) -> None:
    model = ZERO_MEAN[name]()
    # Banding has few independent rows: a tall picture.
    clean = (flat(32768, 2) if name == "rows" else flat(1024, 64)).to(device)
    params = model.sample(len(clean), generator(0))
    noise = (model.disturb(clean, params) - clean).double()  # before the clip at white
    claimed = model.variance(clean, params)[:, 0, 0, 0].double()
    measured = noise.square().mean((1, 2, 3))
    torch.testing.assert_close(measured, claimed, rtol=0.02, atol=1e-14)
    banding = params.get("row_var", torch.zeros(1)).to(claimed)
    rows = 2 * clean.shape[-2]
    pixels = clean[0].numel()
    standard_error = ((claimed - banding) / pixels + banding / rows).sqrt()
    assert (noise.mean((1, 2, 3)).abs() <= 3 * standard_error + 1e-9).all()


def test_shadows_keep_their_sign_and_white_clips() -> None:
    model = ShotReadNoise(FixedLevels(1e-3, 1e-4))
    params = model.sample(1, generator(0))
    assert (model.apply(torch.zeros(1, 4, 64, 64), params) < 0).float().mean() == pytest.approx(0.5, abs=0.02)
    white = model.apply(torch.ones(1, 4, 64, 64), params)
    assert white.max() == 1 and (white == 1).float().mean() == pytest.approx(0.5, abs=0.02)
    assert torch.equal(model.disturb(torch.ones(1, 4, 64, 64), params).clamp(max=1), white)


@pytest.mark.parametrize(
    "model",
    [
        ShotReadNoise(FixedLevels(0, 0)),
        PoissonGaussianNoise(FixedLevels(0, 0)),
        TukeyLambdaNoise(FixedLevels(0, 0), 0.1),
        Compose([RowNoise(0.0), BlackOffset(0), ColourBias(0), DefectPixels(0, 0)]),
        SensorNoise(FixedLevels(0, 0)),
    ],
    ids=lambda model: type(model).__name__,
)
def test_zero_levels_give_the_identity(model: NoiseModel) -> None:
    clean = torch.rand(2, 4, 33, 31, generator=generator(0)) - 0.1
    clean[0, 0, 0, :4] = torch.tensor([0.0, 1e-12, 1e-8, 1.0])
    params = model.sample(2, generator(1))
    assert torch.equal(model.apply(clean, params), clean)
    assert (model.variance(clean, params) == 0).all()


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("size", [(5, 7), (64, 48), (300, 300)])
def test_same_params_same_bits_whatever_else_is_in_the_batch(name: str, size: tuple[int, int]) -> None:
    model = EVERY[name]()
    clean = torch.rand(3, 4, *size, generator=generator(0))
    params = model.sample(3, generator(1))
    assert all(value.shape[0] == 3 and value.dtype in (torch.float32, torch.int64) for value in params.values())
    noisy = model.apply(clean, params)
    assert torch.equal(model.apply(clean, params), noisy)
    for i in range(3):
        alone = model.apply(clean[i : i + 1], {key: value[i : i + 1] for key, value in params.items()})
        assert torch.equal(alone, noisy[i : i + 1])


@pytest.mark.parametrize("name", EVERY)
def test_apply_is_pure(name: str) -> None:
    model = EVERY[name]()
    clean = torch.rand(2, 4, 16, 16, generator=generator(0))
    kept, state = clean.clone(), torch.get_rng_state()
    params = model.sample(2, generator(1))
    saved = {key: value.clone() for key, value in params.items()}
    model.apply(clean, params)
    model.variance(clean, params)
    assert torch.equal(clean, kept) and torch.equal(torch.get_rng_state(), state)
    assert all(torch.equal(params[key], saved[key]) for key in saved)


@settings(max_examples=25, deadline=None)
@given(st.floats(0, 0.1), st.floats(0, 0.01), st.integers(1, 9), st.integers(1, 9), st.integers(0, 2**40))
def test_any_levels_and_sizes(shot: float, read: float, height: int, width: int, seed: int) -> None:
    clean = torch.rand(2, 4, height, width, generator=generator(seed)) * 1.2 - 0.1
    for model in (ShotReadNoise(FixedLevels(shot, read)), PoissonGaussianNoise(FixedLevels(shot, read))):
        params = model.sample(2, generator(seed))
        noisy = model.apply(clean, params)
        assert noisy.isfinite().all() and noisy.max() <= 1
        assert torch.allclose(model.variance(clean, params), shot * clean.clamp(min=0) + read, rtol=1e-5, atol=1e-12)


def test_pictures_and_composed_models_are_independent() -> None:
    clean = torch.full((2, 4, 128, 128), 0.5)
    model = ShotReadNoise(FixedLevels(1e-3, 1e-5))
    one, two = model.apply(clean, model.sample(2, generator(0))) - clean
    assert abs(float(torch.corrcoef(torch.stack([one.flatten(), two.flatten()]))[0, 1])) < 0.01
    both = Compose([ShotReadNoise(FixedLevels(0, 1e-4)), RowNoise(1e-4)])
    params = both.sample(2, generator(0))
    noise = both.apply(clean, params) - clean
    assert noise.var() == pytest.approx(2e-4, rel=0.1)
    first, second = (next(part.generators(params, clean.device)).initial_seed() for part in both.models)
    assert first != second


@pytest.mark.parametrize("name", list(EVERY))
def test_noise_may_be_written_over_the_picture(name: str) -> None:
    model = EVERY[name]()
    clean, params = torch.rand(3, 4, 20, 30, generator=generator(0)), model.sample(3, generator(1))
    expected, copy = model.disturb(clean, params), clean.clone()
    assert model.disturb(copy, params, out=copy) is copy and torch.equal(copy, expected)
    assert not torch.equal(clean, expected)


@pytest.mark.parametrize("name", ["gaussian", "poisson", "full sensor"])
def test_noise_and_variance_at_once_are_the_two_apart(name: str) -> None:
    model = EVERY[name]()
    clean = torch.rand(2, 4, 30, 530, generator=generator(0)) * 1.2 - 0.1
    params = model.sample(2, generator(1))
    noisy, variance = model.apply_with_variance(clean, params)
    assert torch.equal(noisy, model.apply(clean, params))
    torch.testing.assert_close(variance, model.variance(noisy, params), atol=0.0, rtol=1e-6)


def test_pytorch_makes_the_same_noise_where_nothing_can_be_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    model = ShotReadNoise(STRONG)
    clean, params = torch.rand(2, 4, 7, 530, generator=generator(0)), model.sample(2, generator(1))
    expected = model.apply_with_variance(clean, params)
    double = model.apply(clean.double(), params)
    monkeypatch.setattr("rawaug.kernels.runtime.has_numba", lambda: False)
    for a, b in zip(model.apply_with_variance(clean, params), expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(double.float(), expected[0], atol=1e-6, rtol=0.0)


def test_same_bits_on_any_number_of_threads() -> None:
    model = ShotReadNoise(STRONG)
    clean, params = torch.rand(3, 4, 90, 300, generator=generator(0)), model.sample(3, generator(1))
    before, results = torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(model.apply(clean, params))
    torch.set_num_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])


def test_bad_input_is_refused_in_one_line() -> None:
    model = ShotReadNoise(STRONG)
    params = model.sample(2, generator(0))
    with pytest.raises(ValueError, match="float32"):
        model.apply(torch.zeros(2, 1, 8, 8), params)
    with pytest.raises(ValueError, match="float16"):
        model.apply(torch.zeros(2, 4, 8, 8, dtype=torch.float16), params)
    with pytest.raises(ValueError, match="batch"):
        model.apply(torch.zeros(3, 4, 8, 8), params)
    with pytest.raises(ValueError, match="not negative"):
        FixedLevels(-1e-3, 0)
    with pytest.raises(ValueError, match="different kinds"):
        Compose([ShotReadNoise(STRONG), PoissonGaussianNoise(STRONG)])


@pytest.mark.gpu
@pytest.mark.parametrize("name", EVERY)
def test_cuda_replays_and_takes_parameters_from_the_cpu(name: str) -> None:
    model = EVERY[name]()
    clean = torch.rand(3, 4, 64, 48, generator=generator(0)).cuda()
    params = model.sample(3, generator(1))
    noisy = model.apply(clean, params)
    assert noisy.device == clean.device and torch.equal(noisy, model.apply(clean, params))
    alone = model.apply(clean[1:2], {key: value[1:2].cuda() for key, value in params.items()})
    assert torch.equal(alone, noisy[1:2])


def test_quantised_levels_lie_on_the_grid() -> None:
    model = SensorNoise(FixedLevels(1e-3, 1e-5), bits=10, black_level=64)
    noisy = model.apply(flat(32, 32), model.sample(len(LEVELS), generator(0)))
    numbers = noisy * 959
    assert torch.allclose(numbers, numbers.round(), atol=1e-3) and (numbers.round() == -1).any()
    assert Quantisation(10, 64).quanta == [1 / 959]


N = 400_000


def draw(rate: float, device: str, n: int = N) -> torch.Tensor:
    normals = torch.empty(n, device=device).normal_(generator=torch.Generator(device).manual_seed(7))
    return poisson(torch.full((n,), rate, device=device), normals).double().cpu()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("rate", [0.02, 0.5, 3.0, 9.99, 10.0, 12.5, 40.0, 300.0])
def test_counts_follow_the_distribution(rate: float, device: str) -> None:
    counts = draw(rate, device)
    assert torch.equal(counts, counts.round()) and counts.min() >= 0
    low, high = int(stats.poisson.ppf(1e-4, rate)), int(stats.poisson.ppf(1 - 1e-4, rate))
    edges = range(low, high + 1)
    observed = (
        [int((counts <= low).sum())] + [int((counts == k).sum()) for k in edges[1:]] + [int((counts > high).sum())]
    )
    expected = [stats.poisson.cdf(low, rate), *stats.poisson.pmf(edges[1:], rate), stats.poisson.sf(high, rate)]
    assert stats.chisquare(observed, [N * p for p in expected], sum_check=False).pvalue > 1e-3


@pytest.mark.parametrize("rate", [10.0, 10.5, 14.3, 40.0])
def test_expansion_gives_the_exact_quantiles(rate: float) -> None:
    uniform = (torch.arange(50_000, dtype=torch.float64) + 0.5) / 50_000
    counts = poisson(torch.full_like(uniform, rate), torch.special.ndtri(uniform)).numpy()
    assert (counts != stats.poisson.ppf(uniform, rate)).mean() < 1e-3


@pytest.mark.parametrize("rate", [INVERSION_LIMIT, 1e3, 1e5, 1e7])
def test_high_rates_have_the_right_mean_and_variance(rate: float) -> None:
    deviation = draw(rate, "cpu") - rate
    assert abs(deviation.mean()) < 3 * (rate / N) ** 0.5
    assert deviation.var() == pytest.approx(rate, rel=0.01)


def test_far_tail_is_neither_cut_nor_endless() -> None:
    counts = draw(0.1, "cpu", 4_000_000)
    assert stats.poisson.isf(1e-5, 0.1) <= counts.max() <= stats.poisson.isf(1e-11, 0.1)
    w = torch.tensor([-5.9, -3.0, 0.0, 3.0, 4.5, 5.2, 5.6, 5.9])
    for rate in (0.1, 2.0, 9.9):
        exact = stats.poisson.isf(stats.norm.sf(w.double().numpy()), float(torch.tensor(rate)))
        assert _invert_sum(torch.full_like(w, rate), w).tolist() == exact.tolist()
        assert _invert_sum(torch.tensor([rate]), torch.tensor([40.0])) < stats.poisson.isf(1e-15, rate)
