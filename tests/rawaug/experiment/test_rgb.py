"""The truth of full colour, what demosaicing makes of its mosaic, and the recipe in small."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from rawaug import bayer
from rawaug.bayer import CFA
from rawaug.data import demo_pictures
from rawaug.data.pairs import Pair
from rawaug.evaluation.scores import compare_images
from rawaug.experiment.data import open_frames
from rawaug.experiment.full_colour import RgbRecipe, demosaic_mosaic, full_colour, rgb_trial
from rawaug.experiment.run import run
from rawaug.experiment.run import run as train_denoiser
from rawaug.experiment.settings import ArmConfig, DataConfig, ISPSource, Recipe
from rawaug.io import RawFrame
from rawaug.io.pictures import decode_srgb
from rawaug.metrics import psnr
from rawaug.noise import noise_model
from rawaug.training.config import DenoiserConfig, TrainConfig

NOISE = noise_model((1e-3, 1e-5))


def a_pair(cfa: CFA = CFA.RGGB, name: str = "scene") -> Pair:
    """A smooth scene of three colours, brighter than white in no channel, 192 x 256."""
    y, x = torch.meshgrid(torch.linspace(0, 3, 192), torch.linspace(0, 4, 256), indexing="ij")
    rgb = torch.stack([0.2 + 0.1 * x.sin(), 0.5 + 0.2 * y.cos(), 0.3 + 0.1 * (x + y).sin()])
    srgb = torch.zeros(3, 192, 256, dtype=torch.uint8)
    return Pair(name, RawFrame(bayer.mosaic(rgb, cfa), cfa, white_balance=(2.0, 1.0, 1.5)), srgb)


@pytest.mark.parametrize("cfa", list(CFA))
def test_a_pixel_of_the_truth_is_a_cell_of_the_frame(cfa: CFA) -> None:
    pair = a_pair(cfa)
    truth = full_colour(pair)
    assert truth.shape == (1, 3, 96, 128)
    cell = pair.clean.mosaic[0, 20:22, 30:32].flatten().tolist()
    by_colour = {c: [v for v, colour in zip(cell, cfa.value, strict=True) if colour == c] for c in "RGB"}
    expected = [sum(values) / len(values) for values in by_colour.values()]
    assert truth[0, :, 10, 15].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("factor", [1, 2, 4])
@pytest.mark.parametrize("cfa", [CFA.RGGB, CFA.GBRG])
def test_the_truth_of_a_grey_scene_is_grey(cfa: CFA, factor: int) -> None:
    """The colours of a cell are means around one centre: of a photograph as soft as lenses make them."""
    light = decode_srgb(demo_pictures(2)[1][:, :320, :448].float() / 255.0).mean(0)[None, None]
    grey = F.avg_pool2d(F.interpolate(light, size=(642, 898), mode="bicubic"), 3, stride=1)[0]
    pair = Pair("grey", RawFrame(grey, cfa), torch.zeros(3, 640, 896, dtype=torch.uint8))
    recipe = small(Path(), data=DataConfig(pairs=None, validation=None, test_crop=None, bin=factor))
    frames, _ = open_frames(recipe, {"test": [pair]})
    truth = full_colour(frames["test"][0])
    red, green, blue = truth[..., 8:-8, 8:-8].unbind(1)
    assert red.std() > 0.04
    assert min(psnr(red[None], blue[None]).item(), psnr(red[None], green[None]).item()) > 50


def test_noise_is_on_the_mosaic_of_the_truth_and_the_same_every_time() -> None:
    one, again, other = (rgb_trial(a_pair(name=name), NOISE) for name in ("a", "a", "b"))
    assert one.variance is not None
    assert torch.equal(one.noisy, again.noisy) and not torch.equal(one.noisy, other.noisy)
    relative = (one.noisy - bayer.pack_rgb(one.clean, CFA.RGGB)) / one.variance.sqrt()
    assert relative.std().item() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("method", ["malvar", "VNG", "PPG", "AHD", "DCB", "DHT", "AAHD"])
def test_what_is_smooth_is_demosaiced_to_itself(method: str) -> None:
    """LibRaw's result is in the same units, though it works on balanced RAW: red and blue are twice as bright there."""
    trial = rgb_trial(a_pair(), NOISE)
    rgb = demosaic_mosaic(bayer.pack_rgb(trial.clean, CFA.RGGB), a_pair(), method)
    error = (rgb - trial.clean)[..., 6:-6, 6:-6].abs().amax(dim=(0, 2, 3))
    assert error.max() < 4e-3, error
    assert compare_images(rgb, trial)[0] > compare_images(rgb + 0.01, trial)[0] > 35


def small(folder: Path, **changes: Any) -> RgbRecipe:
    return RgbRecipe(
        isp=ISPSource(),
        arms={"joint": ArmConfig(1.0)},
        denoiser=DenoiserConfig("JointDRUNet", {"width": 4, "scales": 2}),
        train=TrainConfig(steps=2, batch=1, crop=32, validate_every=1),
        out=str(folder),
        **{
            "data": DataConfig(pairs=None, validation_crop=128, test_crop=128, test_count=1),
            "classical": ["Wavelet"],
            "baselines": [],
            "demosaicing": ["malvar", "DCB"],
            **changes,
        },
    )


def test_the_recipe_compares_it_with_one_after_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = run(small(tmp_path), test=[a_pair(name="test")], validation=[a_pair(name="validation")])
    written = json.loads((tmp_path / "experiment" / "results.json").read_text())
    assert list(written["others"]) == ["Wavelet, malvar", "Wavelet, DCB"]
    plain = results["joint"][0]["plain"]
    assert plain["psnr"] == pytest.approx(plain["psnr_noisy"], abs=1.0), "two steps from the interpolation of the noisy"
    assert all(scores["psnr"] > plain["psnr_noisy"] + 3 for scores in written["others"].values())
    assert "Wavelet, DCB" in capsys.readouterr().out
    other = small(tmp_path, test_noise="upi", classical=[])
    run(other, overwrite=True, test=[a_pair(name="test")], validation=[a_pair(name="validation")])
    assert "already trained" not in capsys.readouterr().out, "the noise of validation chooses the weights"


def test_what_it_cannot_compare_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="'AMAZE'"):
        small(tmp_path, demosaicing=["AMAZE"])
    with pytest.raises(ValueError, match="rawaug-joint"):
        run(small(tmp_path, baselines=["rawaug-joint"]), test=[a_pair()], validation=[])
    with pytest.raises(ValueError, match=r"denoiser: .*network"):
        run(replace(small(tmp_path), denoiser=DenoiserConfig("UNet")), test=[a_pair()], validation=[])
    with pytest.raises(ValueError, match=r"denoiser: .*JointDRUNet"):
        train_denoiser(
            Recipe(arms={"a": ArmConfig(1.0)}, isp=ISPSource(), denoiser=small(tmp_path).denoiser, out=str(tmp_path))
        )
    with pytest.raises(ValueError, match="targets"):
        replace(small(tmp_path), arms={"joint": ArmConfig(0.5)}, data=DataConfig())


def test_developed_truth_and_result_share_exposure_and_colours() -> None:
    trial = rgb_trial(a_pair(), NOISE)
    assert trial.develop is not None
    shown: list[Tensor] = [trial.develop(x) for x in (trial.noisy, trial.clean)]
    assert shown[0].shape == (3, 48, 64) and shown[1].shape == (3, 96, 128)
    assert abs(shown[0].mean() - shown[1].mean()) < 0.02
