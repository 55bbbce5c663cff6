from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rawpy
import tifffile
import torch
from torch import Tensor

from rawaug.bayer import CFA, mosaic, turn
from rawaug.io import develop, raw, read_raw, read_raw_and_develop, write_dng

Dng = Callable[..., Path]
NUMBERS = np.random.default_rng(0).integers(0, 4096, (40, 62)).astype(np.uint16)


def decode_bt709(display: Tensor) -> Tensor:
    return torch.where(display < 0.081, display / 4.5, ((display.clamp(min=0.081) + 0.099) / 1.099) ** (1 / 0.45))


def psnr_of_raw_from_rendering(frame: raw.RawFrame, srgb: Tensor) -> float:
    """RAW predicted at its sites from the rendering and the metadata alone, where the rendering is not clipped."""
    display = srgb.double() / 255
    gains = torch.tensor(frame.white_balance, dtype=torch.float64).reshape(3, 1, 1)
    inverse = torch.linalg.inv(frame.color_matrix.double())
    camera = torch.einsum("ij,jhw->ihw", inverse, decode_bt709(display)) / gains
    predicted = mosaic(camera, frame.cfa)[0]
    unclipped = ((display > 0.01) & (display < 0.98)).all(0)
    assert unclipped.float().mean() > 0.5
    error = (predicted - frame.mosaic[0])[unclipped]
    return -10 * torch.log10(error.square().mean()).item()


@pytest.mark.parametrize("cfa", list(CFA))
@pytest.mark.parametrize("black", [(511,), (497, 501, 506, 515)])
def test_the_mosaic_is_normalised_site_by_site(
    tmp_path: Path, bayer_dng: Dng, cfa: CFA, black: tuple[int, ...]
) -> None:
    frame = read_raw(bayer_dng(tmp_path / "a.dng", NUMBERS, cfa.value, black=black, white=4001))
    levels = np.array(black * (4 // len(black)), np.float64).reshape(2, 2)
    per_site = np.tile(levels, (20, 31))
    expected = np.minimum((NUMBERS - per_site) / (4001 - per_site), 1)
    assert frame.cfa == cfa
    assert frame.mosaic.dtype == torch.float32 and frame.mosaic.shape == (1, 40, 62)
    assert np.allclose(frame.mosaic[0].numpy(), expected, atol=1e-6)
    assert frame.black == tuple(levels[site] for site in cfa.sites) and frame.white == 4001
    assert frame.mosaic.min() < -0.1, "clipped at black"
    assert (frame.mosaic == 1).any() and frame.mosaic.max() == 1


@pytest.mark.parametrize("cfa", list(CFA))
def test_the_rendering_agrees_with_the_mosaic(tmp_path: Path, bayer_dng: Dng, cfa: CFA) -> None:
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 96), indexing="ij")
    camera = torch.stack([0.10 + 0.15 * x, 0.2 + 0.2 * y, 0.1 + 0.2 * (1 - x) * y])
    numbers = (mosaic(camera, cfa)[0] * (16383 - 513) + 513).round().numpy().astype(np.uint16)
    path = bayer_dng(tmp_path / "a.dng", numbers, cfa.value, black=(513,), white=16383)
    frame, srgb = read_raw_and_develop(path)
    assert srgb.dtype == torch.uint8 and srgb.shape == (3, 64, 96)
    assert torch.equal(srgb, develop(path))
    assert psnr_of_raw_from_rendering(frame, srgb) > 55


def test_metadata_is_read(tmp_path: Path, bayer_dng: Dng) -> None:
    profile = (1e-3, 1e-6, 2e-3, 3e-6, 3e-3, 5e-6)
    frame = read_raw(bayer_dng(tmp_path / "shot.dng", NUMBERS, noise_profile=profile))
    assert (frame.name, frame.camera, frame.iso) == ("shot", "Maker Model 1", None)
    assert frame.noise_profile == pytest.approx((2e-3, 3e-6))
    assert frame.white_balance == pytest.approx((2.0, 1.0, 1.6), abs=1e-4)
    assert frame.color_matrix.sum(1).tolist() == pytest.approx([1, 1, 1], abs=1e-5)
    assert frame.color_known


def test_fractions_of_black_levels_are_kept(tmp_path: Path, bayer_dng: Dng) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS, black=(1, 1, 1, 1))
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages.first.tags["BlackLevel"].overwrite((257, 4, 129, 2, 255, 4, 64, 1), dtype=5)
    frame = read_raw(path)
    assert frame.black == (64.25, 64.5, 63.75, 64.0)
    assert frame.mosaic[0, 1, 0].item() == pytest.approx((NUMBERS[1, 0] - 63.75) / (4095 - 63.75), abs=1e-7)


def test_daylight_is_what_the_white_of_srgb_needs(tmp_path: Path, bayer_dng: Dng) -> None:
    matrix = np.array([[0.80, -0.20, -0.10], [-0.40, 1.20, 0.20], [-0.05, 0.15, 0.60]])
    white = matrix @ raw.XYZ_FROM_SRGB.sum(1)
    frame = read_raw(bayer_dng(tmp_path / "a.dng", NUMBERS, color_matrix=matrix))
    assert frame.daylight == pytest.approx(tuple(white[1] / white), rel=1e-3)
    unknown = read_raw(bayer_dng(tmp_path / "b.dng", NUMBERS, color_matrix=None))
    assert unknown.daylight == pytest.approx(unknown.white_balance) and not unknown.color_known
    assert unknown.color_matrix.sum(1).tolist() == pytest.approx([1, 1, 1]) and unknown.noise_profile is None


def test_the_last_line_of_an_odd_side_is_left_out(tmp_path: Path, bayer_dng: Dng) -> None:
    frame, srgb = read_raw_and_develop(bayer_dng(tmp_path / "a.dng", NUMBERS[:39, :61].copy()))
    assert frame.mosaic.shape == (1, 38, 60) and srgb.shape == (3, 38, 60)
    assert np.allclose(frame.mosaic[0].numpy(), NUMBERS[:38, :60] / 4095, atol=1e-6)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_upright_view_is_how_libraw_shows_it(tmp_path: Path, bayer_dng: Dng, orientation: int) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS, orientation=orientation)
    frame, srgb = read_raw_and_develop(path)
    with rawpy.imread(str(path)) as file:
        shown = file.postprocess(use_camera_wb=True, no_auto_bright=True, adjust_maximum_thr=0)
    assert srgb.shape[-2:] == frame.mosaic.shape[-2:]
    assert np.array_equal(turn(srgb, frame.upright_view).permute(1, 2, 0).numpy(), shown)


CELLS: dict[str, tuple[int, int, list[int], tuple[int, ...]]] = {
    "6 x 6": (6, 6, [1] * 35 + [0], (0, 1, 2)),
    "RGBE": (2, 2, [0, 1, 3, 2], (0, 1, 2, 3)),
    "CYGM of 4 x 4": (4, 4, [3, 5, 3, 5, 4, 1, 1, 4, 3, 5, 3, 5, 1, 4, 4, 1], (1, 4, 3, 5)),
    "RGBW of 4 x 4": (4, 4, [6, 0, 6, 1, 0, 6, 1, 6, 6, 1, 6, 2, 1, 6, 2, 6], (0, 1, 2, 6)),
    "4 x 4 that begins as RGGB": (4, 4, [0, 1, 1, 0, 1, 2, 2, 1] * 2, (0, 1, 2)),
    "8 x 2 that begins as RGGB": (8, 2, [0, 1, 1, 2] * 3 + [1, 0, 2, 1], (0, 1, 2)),
}
"""Rows, columns, colours and planes as DNG numbers them: red, green, blue, cyan, magenta, yellow, white."""


def not_bayer(name: str) -> dict[str, object]:
    if name in CELLS:
        rows, columns, cell, planes = CELLS[name]
        layout = (33421, 3, 2, (rows, columns), True), (33422, 1, len(cell), bytes(cell), True)
        return {"cfa": None, "extra": [*layout, (50710, 1, len(planes), bytes(planes), True)]}
    if name == "monochrome":
        return {"cfa": "GGGG"}
    return {"numbers": np.stack([NUMBERS] * 3, -1), "cfa": None}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("6 x 6", r"\(RGBG, cell 6 x 6\)"),
        ("RGBE", r"\(GMCY, cell 2 x 2\)"),
        ("CYGM of 4 x 4", r"\(GMCY, cell 4 x 4\)"),
        ("RGBW of 4 x 4", r"\(GMCY, cell 4 x 4\)"),
        ("4 x 4 that begins as RGGB", r"\(RGBG, cell 4 x 4\)"),
        ("8 x 2 that begins as RGGB", r"\(RGBG, cell 2 x 2\)"),
        ("monochrome", "but a monochrome picture;"),
        ("linear", "full colour"),
    ],
)
def test_patterns_that_are_not_known_are_refused_in_one_line(
    tmp_path: Path, bayer_dng: Dng, name: str, said: str
) -> None:
    path = bayer_dng(tmp_path / "other.dng", **{"numbers": NUMBERS, **not_bayer(name)})
    with pytest.raises(ValueError, match=rf"other\.dng.*pattern.*{said}") as caught:
        read_raw(path)
    assert "\n" not in str(caught.value)


def test_broken_files_are_named(tmp_path: Path, bayer_dng: Dng, capfd: pytest.CaptureFixture[str]) -> None:
    path = bayer_dng(tmp_path / "cut.dng", NUMBERS)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(OSError, match=r"cut\.dng: .*truncated"):
        read_raw(path)
    path.write_bytes(b"no RAW at all")
    with pytest.raises(OSError, match=r"cut\.dng: .*LibRaw"):
        read_raw(path)
    with pytest.raises(FileNotFoundError, match=r"none\.dng:"):
        read_raw(tmp_path / "none.dng")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("orientation", [0, 9, 10, 15])
def test_an_orientation_that_exif_does_not_have_turns_nothing(
    orientation: int, tmp_path: Path, bayer_dng: Dng, capfd: pytest.CaptureFixture[str]
) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS, orientation=orientation)
    frame = read_raw(path)
    assert frame.orientation == 0
    write_dng(tmp_path / "b.dng", frame, source=path)
    with tifffile.TiffFile(tmp_path / "b.dng") as tiff:
        assert int(tiff.pages.first.tags["Orientation"].value) == 1
    assert capfd.readouterr().err == "", "tifffile's lines"


@pytest.mark.parametrize("magic", [b"\x55\x00", b"RO"])
def test_tiffs_with_a_magic_number_of_their_own_say_nothing(
    magic: bytes, tmp_path: Path, bayer_dng: Dng, capfd: pytest.CaptureFixture[str]
) -> None:
    """As Panasonic and Olympus write them."""
    path = bayer_dng(tmp_path / "a.rw2", NUMBERS)
    content = bytearray(path.read_bytes())
    content[2:4] = magic
    path.write_bytes(content)
    write_dng(tmp_path / "b.dng", read_raw(path), source=path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("shape", [(4, 4), (1, 8), (8, 1), (3, 2)])
@pytest.mark.parametrize("cfa", ["RGGB", "GBRG"])
def test_black_levels_of_any_cell_are_taken_off(
    shape: tuple[int, int], cfa: str, tmp_path: Path, bayer_dng: Dng
) -> None:
    rows, columns = shape
    levels = 490 + 2 * np.arange(rows * columns)
    extra = [(50713, 3, 2, shape, True), (50714, 3, len(levels), tuple(levels.tolist()), True)]
    path = bayer_dng(tmp_path / "a.dng", NUMBERS, cfa, black=None, extra=extra)
    frame = read_raw(path)
    per_site = np.tile(levels.reshape(shape), (40, 62))[:40, :62]
    expected = np.minimum((NUMBERS.astype(float) - per_site) / (4095 - per_site), 1)
    assert np.abs(frame.mosaic[0].numpy() - expected).max() < 1e-6
    written = dataclasses.replace(frame, mosaic=frame.mosaic.clamp(min=-min(frame.black) / 4095))
    write_dng(tmp_path / "b.dng", written, source=path)
    back = read_raw(tmp_path / "b.dng")
    assert (back.mosaic - written.mosaic).abs().max() < 0.6 / (4095 - 520)


@pytest.mark.parametrize(
    "profile", [(1e-3, -1e-5), (float("nan"),) * 2, (1e-3,), (2.0, 0.1), (0.0,) * 6, (1e-3, 1e-5, -1e-3, 1e-5)]
)
def test_a_noise_profile_out_of_range_is_remarked(profile: tuple[float, ...], tmp_path: Path, bayer_dng: Dng) -> None:
    frame = read_raw(bayer_dng(tmp_path / "a.dng", NUMBERS, noise_profile=profile))
    assert frame.noise_profile is None
    (remark,) = frame.remarks
    assert remark.startswith("NoiseProfile")


def test_phones_profiles_without_read_noise_are_taken(tmp_path: Path, bayer_dng: Dng) -> None:
    frame = read_raw(bayer_dng(tmp_path / "a.dng", NUMBERS, noise_profile=(0.004, 0.0)))
    assert frame.noise_profile == (0.004, 0.0) and frame.remarks == ()


def test_jpeg_xl_is_named(tmp_path: Path, bayer_dng: Dng) -> None:
    path = bayer_dng(tmp_path / "a.dng", NUMBERS)
    with tifffile.TiffFile(path, mode="r+") as tiff:
        tiff.pages.first.tags["Compression"].overwrite(52546)
    with pytest.raises(ValueError, match="JPEG XL"):
        read_raw(path)


def test_white_below_black_is_refused(tmp_path: Path, bayer_dng: Dng) -> None:
    with pytest.raises(ValueError, match=r"a\.dng: .*white"):
        read_raw(bayer_dng(tmp_path / "a.dng", NUMBERS, black=(511,), white=500))


def test_a_fork_of_a_renderer_renders_the_same_and_does_not_hang(tmp_path: Path, bayer_dng: Dng) -> None:
    """Whose OpenMP threads a fork does not have."""
    path = bayer_dng(tmp_path / "a.dng", np.tile(NUMBERS, (8, 8)))
    here = develop(path)
    receiving, sending = multiprocessing.Pipe(duplex=False)
    child = multiprocessing.get_context("fork").Process(target=lambda: sending.send(develop(path).numpy()), daemon=True)
    child.start()
    try:
        assert receiving.poll(60), "it hangs"
        assert np.array_equal(receiving.recv(), here.numpy())
    finally:
        child.kill()


def test_canon_and_gopro_frames(camera_files: Path) -> None:
    frame, srgb = read_raw_and_develop(camera_files / "raw/canon/s40_0101.crw")
    assert (frame.camera, frame.iso, frame.cfa) == ("Canon PowerShot S40", 50, CFA.RGGB)
    assert frame.mosaic.shape == (1, 1720, 2312) and frame.black == (32,) * 4 and frame.white == 1023
    assert frame.exposure.seconds == pytest.approx(1 / 103.07, rel=1e-4), "what the camera did, not what it aimed at"
    assert psnr_of_raw_from_rendering(frame, srgb) > 60
    one_cell_off = dataclasses.replace(frame, mosaic=frame.mosaic.roll(2, -1))
    assert psnr_of_raw_from_rendering(one_cell_off, srgb) < 45

    path = camera_files / "raw/gopro/hero6_0024.dng"
    frame = read_raw(path)
    assert frame.camera == "GoPro HERO6 Black" and frame.orientation == 1
    assert frame.noise_profile == pytest.approx((1.562e-4, 4.88e-8), rel=1e-3)
    assert frame.exposure.seconds == pytest.approx(1 / 455) and frame.exposure.date == "2016:01:01 23:07:27"
    assert len(frame.gain_maps) == 4
    for m in frame.gain_maps:
        middle = m.gains[0, m.gains.shape[1] // 2, m.gains.shape[2] // 2]
        assert m.gains.min() >= 1 and middle < 1.05 < 1.5 < m.gains[0, 0, 0]
    with tifffile.TiffFile(path) as tiff:
        tag = np.array(tiff.pages[0].tags["ColorMatrix2"].value, np.float64)  # for D50; the other is for tungsten
    camera = (tag[0::2] / tag[1::2]).reshape(3, 3) @ raw.XYZ_FROM_SRGB
    expected = np.linalg.inv(camera / camera.sum(1, keepdims=True))
    assert np.allclose(frame.color_matrix.numpy(), expected, atol=1e-3)


def test_a_developed_picture_is_called_one(tmp_path: Path) -> None:
    from rawaug.io import write_picture

    for name in ("a.jpg", "a.png"):
        write_picture(tmp_path / name, torch.zeros(3, 8, 8, dtype=torch.uint8))
        with pytest.raises(ValueError, match=f"{name}.*developed picture"):
            read_raw(tmp_path / name)
