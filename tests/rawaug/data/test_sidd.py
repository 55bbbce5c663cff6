"""SIDD as published, small: RAW of version 7.3, METADATA of version 5, upright PNGs, blocks and their pictures."""

from __future__ import annotations

import base64
import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.io import savemat
from torch import Tensor

from rawaug.bayer import CFA, mosaic, pack, turn
from rawaug.cli import main
from rawaug.commands.evaluate import run as evaluate
from rawaug.commands.submit import submit
from rawaug.data import SiddBenchmark, check, open_pairs, sidd_blocks, write_submission
from rawaug.data.mat import read_array
from rawaug.data.sidd import SiddFrames
from rawaug.data.sidd_blocks import SiddBlocks, SiddPlusBlocks
from rawaug.data.sidd_scenes import HELD_BACK, PHONES, find_phone
from rawaug.denoising.denoiser import RawDenoiser
from rawaug.evaluation.psnr_r import psnr_r
from rawaug.io import RawFrame, write_picture
from rawaug.io.pictures import view_of_orientation
from rawaug.isp.config import ISPConfig
from rawaug.isp.model import DictionaryISP

Writer = Callable[[Path, dict[str, Any]], Path]
NEUTRAL = (0.5, 1.0, 0.8)
COLOUR = np.array([[0.9, -0.2, 0.0], [-0.3, 1.2, 0.1], [-0.1, 0.3, 0.7]])
GREY = np.array([0.5, 1.0, 0.8])  # what the camera sees of a grey, by its AsShotNeutral
SHOT_VAR, READ_VAR = 4e-3, 1e-4


def clean_frame(cfa: CFA, height: int = 96, width: int = 128) -> torch.Tensor:
    """A ramp of grey as the camera sees it, ``(1, H, W)``: three colours, no symmetry between rows and columns."""
    ramp = (torch.arange(height)[:, None] * 3 + torch.arange(width)) / (3 * height + width)
    return mosaic(0.9 * ramp * torch.tensor(GREY).float()[:, None, None], cfa)


def noisy_frame(clean: torch.Tensor, seed: int = 0) -> torch.Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(seed))
    return (clean + noise * (SHOT_VAR * clean + READ_VAR).sqrt()).clamp(0, 1)


def write_levels(folder: Path, rows: list[str]) -> None:
    header = "scene_instance_id, beta1_r, beta2_r, beta1_g, beta2_g, beta1_b, beta2_b"
    (folder / "noise_level_functions.csv").write_text("\n".join([header, *rows]))


def write_scene(
    folder: Path,
    mat73: Writer,
    name: str,
    numbers: tuple[str, ...] = ("010", "011"),
    orientation: int = 1,
    srgb: bool = False,
) -> None:
    """One scene instance of SIDD Medium."""
    for number in numbers:
        clean = clean_frame(find_phone(name)[1])
        at = folder / name / f"{name[:4]}_"
        for kind, frame in (("GT", clean), ("NOISY", noisy_frame(clean, int(number)))):
            mat73(Path(f"{at}{kind}_RAW_{number}.MAT"), {"x": frame[0].numpy()})
        tags = {"Orientation": orientation, "AsShotNeutral": [NEUTRAL], "ColorMatrix2": COLOUR.reshape(1, 9)}
        savemat(f"{at}METADATA_RAW_{number}.MAT", {"metadata": tags})
        if srgb:
            picture = (clean.expand(3, -1, -1) * torch.tensor([100, 150, 250]).reshape(3, 1, 1)).to(torch.uint8)
            write_picture(f"{at}GT_SRGB_{number}.PNG", turn(picture, view_of_orientation(orientation)))


@pytest.mark.parametrize("phone", PHONES)
def test_frames_have_their_phones_pattern_and_axes(tmp_path: Path, mat73: Writer, phone: str) -> None:
    write_scene(tmp_path / "Data", mat73, f"0001_001_{phone}_00100_00060_3200_L")
    frames = SiddFrames(tmp_path)
    assert frames.names == [f"0001_001_{phone}_00100_00060_3200_L_{k}" for k in ("010", "011")]
    pair = frames[0]
    assert pair.cfa == PHONES[phone][1] and pair.clean.camera == PHONES[phone][0]
    assert torch.equal(pair.clean.mosaic, clean_frame(pair.cfa)), "rows are rows"
    assert pair.noisy is not None and torch.equal(pair.noisy.mosaic, noisy_frame(pair.clean.mosaic, 10))
    red, green_r, green_b, blue = pack(pair.clean.mosaic, pair.cfa).mean(dim=(1, 2)).tolist()
    assert red / green_r == pytest.approx(0.5, rel=0.02) and blue / green_b == pytest.approx(0.8, rel=0.02)


def test_the_patterns_are_the_published_ones() -> None:
    assert {phone: str(cfa) for phone, (_, cfa) in PHONES.items()} == {
        "GP": "BGGR", "IP": "RGGB", "S6": "GRBG", "N6": "BGGR", "G4": "BGGR",
    }  # fmt: skip


def test_colour_is_that_of_the_metadata_and_renders_grey_as_grey(tmp_path: Path, mat73: Writer) -> None:
    write_scene(tmp_path, mat73, "0001_001_S6_00100_00060_3200_L")
    pair = SiddFrames(tmp_path)[0]
    assert pair.clean.white_balance == pytest.approx((2.0, 1.0, 1.25))
    assert torch.allclose(pair.clean.color_matrix.sum(dim=1), torch.ones(3), atol=1e-5)
    inside = pair.srgb[:, 8:-8, 8:-8].float()
    assert (inside - inside.mean(dim=0)).abs().max() <= 2 and inside.std() > 20
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    for rgb in np.eye(3):
        camera = COLOUR @ to_xyz @ rgb / (COLOUR @ to_xyz @ np.ones(3))
        assert np.allclose(pair.clean.color_matrix.numpy() @ camera, rgb, atol=1e-5)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_upright_picture_is_turned_to_the_mosaic(tmp_path: Path, mat73: Writer, orientation: int) -> None:
    write_scene(tmp_path, mat73, "0001_001_GP_00100_00060_3200_L", ("010",), orientation, srgb=True)
    expected = clean_frame(CFA.BGGR).expand(3, -1, -1) * torch.tensor([100, 150, 250]).reshape(3, 1, 1)
    (picture,) = tmp_path.rglob("*.PNG")
    there = tmp_path / "SIDD_Medium_Srgb" / picture.parent.name
    there.mkdir(parents=True)
    for _ in range(2):  # beside the RAW, and in another folder
        pair = SiddFrames(tmp_path)[0]
        assert torch.equal(pair.srgb, expected.to(torch.uint8)) and pair.registered
        picture = picture.rename(there / picture.name)


def test_noise_levels_are_measured_or_read_from_the_table(tmp_path: Path, mat73: Writer) -> None:
    name = "0001_001_IP_00100_00060_3200_L"
    write_scene(tmp_path, mat73, name, ("010",))
    pair = SiddFrames(tmp_path)[0]
    assert pair.noisy is not None and pair.noisy.noise_profile is not None
    shot_var, read_var = pair.noisy.noise_profile
    assert shot_var == pytest.approx(SHOT_VAR, rel=0.1) and read_var == pytest.approx(READ_VAR, rel=0.6)
    write_levels(tmp_path, [f"{name}, 0.01, 1e-4, 0.02, 2e-4, 0.07, 3e-4"])
    pair = SiddFrames(tmp_path)[0]
    assert pair.noisy is not None
    assert pair.noisy.noise_profile == pytest.approx((0.03, 2e-4)), "green counts twice"


def test_small_has_no_number_in_its_names_and_what_is_held_back_is_left_out(tmp_path: Path, mat73: Writer) -> None:
    write_scene(tmp_path, mat73, "0001_001_IP_00100_00060_3200_L", ("010",))
    for file in (tmp_path / "0001_001_IP_00100_00060_3200_L").iterdir():
        file.rename(file.with_name(file.name[5:]))
    write_scene(tmp_path, mat73, HELD_BACK[0], ("010",))
    assert SiddFrames(tmp_path).names == ["0001_001_IP_00100_00060_3200_L_010"]


def test_sidd_cc_has_its_own_split_and_is_not_clipped_at_black(tmp_path: Path, mat73: Writer) -> None:
    for name in ("0001_001_S6_00100_00060_3200_L", HELD_BACK[0]):
        write_scene(tmp_path / "Raw" / "train" / "Data", mat73, name)
    pairs = open_pairs(f"sidd-cc:{tmp_path}:train")
    assert {pair.name.rpartition("_")[0] for pair in pairs} == {"0001_001_S6_00100_00060_3200_L", HELD_BACK[0]}
    assert len(pairs) == 4 and len(SiddFrames(tmp_path)) == 2
    with pytest.raises(ValueError, match="split"):
        open_pairs(f"sidd-cc:{tmp_path}:test")
    with pytest.raises(ValueError, match="validation"):
        open_pairs(f"sidd:{tmp_path}", split="validation")


def test_incomplete_and_damaged_frames_are_reported(tmp_path: Path, mat73: Writer) -> None:
    name = "0001_001_IP_00100_00060_3200_L"
    write_scene(tmp_path, mat73, name, ("010",))
    gt = tmp_path / name / "0001_GT_RAW_010.MAT"
    content = gt.read_bytes()
    gt.unlink()
    with pytest.raises(ValueError, match=r"0001_NOISY_RAW_010\.MAT: .*GT_RAW_010"):
        SiddFrames(tmp_path)
    gt.write_bytes(content[: len(content) // 2])
    frames = SiddFrames(tmp_path)
    with pytest.raises(OSError, match=r"0001_GT_RAW_010\.MAT: .*MATLAB"):
        frames[0]
    mat73(gt, {"x": 4095 * clean_frame(CFA.RGGB)[0].numpy()})
    with pytest.raises(ValueError, match="normalised"):
        frames[0]
    mat73(gt, {"x": clean_frame(CFA.RGGB, 64, 64)[0].numpy()})
    with pytest.raises(ValueError, match="differ"):
        frames[0]
    gt.write_bytes(content)
    black = {"AsShotNeutral": np.array([0.5, 1.0, 0.0]), "ColorMatrix2": COLOUR.ravel()}
    for tags in ({"Make": "Apple"}, black, {**black, "AsShotNeutral": np.ones(3), "ColorMatrix2": np.full(9, np.nan)}):
        savemat(tmp_path / name / "0001_METADATA_RAW_010.MAT", {"metadata": tags})
        with pytest.raises(ValueError, match=r"0001_METADATA_RAW_010\.MAT: .*AsShotNeutral"):
            frames[0]


SIDE = 16
"""Of a block; 256 as published."""


def flat_frame(cfa: CFA) -> torch.Tensor:
    return mosaic(torch.tensor(GREY).float().reshape(3, 1, 1).expand(3, SIDE, SIDE), cfa)


@pytest.fixture(scope="module")
def blocks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Validation and benchmark as published, with blocks of 16 x 16: each in the pattern of its scene instance."""
    folder = tmp_path_factory.mktemp("sidd_blocks")
    clean = torch.stack([flat_frame(find_phone(name)[1]).expand(32, SIDE, SIDE) for name in HELD_BACK])
    clean = clean * torch.linspace(0.2, 1, 32)[:, None, None]
    noisy = noisy_frame(clean)
    for name, values in (("ValidationGt", clean), ("ValidationNoisy", noisy), ("BenchmarkNoisy", noisy.flip(1))):
        savemat(folder / f"{name}BlocksRaw.mat", {f"{name}BlocksRaw": values.numpy()})
    return folder


def test_blocks_have_the_pattern_of_their_scene(blocks: Path) -> None:
    pairs = SiddBlocks(blocks)
    assert len(pairs) == 1280 and pairs.names[33] == f"{HELD_BACK[1]}_01"
    assert [str(pairs[32 * k].cfa) for k in range(5)] == ["GRBG", "BGGR", "BGGR", "BGGR", "RGGB"]
    for k in (0, 32 * 4 + 31):
        pair = pairs[k]
        bright = torch.linspace(0.2, 1, 32)[k % 32]
        expected = flat_frame(pair.cfa) * bright
        assert torch.allclose(pair.clean.mosaic, expected) and pair.noisy is not None
        packed = pack(pair.clean.mosaic, pair.cfa).mean(dim=(1, 2))
        assert packed[0] < packed[3] < packed[1], "red is darker than blue, blue than green"
        assert pair.noisy.noise_profile is not None
        assert pair.noisy.noise_profile[0] == pytest.approx(SHOT_VAR, rel=0.5) and pair.clean.white_balance == (1, 1, 1)


def test_the_benchmark_and_its_submission(blocks: Path, tmp_path: Path) -> None:
    benchmark = SiddBenchmark(blocks)
    noisy = list(benchmark)
    assert len(noisy) == 1280 and noisy[0].name == f"{HELD_BACK[0]}_00" and noisy[0].cfa == CFA.GRBG
    block = SiddBlocks(blocks)[31].noisy
    assert block is not None and torch.equal(noisy[0].mosaic, block.mosaic)
    path = tmp_path / "SubmitRaw.csv"
    write_submission(path, (block.mosaic / 2 for block in benchmark), SIDE)
    assert torch.equal(read_submission(path), torch.stack([block.mosaic / 2 for block in noisy]))


def read_submission(path: Path) -> torch.Tensor:
    """The blocks ``(1280, 1, 16, 16)`` as the benchmark's server reads them."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["ID"] for row in rows] == [str(k) for k in range(1280)]
    data = b"".join(base64.b64decode(row["BLOCK"]) for row in rows)
    return torch.from_numpy(np.frombuffer(data, "<f4").reshape(1280, 1, SIDE, SIDE).copy())


def test_the_command_takes_published_levels_or_asks_for_them(blocks: Path, tmp_path: Path) -> None:
    for file in blocks.iterdir():
        (tmp_path / file.name).symlink_to(file)
    write_levels(tmp_path, [f"{name}, {k}, 1e-4, {k}, 1e-4, {k}, 1e-4" for k, name in enumerate(HELD_BACK)])
    seen: list[tuple[float, float]] = []

    class Noted(RawDenoiser):
        def frame(self, frame: RawFrame, levels: tuple[float, float] | None) -> torch.Tensor:
            assert levels is not None
            seen.append(levels)
            return frame.mosaic + (0.1 if frame.cfa == CFA.GRBG else -2.0)

    method = Noted(name="noted", model=lambda levels: lambda noisy, variance: noisy)
    out = str(tmp_path / "SubmitRaw.csv")
    submit(str(tmp_path), out, method)
    assert [seen[32 * k] for k in (0, 7, 39)] == [(0.0, 1e-4), (7.0, 1e-4), (39.0, 1e-4)]
    written = read_submission(Path(out))
    assert torch.equal(written[0], (SiddBenchmark(blocks)[0].mosaic + 0.1).clamp(0.0, 1.0)) and written[32].max() == 0.0
    with pytest.raises(ValueError, match=rf"{HELD_BACK[0]}.*noise_level_functions"):
        submit(str(blocks), out, method)
    submit(str(blocks), out, replace(method, reads_levels=False))
    assert seen[-1] == (0.0, 0.0)
    assert main(["submit", "zurich:here", out]) == 2 and main(["submit", "sidd:", out]) == 2


def test_wrong_submissions_are_refused(tmp_path: Path) -> None:
    block = torch.full((1, SIDE, SIDE), 0.5)
    with pytest.raises(ValueError, match="submission"):
        write_submission(tmp_path / "a.csv", [block] * 3, SIDE)
    for wrong in (torch.zeros(1, SIDE, SIDE + 2), block * 3, block * float("nan")):
        with pytest.raises(ValueError, match="block"):
            write_submission(tmp_path / "a.csv", [block, wrong], SIDE)
    with pytest.raises(ValueError, match=r"\.csv"):
        write_submission(tmp_path / "a.npz", [block], SIDE)
    assert not list(tmp_path.iterdir())


def test_sidd_plus_has_a_pattern_for_each_frame(tmp_path: Path) -> None:
    cfas = [CFA.RGGB, CFA.BGGR]
    clean = torch.cat([clean_frame(cfa, SIDE, SIDE).expand(32, -1, -1) for cfa in cfas])
    for kind, values in (("gt", clean), ("noisy", noisy_frame(clean))):
        name = f"siddplus_valid_{kind}_raw"
        savemat(tmp_path / f"{name}.mat", {name: values.numpy()})
    (tmp_path / "siddplus_valid_bayer_patterns.csv").write_text("rggb\nbggr\n")
    pairs = open_pairs(f"siddplus:{tmp_path}")
    assert [pairs[k].cfa for k in (0, 31, 32, 63)] == [CFA.RGGB, CFA.RGGB, CFA.BGGR, CFA.BGGR] and len(pairs) == 64
    assert torch.equal(pairs[40].clean.mosaic, clean_frame(CFA.BGGR, SIDE, SIDE))
    (tmp_path / "siddplus_valid_bayer_patterns.csv").write_text("rggb\n")
    with pytest.raises(ValueError, match="patterns"):
        SiddPlusBlocks(tmp_path)[0]


def test_a_file_of_blocks_found_wrong_is_not_read_for_every_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind in ("gt", "noisy"):
        name = f"siddplus_valid_{kind}_raw"
        savemat(tmp_path / f"{name}.mat", {name: np.full((64, 8, 8), 0.5, np.float32)})
    patterns = tmp_path / "siddplus_valid_bayer_patterns.csv"
    patterns.write_text("rggb\n" * 32)
    reads = []

    def counted(file: Path, name: str) -> Any:
        reads.append(file)
        return read_array(file, name)

    monkeypatch.setattr(sidd_blocks, "read_array", counted)
    (part,) = check(tmp_path).parts
    assert part.items == 1024 and len(reads) == 2
    assert len(part.unfit) == 1 and "64 blocks" in part.unfit[0]
    for content in ("rggb\nrgbw\n", "\0"):
        patterns.write_text(content)
        with pytest.raises(ValueError, match=r"bayer_patterns\.csv: .*patterns") as error:
            SiddPlusBlocks(tmp_path)
        assert "\n" not in str(error.value)


SCENES = ("0009_001_S6_00800_00350_3200_L", "0021_001_GP_10000_05000_5500_N")


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
    monkeypatch.setattr(sidd_blocks, "HELD_BACK", SCENES)
    coarse = torch.rand(64, 3, 4, 4, generator=torch.Generator().manual_seed(0))
    smooth = torch.nn.functional.interpolate(coarse, (SIDE, SIDE), mode="bilinear").mul(0.7).add(0.1)
    return (255 * smooth).round().to(torch.uint8).unflatten(0, (2, 32))


def raw_of(camera: DictionaryISP, pictures: Tensor) -> Tensor:
    """Mosaics ``(2, 32, SIDE, SIDE)`` in the pattern of each scene's phone, of 12 bits."""
    mosaics = []
    for name, srgb in zip(SCENES, pictures, strict=True):
        camera.configure(cfa=str(find_phone(name)[1]))
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
    with pytest.raises(ValueError, match=rf"{SCENES[0]}_00.*white balance") as refusal:
        psnr_r(camera, pair)
    assert "\n" not in str(refusal.value)
    shot = tmp_path / SCENES[0]
    shot.mkdir()
    tags = {"AsShotNeutral": [(0.5, 1.0, 0.8)], "ColorMatrix2": np.eye(3).reshape(1, 9) + 0.1}
    savemat(shot / "0009_METADATA_RAW_010.MAT", {"metadata": tags})
    write_levels(tmp_path, [f"{SCENES[0]}, 0.01, 1e-4, 0.01, 1e-4, 0.01, 1e-4"])
    pairs = SiddBlocks(tmp_path)
    assert pairs[0].rendered and psnr_r(camera, pairs[0]) < 60.0 and pairs[0].clean.white_balance == (2.0, 1.0, 1.25)
    assert not pairs[0].levels_from_clean and pairs[32].levels_from_clean and pairs[32].clean.white_balance == (1, 1, 1)
    with pytest.raises(ValueError, match=f"{SCENES[1]}_00.*picture"):
        psnr_r(camera, pairs[32])


def test_pictures_of_something_else_are_refused(tmp_path: Path, camera: DictionaryISP, pictures: Tensor) -> None:
    write_blocks(tmp_path, raw_of(camera, pictures), pictures.flip(1))
    with pytest.raises(ValueError, match=rf"{SCENES[0]}.*blocks"):
        SiddBlocks(tmp_path)[0]
    write_blocks(tmp_path, raw_of(camera, pictures), pictures[..., :8, :8])
    with pytest.raises(ValueError, match="mosaics"):
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
