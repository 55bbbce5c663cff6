"""Scores: of an ISP by patches, of a denoiser on frozen noise, as the JSON that others read."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

import denoisers
from rawaug.data import demo_pairs
from rawaug.experiment.evaluate import evaluate, frozen_sample, isp_mosaic, score_isp, write_json
from rawaug.isp.model import DictionaryISP
from rawaug.isp.params import ISPConfig
from rawaug.noise import noise_model


@pytest.fixture
def identity(tmp_path: Path) -> Path:
    path = tmp_path / "identity.safetensors"
    network = denoisers.build("UNet", width=4, scales=2)
    denoisers.save(network, path, {"cfa": "GRBG", "noise": "cycleisp_sidd"})
    return path


def test_a_denoiser_that_does_nothing_scores_as_its_input(identity: Path) -> None:
    result = evaluate(identity, "demo:test")
    assert result["kind"] == "denoiser" and len(result["images"]) == 9
    assert result["psnr"] == pytest.approx(result["psnr_noisy"], abs=1e-4)
    assert result["ssim"] == pytest.approx(result["ssim_noisy"], abs=1e-5)
    assert result["psnr_worst25"] < result["psnr"] < result["psnr_best25"]
    assert set(result["images"][0]) == {"name", "psnr", "ssim"}
    again = evaluate(identity, "demo:test", self_ensemble=True)
    assert again["self_ensemble"] and again["psnr"] == pytest.approx(result["psnr"], abs=1e-4)


def test_an_isps_json_leaves_out_what_does_not_apply(tmp_path: Path) -> None:
    DictionaryISP(ISPConfig(cfa="GRBG")).save(tmp_path / "isp.safetensors")
    result = evaluate(tmp_path / "isp.safetensors", "demo:validation")
    assert result["kind"] == "isp"
    assert not {"ssim", "psnr_noisy", "self_ensemble", "seed"} & set(result)
    assert len(result["weights_sha256"]) == 64 and result["version"]
    write_json(result, tmp_path / "new" / "isp.json")
    assert json.loads((tmp_path / "new" / "isp.json").read_text()) == result


def test_strips_give_the_whole_mosaic() -> None:
    pair = demo_pairs("validation", count=1)[0]
    isp = DictionaryISP(ISPConfig(cfa="GRBG"))
    isp.shading.set(torch.zeros(2), torch.eye(2))
    assert pair.raw.shape[-2] >= 256
    tall = type(pair)(**{**vars(pair), **{k: torch.cat([getattr(pair, k)] * 2, 1) for k in ("srgb", "raw", "noisy")}})
    with torch.no_grad():
        torch.testing.assert_close(isp_mosaic(isp, tall), isp.reverse(tall.srgb[None]).raw)
    assert score_isp(isp, tall).psnr > 5.0


def test_noise_without_a_capture_is_frozen_by_seed_and_name() -> None:
    pair = demo_pairs("test", count=1)[0]
    bare = type(pair)(**{**vars(pair), "noisy": None, "shot_var": None, "read_var": None})
    noise = noise_model("cycleisp_sidd")
    first = frozen_sample(bare, noise, pair.cfa, seed=0)
    assert torch.equal(first.noisy, frozen_sample(bare, noise, pair.cfa, seed=0).noisy)
    assert not torch.equal(first.noisy, frozen_sample(bare, noise, pair.cfa, seed=1).noisy)
