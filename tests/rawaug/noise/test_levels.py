"""Levels: what is sampled against the laws as published, cameras' profiles, and noise at a stated PSNR."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from scipy import stats

from rawaug.files import find_weights
from rawaug.isp.model import DictionaryISP
from rawaug.metrics import psnr
from rawaug.noise import (
    CalibratedNoise,
    EldLevels,
    EldNoise,
    FixedLevels,
    NoiseLevels,
    PmridLevels,
    PoissonGaussianNoise,
    Preset,
    ShotReadNoise,
    camera_law,
    camera_names,
    noise_levels,
    noise_model,
    noise_names,
    sidd_levels,
)
from rawaug.noise.levels import MixedLevels
from rawaug.noise.models import NoiseModel
from rawaug.noise.profiles import (
    READ_ON_MOSAIC,
    SHOT_ON_MOSAIC,
    SPREAD,
    ProfileLevels,
    load_profiles,
    profile_ends,
)
from rawaug.registry import Spec

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
    shot, read = draw(sidd_levels(phone, iso), 2)
    assert (float(shot[0]), float(read[0])) == pytest.approx(levels, rel=1e-4)


def test_sidd_between_isos_and_over_the_range() -> None:
    shot, read = draw(sidd_levels("Google Pixel", 1131.37), 1)  # halfway, in the logarithm, from 800 to 1600
    assert float(shot) == pytest.approx(math.sqrt(0.001764 * 0.003519), rel=1e-3)
    assert float(read) == pytest.approx(math.sqrt(1.2e-5 * 4.5e-5), rel=1e-3)
    shot, _ = draw(sidd_levels("Google Pixel"))
    assert shot.min() >= 0.000228 * 0.999 and shot.max() <= 0.007029 * 1.001
    assert shot.median() == pytest.approx(float(draw(sidd_levels("Google Pixel", 565.7), 1)[0]), rel=0.05)


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
        with pytest.raises(ValueError, match=f"{name}, 100 to "):
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
    with pytest.raises(ValueError, match="'sidd'"):
        noise_model("sidd")
    with pytest.raises(ValueError, match="depend"):
        noise_model("upi", iso=100)
    with pytest.raises(ValueError, match=r"a pair \(shot_var, read_var\)"):
        noise_model((1e-3,))
    with pytest.raises(ValueError, match="noise"):
        noise_model(ShotReadNoise(FixedLevels(0, 0)), poisson=True)
    with pytest.raises(ValueError, match="upi"):
        Preset("nlf")
    with pytest.raises(ValueError, match="SIDD phone"):
        sidd_levels("Pixel")
    with pytest.raises(ValueError, match="ELD camera"):
        EldLevels("Pixel")


def test_a_law_of_a_mixture_may_be_a_camera_within_a_range_of_iso() -> None:
    base_iso: Spec = {"name": "any camera", "settings": {"iso": [50, 200]}}
    shot, _ = draw(noise_levels(["cycleisp_sidd", base_iso]))
    alone, _ = draw(noise_levels(base_iso))
    assert alone.max() < 1e-3 and alone.min() < 1e-5
    assert (shot < 6.8e-4).float().mean().item() == pytest.approx(0.5, abs=0.1)
    with pytest.raises(ValueError, match="no setting 'isso'"):
        noise_levels([{"name": "any camera", "settings": {"isso": 100}}])


def test_a_mixture_draws_each_picture_s_levels_from_one_of_its_laws_all_alike() -> None:
    laws = [FixedLevels(1e-3, 1e-6), FixedLevels(2e-3, 4e-6), FixedLevels(4e-3, 9e-6)]
    shot, read = draw(MixedLevels(laws))
    for law in laws:
        mine = (shot - law.shot_var).abs() < 1e-9
        assert mine.double().mean().item() == pytest.approx(1 / 3, abs=4 * math.sqrt(2 / 9 / N))
        assert (read[mine] - law.read_var).abs().max() < 1e-12  # both from the same law
    again = draw(MixedLevels(laws))
    assert torch.equal(again[0], shot) and torch.equal(again[1], read)
    with pytest.raises(ValueError, match="law"):
        MixedLevels([])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize(("iso", "shot", "read"), [(100, 1.392e-06, 7.017e-11), (6400, 5.747e-05, 1.727e-07)])
def test_a_row_of_the_file_is_hit(iso: int, shot: float, read: float) -> None:
    """The green figures of the Sony ILCE-7M3, as they stand in profiles.tsv."""
    shot_var, read_var = ProfileLevels("Sony ILCE-7M3", iso=iso).sample(3, generator())
    torch.testing.assert_close(shot_var, torch.full((3,), shot * SHOT_ON_MOSAIC), rtol=1e-5, atol=0)
    torch.testing.assert_close(read_var, torch.full((3,), read * READ_ON_MOSAIC), rtol=1e-5, atol=0)


def test_between_two_rows_the_logarithms_are_interpolated() -> None:
    profiles = load_profiles()
    index = profiles.names.index("Sony ILCE-7M3")
    (x0, x1), (s0, s1), _ = profiles.table[:, index, 2:4].tolist()
    iso = math.exp(0.25 * x0 + 0.75 * x1)
    shot_var, _ = ProfileLevels("sony ilce-7m3", iso=iso).sample(1, generator())
    assert shot_var.item() == pytest.approx(math.exp(0.25 * s0 + 0.75 * s1), rel=1e-5)


def test_levels_stay_within_the_profile_and_replay() -> None:
    profiles = load_profiles()
    levels = ProfileLevels("Nikon D750")
    shot_var, read_var = levels.sample(2000, generator(3))
    index = profiles.names.index("Nikon D750")
    shot = profiles.table[1, index, : profiles.rows[index]].exp()
    assert shot.min() * 0.999 <= shot_var.min() <= shot.min() * 1.1
    assert shot.max() * 0.9 <= shot_var.max() <= shot.max() * 1.001
    assert all(torch.equal(a, b) for a, b in zip(levels.sample(2000, generator(3)), (shot_var, read_var), strict=True))


def test_any_camera_draws_each_camera_alike() -> None:
    """By its profile's levels where it has one row alone, whose factors then lie within the spread."""
    levels = ProfileLevels("any camera")
    assert len(levels.cameras) == len(load_profiles().names) == 369
    levels.spread = False
    one_row = load_profiles().rows == 1
    fixed = load_profiles().table[1, one_row, 0].exp().float()
    shot_var, _ = levels.sample(200_000, generator())
    hits = torch.isclose(shot_var[:, None], fixed, rtol=1e-6, atol=0).float().mean(dim=0)
    torch.testing.assert_close(hits, torch.full_like(hits, 1 / 369), atol=5e-4, rtol=0)


def test_any_camera_draws_how_far_its_levels_are_known() -> None:
    """The factors of both levels fill their spread, whatever the camera, and each is drawn on its own."""
    levels = ProfileLevels("any camera")
    drawn = levels.sample(20_000, generator(1))
    levels.spread = False
    factors = [a / b for a, b in zip(drawn, levels.sample(20_000, generator(1)), strict=True)]
    for factor, (low, high) in zip(factors, SPREAD, strict=True):
        assert low * 0.9999 <= factor.min() < low * 1.01 and high * 0.99 < factor.max() <= high * 1.0001
        middle = math.sqrt(low * high)
        assert factor.log().mean().exp().item() == pytest.approx(middle, rel=0.02)
    assert torch.corrcoef(torch.stack(factors).log())[0, 1].abs() < 0.03


def test_a_profile_says_how_far_its_levels_are_known() -> None:
    """Six cameras' own ratios of 6.0 to 11.4 and 2.2 to 16; the fifth and the sixth are within the ends."""
    ends = profile_ends("Sony ILCE-7M3")
    assert [row.iso for row in ends] == [100.0 * 2**k for k in range(11)]
    assert ends[0].shot_var == pytest.approx((1.392e-6 * 6.0, 1.392e-6 * 11.4), rel=1e-4)
    assert ends[0].read_var == pytest.approx((7.017e-11 * 2.2, 7.017e-11 * 16), rel=1e-4)
    at_200 = float(ProfileLevels("Nikon D5000", iso=200).sample(1, generator())[0])
    assert at_200 * SPREAD[0][0] <= 2.6e-5 and at_200 * SPREAD[0][1] >= 3.2e-5
    at_gain_1 = float(ProfileLevels("Raspberrypi RP_imx477", iso=100).sample(1, generator())[0])
    of_tuning_file = 2.767**2 / (65535 - 4096)  # of the standard deviation over the root of the signal, in 16 bits
    assert at_gain_1 * SPREAD[0][0] <= of_tuning_file == pytest.approx(1.25e-4, rel=0.01)
    with pytest.raises(ValueError, match="is not listed"):
        profile_ends("Nikon D75O")


def test_limits_of_iso_leave_out_the_cameras_without_a_share() -> None:
    profiles = load_profiles()
    high = ProfileLevels("any camera", iso=(51_200, 102_400))
    ends = profiles.limits()[:, 1].exp()
    assert len(high.cameras) == int((ends > 51_199).sum()) < 150
    assert (
        high.sample(500, generator())[0].median()
        > 20 * ProfileLevels("any camera", iso=400).sample(500, generator())[0].median()
    )


def test_names_reach_the_noise_model() -> None:
    params = noise_model("any camera").sample(4, generator())
    clean = torch.full((4, 4, 8, 8), 0.2)
    assert torch.equal(noise_model("any camera").apply(clean, params), noise_model("Any Camera").apply(clean, params))
    with pytest.raises(ValueError, match="similar: Nikon D750"):
        noise_model("Nikon D75O")
    with pytest.raises(ValueError, match="measured"):
        noise_model("Sony ILCE-7M3", iso=50)


def measured(model: NoiseModel, clean: torch.Tensor) -> float:
    params = model.sample(len(clean), torch.Generator().manual_seed(1))
    return float(psnr(model.apply(clean, params), clean).mean())


def pictures(*signals: float) -> torch.Tensor:
    """1536 ramps ``(4, 12, 12)``, of these mean signals in turn."""
    ramp = torch.linspace(0.2, 1.8, 144).reshape(12, 12)
    means = torch.tensor(signals).repeat(1536 // len(signals))
    return means[:, None, None, None] * ramp.expand(4, 12, 12)


@pytest.mark.parametrize("levels", [(2e-3, 1e-5), (0.0, 1e-4), "cycleisp_sidd", "Google Pixel"])
@pytest.mark.parametrize("pair_psnr", [36.0, 41.18])
def test_pairs_have_the_stated_psnr(levels: str | tuple[float, float], pair_psnr: float) -> None:
    model = CalibratedNoise(pair_psnr, 0.1, levels)
    spread = 0.05 if isinstance(levels, tuple) else 0.5  # three standard errors of the law's own draws
    assert measured(model, pictures(0.1)) == pytest.approx(pair_psnr, abs=spread)


def test_pictures_of_different_light_have_it_on_average() -> None:
    signals = (0.01, 0.05, 0.3)
    model = CalibratedNoise(40.0, signals, (1e-3, 1e-6))
    assert measured(model, pictures(*signals)) == pytest.approx(40.0, abs=0.05)
    assert measured(model, pictures(0.01)) > 43.0 and measured(model, pictures(0.3)) < 37.0


def test_the_law_keeps_its_shape_and_the_calibration_is_the_same_each_time() -> None:
    one, again = (CalibratedNoise(41.18).sample(5, torch.Generator().manual_seed(2)) for _ in range(2))
    shot_var, read_var = noise_levels("cycleisp_sidd").sample(5, torch.Generator().manual_seed(2))
    assert torch.equal(one["shot_var"], again["shot_var"])
    ratio = one["shot_var"] / shot_var
    assert torch.allclose(ratio, ratio[0].expand(5)) and torch.allclose(one["read_var"] / read_var, ratio)


def test_what_cannot_be_calibrated_is_refused() -> None:
    with pytest.raises(ValueError, match="pair_psnr"):
        CalibratedNoise(math.inf)
    none: list[float] = []
    for signal in (0.0, 1.5, none):
        with pytest.raises(ValueError, match=r"signal: .*signals"):
            CalibratedNoise(41.18, signal)
    with pytest.raises(ValueError, match="have no noise"):
        CalibratedNoise(41.18, 0.1, (0.0, 0.0))


def test_recipes_name_it_by_the_figure_alone() -> None:
    bare, full = (
        noise_model(spec)
        for spec in (
            {"pair_psnr": 41.18, "levels": "upi"},
            {"name": "CalibratedNoise", "settings": {"pair_psnr": 41.18, "levels": "upi"}},
        )
    )
    drawn = [model.sample(3, torch.Generator().manual_seed(0)) for model in (bare, full)]
    assert isinstance(bare, CalibratedNoise) and torch.equal(drawn[0]["shot_var"], drawn[1]["shot_var"])
    with pytest.raises(ValueError, match="signl"):
        noise_model({"pair_psnr": 41.18, "signl": 0.1})


def test_levels_in_the_wrong_order_are_questioned_once() -> None:
    with pytest.warns(UserWarning, match="read_var"):
        noise_model((1e-6, 0.1))
    noise_model((1e-6, 0.1))  # a second warning would be an error here
    noise_model((0.0, 0.1))  # white noise is asked for


def test_a_file_a_sheet_and_camera_are_spellings_of_one_law(tmp_path: Path) -> None:
    isp = DictionaryISP.from_pretrained("gopro-hero")
    (shot_var, read_var) = camera_law(isp.info["noise"]).at(None)
    sheet = tmp_path / "mine.yaml"
    matrix = "[[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0.0, -0.6, 1.6]]"
    figures = f"matrix: {matrix}, matrix_is: camera_to_srgb, white_balance: [2.1, 1.0, 1.7]"
    sheet.write_text(f"{{name: Mine, {figures}, noise: [{shot_var}, {read_var}]}}")

    file = str(find_weights("gopro-hero"))
    for spec in (file, "camera", str(sheet), isp.info["noise"], (shot_var, read_var)):
        shot, read = noise_levels(spec, info=isp.info).sample(2, torch.Generator())
        params = noise_model(spec, info=isp.info).sample(2, torch.Generator())
        torch.testing.assert_close(params["shot_var"], shot)
        torch.testing.assert_close((shot[0].item(), read[0].item()), (shot_var, read_var))

    with pytest.raises(ValueError, match="camera"):
        noise_model("camera")
    with pytest.raises(ValueError, match="no noise of a camera"):
        noise_model(str(find_weights("phones")))
    with pytest.raises(ValueError, match=r"rawaug fit.*\.yaml"):
        noise_model("no such noise")
