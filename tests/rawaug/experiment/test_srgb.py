"""Denoisers of developed pictures: LibRaw develops what they are tested on, alike for every method."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from rawaug.bayer import pack
from rawaug.cli import main
from rawaug.data import demo_pairs
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.denoising.pictures import PictureDenoiser
from rawaug.evaluation.figures import read_log
from rawaug.evaluation.scores import score, to_domain
from rawaug.evaluation.trials import Trial
from rawaug.experiment.data import open_frames
from rawaug.experiment.run import run
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource
from rawaug.experiment.srgb import REAL_PAIRS, SrgbRecipe, best_filter, developed, srgb_trials
from rawaug.io.pictures import write_picture
from rawaug.metrics import psnr
from rawaug.training.config import DenoiserConfig, TrainConfig
from rawaug.training.srgb_samples import Conditioning

LEVELS = [(1e-9, 1e-12), (2e-3, 1e-5)]
SMALL = [
    "--data.pictures", "tiny:", "--data.validation", "tiny:validation", "--data.test", "tiny:test", "--device", "cpu",
    "--levels", "[[2.0e-3, 1.0e-5], [8.0e-3, 1.0e-4]]", "--baselines", "[]", "--train.precision", "32-true",
    "--denoiser.settings", '{"width": 4, "scales": 2, "channels": 3}', "--steps", "2",
    "--train.crop", "32", "--train.batch", "4", "--train.validate-every", "1",
]  # fmt: skip
"""The recipe in seconds."""


RECIPE = SrgbRecipe(
    name="a",
    data=DataConfig(pairs=None, pictures="tiny:"),
    isp=ISPSource(),
    arms={"gaussian": ArmConfig(1.0, srgb_noise="Gaussian")},
    denoiser=DenoiserConfig(settings={"width": 4, "scales": 2, "channels": 3, "variance_map": False}),
    train=TrainConfig(steps=1, batch=1, crop=32),
    baselines=[],
    levels=[(8e-3, 1e-4)],
    device="cpu",
)
"""One arm, one step."""


@pytest.fixture(scope="module")
def pairs() -> list[Pair]:
    return [pair.middle(96) for pair in demo_pairs("test", count=2)]


@pytest.fixture(scope="module")
def trials(pairs: list[Pair]) -> list[Trial]:
    """Both frames, each at the weak and at the strong level."""
    return srgb_trials(pairs, LEVELS, "test")


def test_libraw_develops_grey_to_grey_by_its_own_curve(pairs: list[Pair]) -> None:
    pair, light = pairs[0], 0.2
    mosaic = torch.empty_like(pair.clean.mosaic)
    for (i, j), gain in zip(pair.cfa.sites, [pair.clean.white_balance[c] for c in (0, 1, 1, 2)], strict=True):
        mosaic[:, i::2, j::2] = light / gain
    srgb = developed(mosaic, pair)[0, :, 8:-8, 8:-8]
    expected = 1.099 * light**0.45 - 0.099  # BT.709
    torch.testing.assert_close(srgb, torch.full_like(srgb, expected), rtol=0.0, atol=2 / 255)
    assert not developed(-0.2 * mosaic, pair).any(), "below black is black"


def test_noise_is_that_of_the_level_the_same_for_all(trials: list[Trial], pairs: list[Pair]) -> None:
    weak, strong, *_ = trials
    assert psnr(weak.noisy, weak.clean) > 55 and torch.equal(weak.clean, strong.clean)
    raw = strong.inputs["raw"]
    assert raw.variance is not None
    clean = pack(pairs[0].clean.mosaic[None], pairs[0].cfa)
    noise, told = raw.image - clean, raw.variance.mean().item()
    assert noise[clean < 0.9].var().item() == pytest.approx(told, rel=0.05)
    (again,) = srgb_trials(pairs[:1], LEVELS[1:], "again")
    assert torch.equal(again.noisy, strong.noisy)


def test_a_raw_denoiser_is_developed_after(trials: list[Trial]) -> None:
    def brighter(by: float) -> torch.Tensor:
        denoiser = RawDenoiser.of(lambda noisy: noisy + by, name="brighter")
        ((name, image),) = to_domain(denoiser.name, denoiser(trials[1].input_for(denoiser)), trials[1])
        assert name == "brighter, then LibRaw"
        return image

    assert torch.equal(brighter(0.0), trials[1].noisy)
    assert brighter(0.1).mean() > trials[1].noisy.mean() + 0.02


def test_the_filter_is_as_strong_as_the_noise_of_its_shots(trials: list[Trial]) -> None:
    weak, strong, spec = trials[::2], trials[1::2], "NonLocalMeans"
    chosen = [row.psnr for row in score([best_filter(spec, strong)], strong)]
    for deviation in (0.01, 0.16):
        assert sum(row.psnr for row in score([PictureDenoiser.of(spec, level=deviation)], strong)) < sum(chosen)
    gentle = best_filter(spec, weak)
    assert torch.equal(gentle(weak[0].input), PictureDenoiser.of(spec, level=0.01)(weak[0].input))


@pytest.mark.usefixtures("tiny")
def test_the_recipe_scores_every_arm_and_method_at_every_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "srgb", *SMALL, "--out", str(tmp_path), "--dry-run"]) == 0
    assert not list(tmp_path.iterdir())
    assert main(["run", "srgb", *SMALL, "--out", str(tmp_path), "--seeds", "2"]) == 0
    results = json.loads((tmp_path / "srgb" / "results.json").read_text())
    weak = results["shot variance 0.002, read variance 1e-05"]
    strong = results["shot variance 0.008, read variance 0.0001"]
    assert set(weak["results"]) == {"gaussian", "bsrgan", "camera", "camera without finishing"}
    assert set(weak["others"]) == {"NonLocalMeans"}
    for arm, runs in weak["results"].items():
        for one, other in zip(runs, strong["results"][arm], strict=True):
            assert 10 < other["plain"]["psnr"] < one["plain"]["psnr"] < 50
            assert 0 < other["plain"]["ssim_noisy"] < one["plain"]["ssim_noisy"] <= 1
        assert len(runs) == 2
    noisy = strong["results"]["gaussian"][0]["plain"]["psnr_noisy"]
    assert strong["others"]["NonLocalMeans"]["psnr"] > noisy + 1
    said = capsys.readouterr().out
    assert "shot variance 0.002, read variance 1e-05" in said
    assert (tmp_path / "srgb" / "picture.png").is_file()
    page = (tmp_path / "srgb" / "report.html").read_text()
    assert "Scores, shot variance 0.002, read variance 1e-05" in page
    assert "on developed pictures with noise" in page and "RAW made from pictures" not in page
    assert main(["run", "srgb", *SMALL, "--out", str(tmp_path), "--seeds", "2"]) == 0
    assert capsys.readouterr().out.count("already trained") == 8


@pytest.mark.usefixtures("tiny")
def test_real_pairs_choose_the_weights_and_are_scored(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    for part in ("seen", "unseen"):
        (tmp_path / part).mkdir()
        clean = torch.rand(3, 8, 10, generator=generator).repeat_interleave(8, 1).repeat_interleave(8, 2)
        noisy = clean + 0.05 * torch.randn(clean.shape, generator=generator)
        for kind, picture in (("real", noisy), ("mean", clean)):
            write_picture(tmp_path / part / f"a_{kind}.png", picture.clamp(0.0, 1.0))
    seen, unseen = (f"cc15:{tmp_path / part}" for part in ("seen", "unseen"))
    recipe = replace(
        RECIPE, data=DataConfig(pairs=None, pictures="tiny:", validation=seen, test=unseen), out=str(tmp_path)
    )
    found = run(recipe, True)
    plain = found["gaussian"][0]["plain"] if REAL_PAIRS not in found else found[REAL_PAIRS]["gaussian"][0]["plain"]
    assert all(20 < plain[key] < 40 for key in ("psnr", "psnr_noisy"))
    (row,) = read_log(tmp_path / "a" / "seed0" / "gaussian" / "log.csv")
    assert 20 < float(row["psnr"]) < 40
    with pytest.raises(ValueError, match=r"data\.validation"):
        run(replace(recipe, data=replace(recipe.data, test=seen)), True)


@pytest.mark.usefixtures("tiny")
def test_real_pairs_are_cropped_but_keep_their_noise(tmp_path: Path) -> None:
    noisy = torch.rand(3, 64, 80, generator=torch.Generator().manual_seed(0))
    write_picture(tmp_path / "a_real.png", noisy)
    write_picture(tmp_path / "a_mean.png", torch.full_like(noisy, 0.5))
    data = DataConfig(pairs=None, pictures="tiny:", test=f"cc15:{tmp_path}", test_crop=32, bin=2)
    frames, _ = open_frames(replace(RECIPE, data=replace(data, validation="tiny:validation")), {})
    (pair,) = frames["test"]
    expected = (255 * noisy[:, 16:48, 24:56]).round()
    assert torch.equal(pair.noisy.float(), expected) and pair.clean.shape == expected.shape


@pytest.mark.usefixtures("tiny")
def test_the_strength_of_a_filter_is_chosen_on_validation_whatever_the_test_frames_are(
    pairs: list[Pair], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Flat validation frames choose a strong filter, which test frames with detail would not have chosen."""
    test = pairs[0]
    flat = replace(test, name="flat", clean=replace(test.clean, mosaic=torch.full_like(test.clean.mosaic, 0.2)))
    detailed = replace(test, name="detailed", clean=replace(test.clean, mosaic=test.clean.mosaic.clone()))
    recipe = replace(RECIPE, classical=["NonLocalMeans"], out=str(tmp_path))
    found = {}
    for frame in (flat, detailed):
        run(recipe, True, validation=[frame], test=[test])
        tables = json.loads((tmp_path / "a" / "results.json").read_text())
        others = tables["shot variance 0.008, read variance 0.0001"]["others"]
        found[frame.name] = others["NonLocalMeans"]["psnr"]
    assert found["flat"] < found["detailed"] - 0.2
    capsys.readouterr()
    other = replace(recipe, classical=[], levels=[(2e-3, 1e-5)])
    run(other, True, validation=[detailed], test=[test])
    assert "already trained" not in capsys.readouterr().out, "the levels of validation choose the weights"


def test_what_has_no_meaning_is_refused() -> None:
    data, arms = DataConfig(pairs=None), {"camera": ArmConfig(1.0)}
    network = DenoiserConfig(settings={"channels": 3, "variance_map": False})
    for given, said in (
        ({"levels": []}, "at least one level"),
        ({"denoiser": DenoiserConfig()}, "channels: 3, variance_map: false"),
        ({"arms": {"a": ArmConfig(1.0, noise_level=Conditioning())}}, "channels: 3, variance_map: true"),
        ({"classical": ["BM3D"]}, "BM3D"),
        ({"data": DataConfig(pairs=None, validation=None)}, r"data\.validation"),
        ({"arms": {"a": ArmConfig(1.0, srgb_noise="Gausian")}}, "Gaussian"),
    ):
        with pytest.raises(ValueError, match=said):
            SrgbRecipe(**{"data": data, "isp": "universal", "denoiser": network, "arms": arms, **given})  # type: ignore[arg-type]
