"""What a sensor adds: tails, banding, offsets, greens that disagree, defects, rounding."""

from __future__ import annotations

import pytest
import torch
from scipy import stats

from rawaug.bayer import CFA, unpack
from rawaug.noise import (
    BlackOffset,
    ColourBias,
    ColumnNoise,
    DefectPixels,
    FixedLevels,
    GreenImbalance,
    Quantisation,
    RowNoise,
    SensorNoise,
    TukeyLambdaNoise,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("shape", [0.3, 0.14, 0.05, 0.0, -0.03])
def test_tukey_lambda_has_its_kurtosis_and_quantiles(shape: float) -> None:
    model = TukeyLambdaNoise(FixedLevels(0, 1e-6), shape)
    noise = model.apply(torch.zeros(1, 4, 512, 512), model.sample(1, generator())).flatten().double() / 1e-3
    kurtosis = float((noise**4).mean() / noise.var() ** 2)
    assert kurtosis == pytest.approx(3 + float(stats.tukeylambda.stats(shape, moments="k")), rel=0.03)
    sd = stats.tukeylambda.std(shape)
    assert stats.kstest(noise[:100_000].numpy(), lambda x: stats.tukeylambda.cdf(x * sd, shape)).pvalue > 1e-3


def test_tukey_lambda_shapes_are_drawn_and_checked() -> None:
    shapes = TukeyLambdaNoise(FixedLevels(0, 1e-6), (-0.2, 0.1)).sample(1000, generator())["tukey_lambda"]
    assert shapes.min() >= -0.2 and shapes.max() <= 0.1 and shapes.std() == pytest.approx(0.3 / 12**0.5, rel=0.1)
    with pytest.raises(ValueError, match=r"above -0\.5"):
        TukeyLambdaNoise(FixedLevels(0, 0), -0.5)


@pytest.mark.parametrize("model", [RowNoise(1e-4), ColumnNoise(1e-4)])
@pytest.mark.parametrize("cfa", list(CFA))
def test_banding_is_constant_along_lines_of_the_mosaic_and_independent_between_them(
    cfa: CFA, model: RowNoise | ColumnNoise
) -> None:
    along_rows = isinstance(model, RowNoise)
    shape = (512, 16) if along_rows else (16, 512)
    noise = model.apply(torch.zeros(2, 4, *shape), model.sample(2, generator()))
    mosaic = unpack(noise, cfa)[:, 0]
    mosaic = mosaic if along_rows else mosaic.mT
    assert torch.equal(mosaic, mosaic[..., :1].expand_as(mosaic))
    rows = mosaic[..., 0]
    assert abs(float(torch.corrcoef(torch.stack([rows[0, :-1], rows[0, 1:]]))[0, 1])) < 0.1
    assert abs(float(torch.corrcoef(rows)[0, 1])) < 0.1


def test_ranges_are_drawn_per_picture() -> None:
    row_var = RowNoise((1e-6, 1e-4)).sample(2000, generator())["row_var"]
    assert row_var.min() >= 1e-6 and row_var.max() <= 1e-4
    assert row_var.log10().mean() == pytest.approx(-5, abs=0.05)
    for wrong in (-1e-6, (0.0, 1e-4), (1e-4, 1e-6)):
        with pytest.raises(ValueError, match="row_var"):
            RowNoise(wrong)


def test_offsets_are_constant_over_a_picture() -> None:
    clean = torch.full((500, 4, 2, 2), 0.2)
    black = BlackOffset(1e-3)
    offset = black.apply(clean, black.sample(500, generator())) - clean
    assert offset.flatten(1).std(1).max() < 1e-6 and offset[:, 0, 0, 0].std() == pytest.approx(1e-3, rel=0.1)
    colour = ColourBias(1e-3)
    bias = colour.apply(clean, colour.sample(500, generator())) - clean
    assert bias.flatten(2).std(2).max() < 1e-6 and bias[:, :, 0, 0].std() == pytest.approx(1e-3, rel=0.1)
    assert abs(float(torch.corrcoef(bias[:, :2, 0, 0].T)[0, 1])) < 0.15


def test_greens_differ_in_gain_by_the_stated_deviation_and_keep_their_mean() -> None:
    model, clean = GreenImbalance(0.01), torch.full((2000, 4, 2, 2), 0.2)
    gains = (model.apply(clean, model.sample(2000, generator())) / clean)[:, :, 0, 0]
    assert torch.equal(gains[:, [0, 3]], torch.ones(2000, 2))
    assert (gains[:, 1] - gains[:, 2]).std() == pytest.approx(0.01, rel=0.05)
    torch.testing.assert_close(gains[:, 1] + gains[:, 2], torch.full((2000,), 2.0))


def test_photons_are_counted_after_the_greens_were_changed() -> None:
    model, clean = SensorNoise((1e-2, 0.0), poisson=True, green_imbalance=0.5), torch.full((1, 4, 256, 256), 0.2)
    params = model.sample(1, generator())
    noisy, ratio = model.apply(clean, params), 0.2 * (1 + params["green_imbalance"].item() / 2)
    assert abs(params["green_imbalance"].item()) > 0.1
    assert noisy[0, 1].mean().item() == pytest.approx(ratio, rel=0.01)
    assert noisy[0, 1].var().item() == pytest.approx(1e-2 * ratio, rel=0.03)
    plain = SensorNoise((1e-2, 0.0), poisson=True)
    assert torch.equal(noisy[0, ::3], plain.apply(clean, params)[0, ::3])  # red and blue have the light they had


def test_defects_are_as_many_as_asked_for() -> None:
    model = DefectPixels(dead=1e-2, hot=2e-2)
    noisy = model.apply(torch.full((2, 4, 256, 256), 0.3), model.sample(2, generator()))
    assert (noisy == 0).float().mean() == pytest.approx(1e-2, rel=0.05)
    hot = noisy[noisy > 0.3]
    assert hot.numel() / noisy.numel() == pytest.approx(2e-2, rel=0.05)
    assert (hot == 1).float().mean() == pytest.approx(0.3, abs=0.03)
    with pytest.raises(ValueError, match="at most 1"):
        DefectPixels(0.6, 0.6)


def test_defects_in_clusters_fill_their_cell() -> None:
    model = DefectPixels(hot=1e-2, clusters=0.5)
    noisy = model.apply(torch.full((1, 4, 512, 512), 0.0), model.sample(1, generator()))
    hot = (noisy > 0).sum(dim=1)
    assert hot.float().mean() / 4 == pytest.approx(1e-2, rel=0.1)
    assert (hot == 4).float().mean() == pytest.approx(0.5e-2, rel=0.1)  # by chance 1e-8


def test_several_depths_are_drawn_per_picture() -> None:
    model = Quantisation((8, 12))
    quantum = model.sample(1000, generator())["quantum"]
    assert (quantum == 1 / 255).float().mean() == pytest.approx(0.5, abs=0.05)
    assert set(quantum.tolist()) == set(torch.tensor([1 / 255, 1 / 4095]).tolist())


def test_a_share_of_the_pictures_has_an_effect_and_the_others_ideal_noise() -> None:
    every = {"row_var": 1e-4, "column_var": 1e-4, "black_offset_sd": 1e-2, "colour_bias_sd": 1e-2, "dead": 1e-2}
    model = SensorNoise((1e-3, 1e-5), **every, hot=1e-2, bits=6, conditioning=(0.5, 2.0), share=0.25)  # type: ignore[arg-type]
    params = model.sample(2000, generator())
    switched = ("row_var", "column_var", "black_offset", "colour_bias", "dead_share", "hot_share", "quantum")
    present = torch.stack([params[name].reshape(2000, -1)[:, 0] != 0 for name in switched])
    torch.testing.assert_close(present.float().mean(1), torch.full((7,), 0.25), atol=0.04, rtol=0)
    assert torch.corrcoef(present.float()).triu(1).abs().max() < 0.1  # each on its own
    told = params["conditioning"]
    assert (told != 1).float().mean() == pytest.approx(0.25, abs=0.04) and 0.5 <= told.min() < told.max() <= 2
    ideal, clean = SensorNoise((1e-3, 1e-5), **every, bits=6, share=0.0), torch.rand(2, 4, 32, 32)  # type: ignore[arg-type]
    drawn = ideal.sample(2, generator())
    plain = SensorNoise((1e-3, 1e-5))
    torch.testing.assert_close(ideal.apply(clean, drawn), plain.apply(clean, drawn), rtol=0, atol=1e-6)


def test_told_levels_are_wrong_by_their_factor() -> None:
    clean, wrong = torch.rand(2, 4, 8, 8, generator=generator()), SensorNoise((1e-3, 1e-5), conditioning=(0.5, 0.5))
    params = wrong.sample(2, generator())
    assert torch.equal(wrong.apply(clean, params), SensorNoise((1e-3, 1e-5)).apply(clean, params))
    torch.testing.assert_close(wrong.variance(clean, params), 0.5 * (1e-3 * clean + 1e-5))
