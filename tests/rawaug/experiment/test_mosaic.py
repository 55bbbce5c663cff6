"""One network for every pattern: its test cases, its samples, and the recipe from end to end."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from denoisers import MosaicDRUNet, save
from denoisers.mosaic import entry_pattern
from rawaug import RawAugment, bayer
from rawaug.bayer import pattern
from rawaug.cli import main
from rawaug.data import demo_pairs
from rawaug.data.pairs import Pair
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.scores import NOISY, score
from rawaug.experiment.full_colour import MosaicRecipe, full_colour, libraw_demosaic, mosaic_trial, planes_trial
from rawaug.experiment.settings import ArmConfig, ISPSource
from rawaug.isp.model import DictionaryISP
from rawaug.noise import noise_model
from rawaug.seeding import keyed_generator
from rawaug.training.sources import MosaicCrops


@pytest.fixture(scope="module")
def pair() -> Pair:
    return demo_pairs("test", count=1)[0].middle(192)


def test_a_frame_has_the_same_light_in_every_pattern(pair: Pair) -> None:
    noise = noise_model((1e-3, 1e-5))
    for name in ("GRBG", "XTRANS", "QUAD-BGGR"):
        trial, own = mosaic_trial(pair, name, noise), planes_trial(pair, name, noise)
        known, (height, width) = pattern(name), own.clean.shape[-2:]
        assert torch.equal(trial.clean, full_colour(pair))
        assert torch.equal(own.clean, known.mosaic(trial.clean)[..., -height:, -width:])
        raw = trial.noisy if name != "GRBG" else bayer.unpack(trial.noisy, name)
        assert torch.equal(raw[..., -height:, -width:], own.noisy[:, :1])
        assert torch.equal(own.noisy[0, 1:], entry_pattern(known).planes(height, width)), "as networks are trained"
        assert own.variance is not None
        deviation = ((own.noisy[:, :1] - own.clean) / own.variance.sqrt()).std().item()
        assert deviation == pytest.approx(1.0, rel=0.03)


def test_libraw_demosaics_small_frames_of_every_pattern(pair: Pair) -> None:
    scene = torch.tensor([0.5, 0.4, 0.3])[:, None, None] * torch.linspace(0.5, 1.0, 70)
    for name in ("RGGB", "XTRANS"):
        rgb = libraw_demosaic(pattern(name).mosaic(scene.expand(1, 3, 62, 70)), pair, "AHD", name)
        assert rgb.shape == (1, 3, 62, 70)
        assert (rgb - scene)[..., 8:-8, 8:-8].abs().max() < 0.02


def test_samples_are_of_all_patterns_and_say_which(pair: Pair) -> None:
    augment = RawAugment(DictionaryISP(), noise=(1e-9, 0.0))
    picture = torch.tensor([200, 120, 60], dtype=torch.uint8)[:, None, None].expand(3, 96, 96)
    crops = MosaicCrops([picture], augment, 32, 1.0, {"RGGB": 0.4, "XTRANS": 0.4, "QUAD-RGGB": 0.2})
    seen = set()
    for number in range(40):
        sample = crops.draw(keyed_generator(0, number))
        assert sample.noisy.shape == (4, 32, 32) and sample.clean.shape == sample.variance.shape == (1, 32, 32)
        planes = sample.noisy[1:]
        assert torch.equal(planes.sum(0), torch.ones(32, 32))
        seen.add(tuple(planes.argmax(0)[:6, :6].flatten().tolist()))
        for plane in planes.bool():
            assert sample.clean[0][plane].std() < 1e-4, "a colour of a plain picture has one value"
    assert 6 < len(seen) <= 1 + 9 + 4  # RGGB; X-Trans and Quad-Bayer from every other line either way
    again = crops.draw(keyed_generator(0, 3))
    assert torch.equal(again.noisy, crops.draw(keyed_generator(0, 3)).noisy)


def test_a_network_of_mosaics_is_scored_in_every_pattern_and_others_in_bayer(tmp_path: Path, pair: Pair) -> None:
    save(MosaicDRUNet(width=4, scales=2, mend=False), tmp_path / "own.safetensors", {})
    own = RawDenoiser.of(tmp_path / "own.safetensors")
    for name in ("BGGR", "XTRANS", "QUAD-RGGB"):
        noisy, same = score([NOISY, own], [mosaic_trial(pair, name, noise_model((1e-3, 1e-5)))])
        assert same.condition == name and same.psnr == pytest.approx(noisy.psnr, abs=0.01)  # untrained: the identity
    with pytest.raises(ValueError, match=r"NonLocalMeans: .*rawaug-xtrans"):
        RawDenoiser.of("NonLocalMeans")(mosaic_trial(pair, "XTRANS", noise_model((1e-3, 1e-5))).input)


def test_a_recipe_without_shares_or_with_unknown_patterns_is_refused() -> None:
    arms = {"any": ArmConfig(augmented=1.0)}
    for patterns, said in (({"X": 1.0}, "CFA 'X' is unknown"), ({"RGGB": 0.0}, "patterns: shares must be")):
        with pytest.raises(ValueError, match=said):
            MosaicRecipe(isp=ISPSource(), patterns=patterns, arms=arms)


def test_the_recipe_trains_and_scores_by_pattern(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = {"width": 4, "scales": 2, "blocks": 1, "pyramid": 1}
    keys: dict[str, Any] = {
        "denoiser.start": None,
        "denoiser.settings": small,
        "steps": 2,
        "train.crop": 32,
        "train.batch": 2,
    }
    keys |= {"data.validation": "demo:validation", "data.test": "demo:test", "classical": ["NonLocalMeans"]}
    keys |= {"data.validation_crop": 64, "data.test_crop": 64, "data.validation_count": 1, "data.test_count": 1}
    given = [word for key, value in keys.items() for word in (f"--{key.replace('_', '-')}", json.dumps(value))]
    assert main(["run", "any", *given, "--out", str(tmp_path), "--device", "cpu"]) == 0
    results = json.loads((tmp_path / "any" / "results.json").read_text())
    for name in ("RGGB", "XTRANS", "QUAD-RGGB"):
        assert 10.0 < results[name]["results"]["any"][0]["plain"]["psnr_srgb"] < 60.0
        assert ("NonLocalMeans" in results[name]["others"]) == (name == "RGGB")
    head, *rows = (tmp_path / "any" / "seed0" / "any" / "log.csv").read_text().splitlines()
    assert rows and {"psnr_RGGB", "psnr_XTRANS", "psnr_QUAD-RGGB"} <= set(head.split(","))
    assert "XTRANS" in capsys.readouterr().out
