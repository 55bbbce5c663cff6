"""Blocks with and without their pictures: what PSNR_r of an ISP that is right by construction is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import savemat
from torch import Tensor

from rawaug.bayer import turn
from rawaug.commands.evaluate import run as evaluate
from rawaug.data import sidd
from rawaug.data.sidd import SiddBlocks, SiddPlusBlocks, SiddScene
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP

SIDE = 16
SCENES = ("0009_001_S6_00800_00350_3200_L", "0021_001_GP_10000_05000_5500_N")
SHOT_VAR, READ_VAR = 4e-3, 1e-4


@pytest.fixture
def camera() -> DictionaryISP:
    """One matrix, one light: its RAW is nothing like its sRGB."""
    isp = DictionaryISP(ISPConfig(colour_atoms=1, gain_atoms=1, attention=False, cfa="GRBG"))
    with torch.no_grad():
        isp.colour.matrices.copy_(torch.tensor([[[0.6, 0.3, 0.1], [0.05, 0.75, 0.2], [0.02, 0.23, 0.75]]]))
        isp.gain.log_gains.copy_(torch.tensor([[1.2, 2.0, 1.6]]).log())
    return isp.requires_grad_(False).eval()


@pytest.fixture
def pictures(monkeypatch: pytest.MonkeyPatch) -> Tensor:
    """uint8 ``(2, 32, 3, SIDE, SIDE)`` of two frames: SIDD would have forty."""
    monkeypatch.setattr(sidd, "HELD_BACK", SCENES)
    coarse = torch.rand(64, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(coarse, (SIDE, SIDE), mode="bilinear").mul(0.7).add(0.1)
    return (255 * smooth).round().to(torch.uint8).unflatten(0, (2, 32))


def raw_of(camera: DictionaryISP, pictures: Tensor) -> Tensor:
    """Mosaics ``(2, 32, SIDE, SIDE)`` in the pattern of each scene's phone, of 12 bits."""
    mosaics = []
    for name, srgb in zip(SCENES, pictures, strict=True):
        camera.configure(cfa=str(SiddScene.parse(name).cfa))
        mosaics.append(camera.reverse(srgb).raw[:, 0])
    camera.configure(cfa="GRBG")
    return (4095 * torch.stack(mosaics)).round() / 4095


def write_blocks(folder: Path, raw: Tensor, pictures: Tensor | None, views: tuple[int, int] = (6, 1)) -> None:
    """RAW, and pictures turned upright by ``views``."""
    noise = torch.randn(raw.shape, generator=torch.Generator().manual_seed(1))
    noisy = raw + noise * (SHOT_VAR * raw + READ_VAR).sqrt()
    for name, values in (("ValidationGtBlocksRaw", raw), ("ValidationNoisyBlocksRaw", noisy.clamp(0.0, 1.0))):
        savemat(folder / f"{name}.mat", {name: values.numpy()})
    if pictures is not None:
        upright = torch.stack([turn(part, view) for part, view in zip(pictures, views, strict=True)])
        for name in ("ValidationGtBlocksSrgb", "ValidationNoisyBlocksSrgb"):
            savemat(folder / f"{name}.mat", {name: upright.permute(0, 1, 3, 4, 2).numpy()})


def test_a_right_isp_scores_as_such_on_the_published_pictures(
    tmp_path: Path, camera: DictionaryISP, pictures: Tensor
) -> None:
    write_blocks(tmp_path, raw_of(camera, pictures), pictures)
    pairs = SiddBlocks(tmp_path)
    assert torch.equal(pairs[3].srgb, pictures[0, 3]) and torch.equal(pairs[40].srgb, pictures[1, 8]), "turned back"
    assert pairs[3].rendered and pairs[3].noisy_srgb is not None and torch.equal(pairs[3].noisy_srgb, pictures[0, 3])
    camera.save(tmp_path / "camera.safetensors")
    assert evaluate(str(tmp_path / "camera.safetensors"), data=f"sidd:{tmp_path}")["psnr"] > 70.0


def test_without_pictures_or_metadata_psnr_r_is_refused(
    tmp_path: Path, camera: DictionaryISP, pictures: Tensor
) -> None:
    write_blocks(tmp_path, raw_of(camera, pictures), None)
    pair = SiddBlocks(tmp_path)[0]
    assert not pair.rendered
    with pytest.raises(ValueError, match=rf"{SCENES[0]}_00: has no sRGB picture, and its white balance") as refusal:
        psnr_r(camera, pair)
    assert "\n" not in str(refusal.value)
    shot = tmp_path / SCENES[0]
    shot.mkdir()
    tags = {"AsShotNeutral": [(0.5, 1.0, 0.8)], "ColorMatrix2": np.eye(3).reshape(1, 9) + 0.1}
    savemat(shot / "0009_METADATA_RAW_010.MAT", {"metadata": tags})
    header = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
    (tmp_path / "noise_level_functions.csv").write_text(f"{header}\n{SCENES[0]}, 0.01, 1e-4, 0.01, 1e-4, 0.01, 1e-4\n")
    pairs = SiddBlocks(tmp_path)
    assert pairs[0].rendered and psnr_r(camera, pairs[0]) < 60.0 and pairs[0].white_balance == (2.0, 1.0, 1.25)
    assert not pairs[0].levels_from_clean and pairs[32].levels_from_clean and pairs[32].white_balance == (1, 1, 1)
    with pytest.raises(ValueError, match=f"{SCENES[1]}_00: has no sRGB picture"):
        psnr_r(camera, pairs[32])


def test_pictures_of_something_else_are_refused(tmp_path: Path, camera: DictionaryISP, pictures: Tensor) -> None:
    write_blocks(tmp_path, raw_of(camera, pictures), pictures.flip(1))
    with pytest.raises(ValueError, match=rf"{SCENES[0]}: its pictures do not show its RAW blocks"):
        SiddBlocks(tmp_path)[0]
    write_blocks(tmp_path, raw_of(camera, pictures), pictures[..., :8, :8])
    with pytest.raises(ValueError, match=r"the mosaics need uint8 \(2, 32, 16, 16, 3\)"):
        SiddBlocks(tmp_path)[0]


def test_sidd_plus_reads_its_pictures(tmp_path: Path, camera: DictionaryISP, pictures: Tensor) -> None:
    raw = raw_of(camera, pictures).flatten(0, 1)
    (tmp_path / "siddplus_valid_bayer_patterns.csv").write_text("grbg\nbggr\n")
    for kind in ("gt", "noisy"):
        name = f"siddplus_valid_{kind}_raw"
        savemat(tmp_path / f"{name}.mat", {name: raw.numpy()})
    assert not SiddPlusBlocks(tmp_path)[0].rendered
    name = "siddplus_valid_gt_srgb"
    savemat(tmp_path / f"{name}.mat", {name: pictures.flatten(0, 1).permute(0, 2, 3, 1).numpy()})
    pair = SiddPlusBlocks(tmp_path)[33]
    assert pair.rendered and torch.equal(pair.srgb, pictures[1, 1])
