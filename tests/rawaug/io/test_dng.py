from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imagecodecs
import numpy as np
import pytest
import rawpy
import tifffile
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from rawaug.bayer import CFA, mosaic, pattern, plane_indices
from rawaug.io import GainMap, RawFrame, develop, dng, read_raw, read_raw_and_develop, write_dng
from rawaug.io.carried import read_carried
from rawaug.io.cells import MONOCHROME
from rawaug.io.directories import Tag, TiffFile
from rawaug.io.gain_map import parse_gain_maps
from rawaug.io.raw import Exposure

MATRIX = torch.tensor([[1.7, -0.5, -0.2], [-0.3, 1.6, -0.3], [0.0, -0.6, 1.6]])
WHITE_BALANCE = (2.1, 1.0, 1.4)


def a_frame(numbers: np.ndarray, cfa: CFA, black: tuple[float, ...], white: int, **fields: object) -> RawFrame:
    """The frame whose digital numbers are ``numbers`` ``(H, W)``."""
    levels = np.zeros((2, 2))
    for site, level in zip(cfa.sites, black, strict=True):
        levels[site] = level
    per_site = np.tile(levels, (numbers.shape[0] // 2, numbers.shape[1] // 2))
    raw = torch.from_numpy(((numbers - per_site) / (white - per_site)).astype(np.float32))[None]
    usual = {
        "white_balance": WHITE_BALANCE,
        "daylight": (1.9, 1.0, 1.6),
        "color_matrix": MATRIX,
        "camera": "Maker Model 1",
        "iso": None,
        "noise_profile": None,
        "orientation": 0,
        "name": "a",
    }
    return RawFrame(raw.clamp(max=1), cfa, tuple(black), float(white), **{**usual, **fields})  # type: ignore[arg-type]


def test_mosaics_are_compressed(tmp_path: Path) -> None:
    numbers = np.add.outer(np.arange(64), np.arange(64)) + 1000
    numbers[:, 1::2] += 8000  # neighbours of another colour differ much, those of the same colour by two
    frame = a_frame(numbers, CFA.RGGB, (64,) * 4, 16383)
    write_dng(tmp_path / "a.dng", frame)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        assert file.pages.first.databytecounts[0] < 64 * 64 * 0.6
    assert (numbers_in(tmp_path / "a.dng") == numbers).all()


def numbers_in(path: Path) -> np.ndarray:
    with rawpy.imread(str(path)) as file:
        return file.raw_image_visible.copy()


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    cfa=st.sampled_from(list(CFA)),
    bits=st.integers(10, 16),
    quarters=st.lists(st.integers(0, 1020), min_size=4, max_size=4),
    size=st.tuples(st.integers(16, 24), st.integers(16, 24)),
    seed=st.integers(0, 2**32 - 1),
)
def test_libraw_reads_back_the_same_bits(
    tmp_path: Path, cfa: CFA, bits: int, quarters: list[int], size: tuple[int, int], seed: int
) -> None:
    white, blacks = 2**bits - 1, [level / 4 for level in quarters]
    shape = 2 * size[0], 2 * size[1]
    numbers = np.random.default_rng(seed).integers(0, white + 1, shape).astype(np.uint16)
    frame = a_frame(numbers, cfa, tuple(blacks), white)
    write_dng(tmp_path / "a.dng", frame)
    assert np.array_equal(numbers_in(tmp_path / "a.dng"), numbers)
    back = read_raw(tmp_path / "a.dng")
    assert (back.cfa, back.black, back.white) == (cfa, tuple(blacks), white)
    assert torch.allclose(back.mosaic, frame.mosaic, atol=1e-7, rtol=0)


@pytest.mark.parametrize("flip", range(8))
def test_metadata_goes_there_and_back(tmp_path: Path, flip: int) -> None:
    gain_map = GainMap((0, 0, 32, 48), (1, 1), (0, 1), (0.0, 0.0), (0.5, 0.5), torch.rand(1, 3, 3) + 1)
    frame = a_frame(
        np.full((32, 48), 700, np.uint16), CFA.BGGR, (64,) * 4, 1023,
        iso=800.0, noise_profile=(2e-3, 3e-6), orientation=flip, gain_maps=(gain_map,),
        exposure=Exposure(1 / 60, 2.8, 35.0, "2020:02:29 12:00:00"),
    )  # fmt: skip
    write_dng(tmp_path / "a.dng", frame)
    back = read_raw(tmp_path / "a.dng")
    assert (back.camera, back.iso, back.orientation, back.color_known) == ("Maker Model 1", 800, flip, True)
    assert back.noise_profile == (2e-3, 3e-6)
    assert back.white_balance == pytest.approx(frame.white_balance, rel=1e-5)
    assert back.daylight == pytest.approx(frame.daylight, rel=1e-3)
    assert torch.allclose(back.color_matrix, MATRIX, atol=2e-4)
    assert torch.equal(back.gain_maps[0].gains, gain_map.gains)
    assert back.exposure.seconds == pytest.approx(1 / 60, rel=1e-3) and back.exposure.f_number == pytest.approx(2.8)
    assert back.exposure.date == "2020:02:29 12:00:00"


def test_linear_dngs_hold_full_colour_and_what_the_source_says(tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).integers(64, 1024, (32, 48)).astype(np.uint16)
    shading = [
        GainMap((i, j, 32, 48), (2, 2), (0, 1), (0.0, 0.0), (0.5, 0.5), torch.full((1, 3, 3), gain))
        for (i, j), gain in zip(CFA.BGGR.sites, (1.5, 1.2, 1.2, 1.1), strict=True)
    ]
    shot = {"iso": 800.0, "noise_profile": (2e-3, 3e-6), "orientation": 6, "gain_maps": tuple(shading)}
    exposure = Exposure(1 / 60, 2.8, 35.0, "2020:02:29 12:00:00")
    frame = a_frame(numbers, CFA.BGGR, (60, 62, 66, 70), 1023, exposure=exposure, **shot)
    write_dng(tmp_path / "mosaic.dng", frame)
    rgb = torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(0)) * 1.1 - 0.02
    write_dng(tmp_path / "linear.dng", frame, tmp_path / "mosaic.dng", rgb=rgb)
    expected = (rgb.clamp(0, 1) * 65535).round().permute(1, 2, 0).numpy()
    with rawpy.imread(str(tmp_path / "linear.dng")) as file:
        assert (file.raw_image_visible[..., :3] == expected).all(), "LibRaw reads it bit for bit"
    with tifffile.TiffFile(tmp_path / "linear.dng") as linear, tifffile.TiffFile(tmp_path / "mosaic.dng") as mosaic:
        of, before = linear.pages.first.tags, mosaic.pages.first.tags
        assert (of[262].value, of[277].value) == (34892, 3)
        assert [of[code].value for code in (50713, 50714, 50717)] == [(1, 1), (0, 10**6) * 3, (65535,) * 3]
        for code in (274, 306, 50706, 50708, 50721, 50728, 50778, 34665):  # colour, names, orientation, EXIF
            assert of[code].value == before[code].value, code
        assert not {33421, 33422, 50710, 50711, 51041} & {tag.code for tag in of}
        maps = parse_gain_maps(of[51009].value, on_mosaic=False)
    found = torch.ones(3)
    for m in maps:
        assert m.pitch == (1, 1) and m.area == (0, 0, 32, 48)
        found[m.planes[0]] *= m.gains[0, 0, 0]
    torch.testing.assert_close(found, torch.tensor([1.5, 1.2, 1.1]))
    with pytest.raises(ValueError, match="colour"):
        write_dng(tmp_path / "other.dng", frame, rgb=rgb[:, ::2, ::2])


def colour_patches() -> Tensor:
    """Linear sRGB ``(3, 64, 96)``: six flat patches."""
    tones = torch.tensor(
        [[0.2, 0.2, 0.2], [0.4, 0.1, 0.1], [0.1, 0.4, 0.1], [0.1, 0.1, 0.4], [0.4, 0.4, 0.1], [0.4] * 3]
    )
    return tones.reshape(2, 3, 3).repeat_interleave(32, 0).repeat_interleave(32, 1).permute(2, 0, 1)


@pytest.mark.parametrize("cfa", list(CFA))
def test_a_raw_developer_shows_the_colours_that_were_meant(tmp_path: Path, cfa: CFA) -> None:
    srgb = colour_patches()
    camera = torch.einsum("ij,jhw->ihw", torch.linalg.inv(MATRIX), srgb) / torch.tensor(WHITE_BALANCE)[:, None, None]
    numbers = (mosaic(camera, cfa)[0] * (16383 - 512) + 512).round().numpy().astype(np.uint16)
    write_dng(tmp_path / "a.dng", a_frame(numbers, cfa, (512,) * 4, 16383))
    shown = read_raw_and_develop(tmp_path / "a.dng")[1].float() / 255
    expected = torch.where(srgb < 0.018, 4.5 * srgb, 1.099 * srgb**0.45 - 0.099)  # BT.709, LibRaw's default
    inner = torch.zeros(64, 96, dtype=torch.bool)
    for i in (0, 32):
        for j in (0, 32, 64):
            inner[i + 8 : i + 24, j + 8 : j + 24] = True
    assert (shown - expected)[:, inner].abs().max() < 0.02


def test_metadata_of_a_source_are_kept(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.random.default_rng(0).integers(0, 4096, (32, 48)).astype(np.uint16)
    matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    extra = [(50940, 11, 4, (0.0, 0.0, 1.0, 1.0), True), (50936, 2, 0, "Vivid", True), (51111, 1, 16, bytes(16), True)]
    profile = (1e-3, 1e-5)
    source = bayer_dng(
        tmp_path / "source.dng", numbers, color_matrix=matrix, orientation=6, extra=extra, noise_profile=profile
    )
    frame = read_raw(source)
    assert frame.noise_profile == profile
    write_dng(tmp_path / "plain.dng", dataclasses.replace(frame, iso=1600.0))  # a file with EXIF, to be a source too
    halved = dataclasses.replace(frame, mosaic=frame.mosaic.clamp(max=0.5), noise_profile=None)
    write_dng(tmp_path / "a.dng", halved, source)
    with tifffile.TiffFile(tmp_path / "a.dng") as tiff:
        tags = tiff.pages.first.tags
        assert tags["ProfileName"].value == "Vivid" and tags.valueof(50940) == (0.0, 0.0, 1.0, 1.0)
        assert tags[51111].value != bytes(16) and tags["Orientation"].value == 6
        assert np.array_equal(tags["ColorMatrix1"].value[::2], 10000 * np.eye(3).ravel())
    back = read_raw(tmp_path / "a.dng")
    assert back.mosaic.max() < 0.51 and back.orientation == frame.orientation
    assert back.noise_profile is None  # that of the source described the old pixels
    write_dng(tmp_path / "b.dng", frame, tmp_path / "plain.dng")
    assert read_raw(tmp_path / "b.dng").iso == 1600


def test_directories_are_copied_in_either_byte_order(tmp_path: Path) -> None:
    exif = [(33434, 5, struct.pack(">2I", 1, 125)), (36867, 2, b"2020:02:29 12:00:00\0"), (37500, 7, b"maker note")]
    source = tmp_path / "big.tif"
    tifffile.imwrite(
        source, np.zeros((4, 4), np.uint8), byteorder=">", metadata=None, extratags=[("ExifTag", 4, 1, 0, True)]
    )
    data = bytearray(source.read_bytes())
    start = len(data)
    table, values, beyond = struct.pack(">H", len(exif)), b"", start + 2 + 12 * len(exif) + 4
    for code, dtype, value in exif:
        count = 1 if dtype == 5 else len(value)
        table += struct.pack(">HHII", code, dtype, count, beyond + len(values))
        values += value
    pointer = data.index(struct.pack(">HHI", 34665, 4, 1)) + 8
    data[pointer : pointer + 4] = struct.pack(">I", start)
    source.write_bytes(bytes(data) + table + bytes(4) + values)
    write_dng(tmp_path / "a.dng", a_frame(np.full((32, 32), 500, np.uint16), CFA.RGGB, (64,) * 4, 1023), source)
    exposure = read_raw(tmp_path / "a.dng").exposure
    assert exposure.seconds == pytest.approx(1 / 125) and exposure.date == "2020:02:29 12:00:00"
    with tifffile.TiffFile(tmp_path / "a.dng") as tiff:
        assert tiff.byteorder == ">" and "MakerNote" not in tiff.pages.first.tags["ExifTag"].value


def test_any_camera_name_and_exposure_can_be_written(tmp_path: Path) -> None:
    numbers = np.full((32, 32), 900, np.uint16)
    shot = Exposure(5000.0, 2.8, 35.0, "2020:02:29 12:00:00")
    frame = a_frame(numbers, CFA.RGGB, (0, 0, 0, 0), 1023, camera="Möller Kamera", exposure=shot)
    write_dng(tmp_path / "a.dng", dataclasses.replace(frame, iso=102400.0))
    read = read_raw(tmp_path / "a.dng")
    assert read.exposure.seconds == pytest.approx(5000.0) and read.camera == frame.camera and read.iso == 65535
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        exif = file.pages.first.tags["ExifTag"].value
    assert exif["RecommendedExposureIndex"] == 102400 and exif["SensitivityType"] == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"orientation": 9}, "orientation"),
        ({"white_balance": (0.0, 1.0, 1.5)}, "positive"),
        ({"white_balance": (1e-12, 1.0, 1.0)}, "DNG"),
        ({"color_matrix": torch.zeros(3, 3)}, "singular"),
        ({"white": 65536.0}, "black < white"),
        ({"mosaic": torch.full((1, 4, 4), -0.6)}, r"-614 .*black"),
        ({"mosaic": torch.zeros(1, 5, 4)}, "even sides"),
    ],
)
def test_what_no_dng_can_store_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    frame = a_frame(np.full((32, 32), 500, np.uint16), CFA.RGGB, (0,) * 4, 1023)
    with pytest.raises(ValueError, match=message):
        write_dng(tmp_path / "a.dng", dataclasses.replace(frame, **change))
    assert not list(tmp_path.iterdir())


def test_a_damaged_tag_is_one_line(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.full((32, 32), 900, np.uint16)
    path = bayer_dng(tmp_path / "a.dng", numbers, black=None, extra=[(50714, 5, 1, (0, 0), True)])
    with pytest.raises(OSError, match=r"a\.dng: .*BlackLevel"):
        read_raw(path)


def test_a_real_dng_written_again_is_the_same(tmp_path: Path, camera_files: Path) -> None:
    for name in ("raw/gopro/hero6_0024.dng", "raw/canon/g2_0304.crw"):
        source = camera_files / name
        frame = read_raw(source)
        write_dng(tmp_path / "a.dng", frame, source)
        back = read_raw(tmp_path / "a.dng")
        assert np.array_equal(numbers_in(tmp_path / "a.dng"), numbers_in(source))
        assert (back.camera, back.iso, back.orientation) == (frame.camera, frame.iso, frame.orientation)
        assert back.noise_profile == frame.noise_profile and len(back.gain_maps) == len(frame.gain_maps)
        assert torch.allclose(back.color_matrix, frame.color_matrix, atol=2e-4)


@pytest.mark.parametrize("name", ["XTRANS", "XTRANS+1+2", "QUAD-RGGB", "QUAD-RGGB+1+3"])
@pytest.mark.parametrize("black", [(64.0,) * 4, (64.0, 70.25, 70.25, 80.0)])
def test_other_patterns_go_there_and_back(tmp_path: Path, name: str, black: tuple[float, ...]) -> None:
    cell = plane_indices(name)
    levels = torch.tensor(black)[cell].repeat(12, 12)[:36, :46].double()
    numbers = torch.randint(0, 1024, (36, 46), generator=torch.Generator().manual_seed(0)).double()
    raw = ((numbers - levels) / (1023 - levels)).float()[None]
    frame = RawFrame(raw, name, black, 1023.0, camera="Maker X", color_matrix=MATRIX)  # type: ignore[arg-type]
    write_dng(tmp_path / "a.dng", frame)
    assert np.array_equal(numbers_in(tmp_path / "a.dng"), numbers.numpy())
    back = read_raw(tmp_path / "a.dng")
    assert (back.cfa, back.black, back.white) == (name, black, 1023.0)
    torch.testing.assert_close(back.mosaic, raw, rtol=0, atol=1e-7)
    with rawpy.imread(str(tmp_path / "a.dng")) as file:
        if len(cell) == 6:  # LibRaw knows no cells of 4 x 4
            assert np.array_equal(file.raw_colors_visible[:6, :6], (cell - (cell == 3).long()).numpy())


def test_libraw_demosaics_xtrans_in_its_colours(tmp_path: Path) -> None:
    scene = torch.tensor([0.5, 0.3, 0.2])[:, None, None].expand(3, 516, 520)  # LibRaw's least for X-Trans is 512
    frame = RawFrame(pattern("XTRANS+2+1").mosaic(scene), "XTRANS+2+1", (64.0,) * 4, 16383.0, color_matrix=MATRIX)
    write_dng(tmp_path / "a.dng", frame)
    settings = {"output_color": rawpy.ColorSpace.raw, "gamma": (1, 1), "no_auto_bright": True, "output_bps": 16}
    with rawpy.imread(str(tmp_path / "a.dng")) as file:
        rgb = file.postprocess(user_wb=[1, 1, 1, 1], adjust_maximum_thr=0, **settings) / 65535
    assert np.abs(rgb[6:-6, 6:-6] - [0.5, 0.3, 0.2]).max() < 2e-3


def thumbnail(shade: int) -> np.ndarray:
    return np.full((12, 16, 3), shade, np.uint8)


def with_previews(path: Path, numbers: np.ndarray, bayer_dng: Callable[..., Path]) -> Path:
    """A DNG as Adobe's converter writes it: a thumbnail first, then the mosaic, then a JPEG."""
    whole = bayer_dng(path.with_name("mosaic.dng"), numbers)
    with tifffile.TiffFile(whole) as file:
        kept = {tag.code: (tag.code, int(tag.dtype), tag.count, tag.value, True) for tag in file.pages.first.tags}
    of_camera = [kept[code] for code in (271, 272, 50706, 50708, 50721, 50728, 50778)]
    of_mosaic = [kept[code] for code in (33421, 33422, 50714, 50717)]
    jpeg = imagecodecs.jpeg8_encode(thumbnail(200).repeat(2, 0).repeat(2, 1), level=90)
    with tifffile.TiffWriter(path) as file:
        file.write(thumbnail(100), photometric="rgb", subifds=2, extratags=of_camera, metadata=None, subfiletype=1)
        file.write(numbers, photometric=32803, extratags=of_mosaic, metadata=None)
        shape = {"shape": (24, 32, 3), "dtype": np.uint8, "photometric": "ycbcr", "compression": "jpeg"}
        file.write(iter([jpeg]), **shape, metadata=None, subfiletype=1, rowsperstrip=24)
    return path


@pytest.mark.parametrize("full_colour", [False, True])
def test_the_previews_of_a_dng_are_kept(full_colour: bool, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.random.default_rng(0).integers(0, 4096, (64, 96)).astype(np.uint16)
    source = with_previews(tmp_path / "source.dng", numbers, bayer_dng)
    frame = read_raw(source)
    rgb = torch.full((3, 64, 96), 0.5) if full_colour else None
    write_dng(tmp_path / "a.dng", frame, source, rgb=rgb)
    with tifffile.TiffFile(tmp_path / "a.dng") as file, tifffile.TiffFile(source) as before:
        main, (small, large) = file.pages.first, file.pages.first.pages
        assert main.shape[:2] == (64, 96) and main.tags[254].value == 0
        assert (small.asarray() == thumbnail(100)).all() and small.tags[254].value == 1
        jpegs = [tuple(page.dataoffsets + page.databytecounts) for page in (large, before.pages.first.pages[1])]
    contents = [path.read_bytes() for path in (tmp_path / "a.dng", source)]
    first, second = (content[at : at + size] for content, (at, size) in zip(contents, jpegs, strict=True))
    assert first == second, "byte for byte"
    with rawpy.imread(str(tmp_path / "a.dng")) as raw:
        assert raw.extract_thumb().data[:2] == b"\xff\xd8"
    if not full_colour:
        assert torch.equal(read_raw(tmp_path / "a.dng").mosaic, frame.mosaic)


def test_previews_that_are_not_in_the_file_are_left_out(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.random.default_rng(0).integers(0, 4096, (64, 96)).astype(np.uint16)
    source = with_previews(tmp_path / "source.dng", numbers, bayer_dng)
    with tifffile.TiffFile(source, mode="r+") as file:
        file.pages.first.pages[1].tags["StripByteCounts"].overwrite(10**8)
    write_dng(tmp_path / "a.dng", read_raw(source), source)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        assert len(file.pages.first.pages) == 1


def test_the_preview_of_a_crw_is_kept_with_what_the_camera_did(tmp_path: Path, camera_files: Path) -> None:
    source = camera_files / "raw/canon/s40_0101.crw"
    write_dng(tmp_path / "a.dng", read_raw(source), source)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        (preview,) = file.pages.first.pages
        exif = file.pages.first.tags["ExifTag"].value
        assert preview.shape == (480, 640, 3) and preview.asarray().std() > 20
        assert exif["ExposureTime"] == (9702, 10**6) and exif["FNumber"][0] == pytest.approx(2.92e6, rel=1e-2)


@pytest.mark.parametrize("safe", [False, True])
def test_makers_notes_and_interoperability(safe: bool, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.full((32, 48), 700, np.uint16)
    extra = [(50741, 3, 1, int(safe), True), ("ExifTag", 4, 1, 0, True)]
    plain = bayer_dng(tmp_path / "plain.dng", numbers)
    source = tmp_path / "source.dng"
    with tifffile.TiffFile(plain) as file:
        kept = [(tag.code, int(tag.dtype), tag.count, tag.value, True) for tag in file.pages.first.tags
                if tag.code in (33421, 33422) or tag.code > 50000]  # fmt: skip
    tifffile.imwrite(source, numbers, photometric=32803, metadata=None, extratags=[*kept, *extra])
    with source.open("r+b") as file:
        inner = dng._append_directory(file, "<", [Tag(1, 2, 4, b"R98\0"), Tag(2, 7, 4, b"0100")])
        entries = [
            Tag(37500, 7, 12, b"maker's note"),
            Tag(40965, 4, 1, struct.pack("<I", inner)),
            Tag(42036, 2, 8, b"EF 50mm\0"),
        ]
        place = dng._append_directory(file, "<", entries)
        tiff = TiffFile(file)
        file.seek(tiff.directory(tiff.first).entries[34665].offset)
        file.write(struct.pack("<I", place))
    write_dng(tmp_path / "a.dng", read_raw(source), source)
    with tifffile.TiffFile(tmp_path / "a.dng") as written:
        exif = written.pages.first.tags["ExifTag"].value
    assert exif["LensModel"] == "EF 50mm"
    interoperability = read_carried(tmp_path / "a.dng", (32, 48)).interoperability
    assert [entry.data for entry in interoperability] == [b"R98\0", b"0100"]
    assert ("MakerNote" in exif) == safe


def test_a_default_crop_leaves_room_for_demosaicing(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.full((32, 48), 700, np.uint16)
    write_dng(tmp_path / "a.dng", read_raw(bayer_dng(tmp_path / "plain.dng", numbers)))
    cropped = bayer_dng(
        tmp_path / "cropped.dng", numbers, extra=[(50719, 3, 2, (4, 6), True), (50720, 3, 2, (40, 20), True)]
    )
    write_dng(tmp_path / "b.dng", read_raw(cropped), cropped)
    for name, crop in (("a", ((2, 2), (44, 28))), ("b", ((4, 6), (40, 20)))):
        with tifffile.TiffFile(tmp_path / f"{name}.dng") as file:
            tags = file.pages.first.tags
            assert (tags["DefaultCropOrigin"].value, tags["DefaultCropSize"].value) == crop


def monochrome(path: Path, numbers: np.ndarray, filters: bool, bayer_dng: Callable[..., Path]) -> Path:
    """A DNG of a sensor without colours: linear RAW of one plane, or a mosaic all of whose filters are alike."""
    if filters:
        return bayer_dng(path, numbers, "GGGG", black=(500,), white=16383)
    bayer_dng(path, numbers, None, black=(500,), white=16383)
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags["PhotometricInterpretation"].overwrite(34892)
    return path


@pytest.mark.parametrize("filters", [False, True])
def test_monochrome_frames_go_there_and_back(filters: bool, tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.random.default_rng(0).integers(0, 16384, (36, 46)).astype(np.uint16)
    source = monochrome(tmp_path / "source.dng", numbers, filters, bayer_dng)
    with pytest.raises(ValueError, match="monochrome"):
        read_raw(source)
    frame = read_raw(source, monochrome=True)
    assert frame.cfa == MONOCHROME and frame.black == (500.0,) * 4
    assert np.abs(frame.mosaic[0].numpy() - (numbers - 500.0) / (16383 - 500)).max() < 1e-6
    write_dng(tmp_path / "a.dng", frame, source)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        assert file.pages.first.photometric == 34892 and 33421 not in file.pages.first.tags
    assert np.array_equal(numbers_in(tmp_path / "a.dng"), numbers)
    assert torch.equal(read_raw(tmp_path / "a.dng", monochrome=True).mosaic, frame.mosaic)
    assert develop(tmp_path / "a.dng").shape == (3, 36, 46)


@pytest.mark.parametrize("layout", [{}, {"tile": (16, 16)}, {"byteorder": ">"}])
@pytest.mark.parametrize("kind", [np.float32, np.float16])
def test_floating_point_keeps_its_values(
    kind: type[np.floating], layout: dict[str, Any], tmp_path: Path, bayer_dng: Callable[..., Path]
) -> None:
    """LibRaw makes integers of 14 bits of it."""
    numbers = np.geomspace(1e-5, 1, 33 * 50).reshape(33, 50).astype(kind)
    area = (50829, 4, 4, (1, 2, 33, 50), True)
    source = bayer_dng(tmp_path / "a.dng", numbers, black=(0,), white=1, extra=[area], **layout)
    frame = read_raw(source)
    assert frame.floating and frame.cfa == CFA.GBRG and frame.offset == (2, 2) and frame.mosaic.shape == (1, 30, 48)
    seen = numbers[frame.offset[0] :, frame.offset[1] :][: frame.mosaic.shape[1], : frame.mosaic.shape[2]]
    assert np.array_equal(frame.mosaic[0].numpy(), seen.astype(np.float32))
    below = dataclasses.replace(frame, mosaic=frame.mosaic - 1e-3)  # noise that was removed leaves values below black
    write_dng(tmp_path / "b.dng", below, source)
    assert torch.equal(read_raw(tmp_path / "b.dng").mosaic, below.mosaic)
    rgb = torch.rand(3, *frame.mosaic.shape[1:], generator=torch.Generator().manual_seed(0)) * 1e-3
    write_dng(tmp_path / "c.dng", frame, source, rgb=rgb)
    with tifffile.TiffFile(tmp_path / "c.dng") as file:
        assert np.array_equal(file.pages.first.asarray(), rgb.permute(1, 2, 0).numpy())
        assert file.pages.first.tags["WhiteLevel"].value == (1, 1, 1)


def test_levels_of_floating_point_are_the_file_s(tmp_path: Path, bayer_dng: Callable[..., Path]) -> None:
    numbers = np.random.default_rng(0).uniform(0, 1000, (32, 48)).astype(np.float32)
    frame = read_raw(bayer_dng(tmp_path / "a.dng", numbers, black=(10, 20, 30, 40), white=900))
    levels = np.tile(np.array([[10, 20], [30, 40]]), (16, 24))
    assert (frame.black, frame.white) == ((10, 20, 30, 40), 900)
    assert np.abs(frame.mosaic[0].numpy() - np.minimum((numbers - levels) / (900 - levels), 1)).max() < 1e-6
