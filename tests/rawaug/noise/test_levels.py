"""Published levels: what is sampled against the laws as published."""

from __future__ import annotations

import math

import pytest
import torch
from scipy import stats

from rawaug.noise import (
    EldLevels,
    EldNoise,
    FixedLevels,
    NoiseLevels,
    PmridLevels,
    PoissonGaussianNoise,
    Preset,
    ShotReadNoise,
    SiddLevels,
    camera_names,
    noise_levels,
    noise_model,
    noise_names,
)
from rawaug.noise.levels import MixedLevels

N = 20_000
LAWS = {  # name: base of the logarithm, shot range, slope, intercept, sigma
    "upi": (math.e, (1e-4, 0.012), 2.18, 1.2, 0.26),
    "cycleisp_dnd": (10.0, (1e-4, 0.012), 2.18, 1.2, 0.26),
    "cycleisp_sidd": (10.0, (0.00068674, 0.02194856), 1.85, 0.3, 0.2),
    "rawir": (10.0, (1e-4, 1e-3), 1.34, 0.22, 0.1),
}


def draw(levels: NoiseLevels, batch: int = N) -> tuple[torch.Tensor, torch.Tensor]:
    shot, read = levels.sample(batch, torch.Generator().manual_seed(3))
    assert shot.shape == read.shape == (batch,) and shot.dtype == read.dtype == torch.float32
    return shot.double(), read.double()


@pytest.mark.parametrize("name", LAWS)
def test_presets_follow_their_published_law(name: str) -> None:
    base, (low, high), slope, intercept, sigma = LAWS[name]
    shot, read = draw(Preset(name))
    x, y = shot.log() / math.log(base), read.log() / math.log(base)
    uniform = (x - math.log(low, base)) / (math.log(high, base) - math.log(low, base))
    assert stats.kstest(uniform.numpy(), "uniform").pvalue > 1e-3
    fit = stats.linregress(x.numpy(), y.numpy())
    assert fit.slope == pytest.approx(slope, abs=4 * fit.stderr)
    assert fit.intercept == pytest.approx(intercept, abs=4 * fit.intercept_stderr)
    residual = y - slope * x - intercept
    assert residual.std() == pytest.approx(sigma, rel=0.02)
    assert stats.kstest((residual / sigma).numpy(), "norm").pvalue > 1e-3


def test_natural_and_base_10_logarithms_are_reported_apart() -> None:
    """The same constants in base 10 give 10^1.2 / e^1.2 = 4.8 times the read variance, at the median."""
    (_, upi), (_, dnd) = draw(Preset("upi")), draw(Preset("cycleisp_dnd"))
    assert dnd.median() / upi.median() == pytest.approx(10**1.2 / math.e**1.2, rel=0.05)


@pytest.mark.parametrize(
    ("phone", "iso", "levels"),
    [
        ("iPhone 7", 800, (0.000723, 3e-6)),
        ("Google Pixel", 3200, (0.007029, 0.000179)),
        ("LG G4", 100, (0.000739, 2e-6)),
    ],
)
def test_sidd_phones_at_tabulated_isos(phone: str, iso: int, levels: tuple[float, float]) -> None:
    shot, read = draw(SiddLevels(phone, iso), 2)
    assert (float(shot[0]), float(read[0])) == pytest.approx(levels, rel=1e-4)


def test_sidd_between_isos_and_over_the_range() -> None:
    shot, read = draw(SiddLevels("Google Pixel", 1131.37), 1)  # halfway, in the logarithm, from 800 to 1600
    assert float(shot) == pytest.approx(math.sqrt(0.001764 * 0.003519), rel=1e-3)
    assert float(read) == pytest.approx(math.sqrt(1.2e-5 * 4.5e-5), rel=1e-3)
    shot, _ = draw(SiddLevels("Google Pixel"))
    assert shot.min() >= 0.000228 * 0.999 and shot.max() <= 0.007029 * 1.001
    assert shot.median() == pytest.approx(float(draw(SiddLevels("Google Pixel", 565.7), 1)[0]), rel=0.05)


def test_pmrid_line() -> None:
    shot, read = draw(PmridLevels(1600), 1)
    assert float(shot) == pytest.approx((5.995267e-4 * 1600 + 8.68861e-3) / 959, rel=1e-5)
    assert float(read) == pytest.approx((7.11772e-7 * 1600**2 + 6.514934e-4 * 1600 + 0.11492713) / 959**2, rel=1e-5)


def test_eld_law() -> None:
    shot, read = draw(EldLevels("SonyA7S2"))
    gain = shot * 15583
    assert gain.min() >= 0.09392 * 0.999 and gain.max() <= 6.01063 * 1.001
    log_sd = read.log() / 2 + math.log(15583)
    fit = stats.linregress(gain.log().numpy(), log_sd.numpy())
    assert fit.slope == pytest.approx(0.54075, abs=4 * fit.stderr)
    assert fit.intercept == pytest.approx(1.21824, abs=4 * fit.intercept_stderr)
    assert (log_sd - 0.54075 * gain.log() - 1.21824).std() == pytest.approx(0.26751, rel=0.02)
    assert draw(EldLevels("NikonD850", 100), 1)[0] * 15583 == pytest.approx(0.41504, rel=1e-4)


def test_eld_full_model_draws_its_parts_at_one_gain() -> None:
    model = EldNoise("CanonEOS5D4", iso=(100, 6400))
    params = model.sample(N, torch.Generator().manual_seed(0))
    log_gain = (params["shot_var"].double() * 15583).log()
    rows = stats.linregress(log_gain.numpy(), (params["row_var"].double().log() / 2 + math.log(15583)).numpy())
    assert (rows.slope, rows.intercept) == pytest.approx((0.47128, -0.8079), abs=0.02)
    assert set(params["tukey_lambda"].tolist()) <= set(torch.tensor(model.law.camera["tukey_lambda_shape"]).tolist())
    assert params["colour_bias"].std() * 15583 == pytest.approx(0.4034, rel=0.05)
    assert params["quantum"][0] == pytest.approx(1 / 15583)
    # the published scale is that of a Tukey lambda: its variance comes on top
    scale = params["read_var"].double().log() / 2 + math.log(15583) - (0.65588 * log_gain + 1.09269)
    shapes = params["tukey_lambda"][:100].tolist()
    log_sd = {shape: math.log(stats.tukeylambda.std(shape)) for shape in set(shapes)}
    assert float((scale[:100] - torch.tensor([log_sd[shape] for shape in shapes])).mean()) == pytest.approx(
        0, abs=3 * 0.28605 / 100**0.5
    )


@pytest.mark.parametrize("name", ["Google Pixel", "pmrid", "NikonD850"])
def test_an_iso_outside_the_measured_range_is_refused(name: str) -> None:
    for iso in (50, 12800, (100.0, 12800.0), (800.0, 400.0)):
        with pytest.raises(ValueError, match=f"outside the measured range of {name}, 100 to "):
            noise_model(name, iso=iso)
    assert noise_model(name, iso=(200.0, 400.0)).sample(4, torch.Generator())["shot_var"].unique().numel() == 4


def test_noise_by_name() -> None:
    known = noise_names()
    models, known = known[:5], known[5:]
    assert models == ["CalibratedNoise", "DarkFrames", "EldNoise", "MeasuredNoise", "SensorNoise"]
    assert camera_names() == known[4:15] and known[15] == "any camera" and len(known) == 4 + 5 + 1 + 5 + 1 + 369
    for name in known[:20]:
        assert type(noise_model(name)) is ShotReadNoise
        params = noise_model(name, poisson=True).sample(2, torch.Generator().manual_seed(0))
        assert {"shot_var", "read_var", "seed"} <= params.keys() and (params["shot_var"] > 0).all()
    model = PoissonGaussianNoise(FixedLevels(0, 0))
    assert noise_model(model) is model
    shot, read = noise_levels([1e-3, 1e-5]).sample(1, torch.Generator())
    assert (float(shot), float(read)) == pytest.approx((1e-3, 1e-5))


def test_wrong_names_and_options_are_refused_in_one_line() -> None:
    with pytest.raises(
        ValueError, match=r"'sidd' is unknown: .*; use one of upi, .*SonyA7S2, .*, or \(shot_var, read_var"
    ):
        noise_model("sidd")
    with pytest.raises(ValueError, match="does not depend on ISO"):
        noise_model("upi", iso=100)
    with pytest.raises(ValueError, match=r"a pair \(shot_var, read_var\)"):
        noise_model((1e-3,))
    with pytest.raises(ValueError, match="not to a noise model"):
        noise_model(ShotReadNoise(FixedLevels(0, 0)), poisson=True)
    with pytest.raises(ValueError, match="use one of upi"):
        Preset("nlf")
    with pytest.raises(ValueError, match="SIDD phone"):
        SiddLevels("Pixel")
    with pytest.raises(ValueError, match="ELD camera"):
        EldLevels("Pixel")


def test_a_mixture_draws_each_picture_s_levels_from_one_of_its_laws_all_alike() -> None:
    laws = [FixedLevels(1e-3, 1e-6), FixedLevels(2e-3, 4e-6), FixedLevels(4e-3, 9e-6)]
    shot, read = draw(MixedLevels(laws))
    for law in laws:
        mine = (shot - law.shot_var).abs() < 1e-9
        assert mine.double().mean().item() == pytest.approx(1 / 3, abs=4 * math.sqrt(2 / 9 / N))
        assert (read[mine] - law.read_var).abs().max() < 1e-12  # both from the same law
    again = draw(MixedLevels(laws))
    assert torch.equal(again[0], shot) and torch.equal(again[1], read)
    with pytest.raises(ValueError, match="at least one law"):
        MixedLevels([])
