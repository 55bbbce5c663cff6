"""DNGs as cameras write them, where other programs shifted, tinted or darkened the picture."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import torch

from rawaug.bayer import CFA, mosaic, pack
from rawaug.io import develop, read_raw, write_dng

Dng = Callable[..., Path]
BLACK, WHITE = 256, 4095
COLOUR = torch.tensor([0.15, 0.4, 0.2])
SHORT, LONG, UNDEFINED, SRATIONAL = 3, 4, 7, 10


def numbers_of(cfa: CFA, height: int, width: int) -> np.ndarray:
    """One colour with a brighter square at (16, 24), as the sensor of this pattern counts it."""
    rgb = COLOUR[:, None, None].expand(3, height, width).clone()
    rgb[:, 16:24, 24:36] *= 2
    return (mosaic(rgb, cfa)[0] * (WHITE - BLACK) + BLACK).round().numpy().astype(np.uint16)


@pytest.mark.parametrize("cfa", list(CFA))
@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (1, 0), (1, 1), (3, 6)])
def test_an_odd_active_area_and_crop_neither_tint_nor_shift(
    tmp_path: Path, bayer_dng: Dng, cfa: CFA, origin: tuple[int, int]
) -> None:
    """LibRaw leaves out a first odd line: pattern, levels and crop must follow."""
    top, left = origin
    levels = np.array([[200, 240], [280, 320]])
    signal = (numbers_of(cfa, 48, 64) - BLACK) / (WHITE - BLACK)
    black = np.tile(levels, (24, 32))
    whole = np.full((48 + top, 64 + left), 7, np.uint16)
    whole[top:, left:] = (signal * (WHITE - black) + black).round()  # DNG: pattern and levels begin at the active area
    area = (50829, LONG, 4, (top, left, 48 + top, 64 + left), True)
    crop = [(50719, SHORT, 2, (3, 5), True), (50720, SHORT, 2, (57, 41), True)]
    path = bayer_dng(
        tmp_path / "a.dng", whole, cfa.value, black=levels.ravel().tolist(), white=WHITE, extra=[area, *crop]
    )
    frame = read_raw(path)
    rows, columns = top % 2, left % 2
    assert frame.cfa == cfa.shift(rows, columns)
    seen = signal[rows:, columns:][: frame.mosaic.shape[1], : frame.mosaic.shape[2]]
    assert seen.shape == (48 - 2 * rows, 64 - 2 * columns)
    assert np.abs(frame.mosaic[0].numpy() - seen).max() < 0.6 / (WHITE - BLACK), "shifted, or another black level"
    planes = pack(frame.mosaic, frame.cfa)[:, 0, 0]
    assert planes.tolist() == pytest.approx(COLOUR[[0, 1, 1, 2]].tolist(), abs=1e-3), "magenta or green"
    write_dng(tmp_path / "b.dng", frame, source=path)
    back = read_raw(tmp_path / "b.dng")
    assert back.cfa == frame.cfa and torch.allclose(back.mosaic, frame.mosaic, atol=1e-6)
    with tifffile.TiffFile(tmp_path / "b.dng") as file:
        tags = file.pages.first.tags
        assert 50829 not in tags
        assert tags["DefaultCropOrigin"].value == (3 - columns, 5 - rows) and tags["DefaultCropSize"].value == (57, 41)


def test_the_crop_of_a_crw_is_the_camera_s(tmp_path: Path, camera_files: Path) -> None:
    source = camera_files / "raw/canon/s40_0101.crw"
    write_dng(tmp_path / "a.dng", read_raw(source), source)
    with tifffile.TiffFile(tmp_path / "a.dng") as file:
        tags = file.pages.first.tags
        assert tags["DefaultCropOrigin"].value == (20, 8) and tags["DefaultCropSize"].value == (2272, 1704)


def test_lens_corrections_are_kept(tmp_path: Path, bayer_dng: Dng) -> None:
    warp = struct.pack(">6d", 1.0, 0.01, -0.002, 0.0, 0.0, 0.0) * 3 + struct.pack(">2d", 0.5, 0.5)
    opcode = struct.pack(">IIIII", 1, 1, 0x01030000, 0, 4 + len(warp)) + struct.pack(">I", 3) + warp
    path = bayer_dng(tmp_path / "a.dng", numbers_of(CFA.RGGB, 32, 48), black=(BLACK,), white=WHITE,
                     extra=[(51022, UNDEFINED, len(opcode), opcode, True)])  # fmt: skip
    frame = read_raw(path)
    assert frame.gain_maps == ()
    write_dng(tmp_path / "b.dng", frame, source=path)
    with tifffile.TiffFile(tmp_path / "b.dng") as file:
        assert file.pages.first.tags["OpcodeList3"].value == opcode


def test_of_several_mosaics_the_largest_is_read_with_its_own_levels(tmp_path: Path, bayer_dng: Dng) -> None:
    """A phone's file: a preview first, a small mosaic, then the picture itself."""
    numbers = numbers_of(CFA.RGGB, 48, 64)
    path = bayer_dng(tmp_path / "main.dng", numbers, black=(BLACK,), white=WHITE)
    with tifffile.TiffFile(path) as file:
        kept = {tag.code: (tag.code, int(tag.dtype), tag.count, tag.value, True) for tag in file.pages.first.tags}
    of_camera = [kept[code] for code in (271, 272, 50706, 50708, 50721, 50728, 50778)]
    of_mosaic = [kept[code] for code in (33421, 33422, 50717)]

    def level(black: float) -> tuple[Any, ...]:
        return (50714, 5, 1, (round(black * 4), 4), True)

    with tifffile.TiffWriter(tmp_path / "phone.dng") as file:
        preview = np.zeros((12, 16, 3), np.uint8)
        file.write(preview, photometric="rgb", subifds=2, extratags=of_camera, metadata=None, subfiletype=1)
        small = [*of_mosaic, level(16.75)]
        file.write(numbers[:16, :16], photometric=32803, extratags=small, metadata=None, subfiletype=1)
        file.write(numbers, photometric=32803, extratags=[*of_mosaic, level(BLACK + 0.25)], metadata=None)
    frame = read_raw(tmp_path / "phone.dng")
    assert frame.mosaic.shape == (1, 48, 64) and frame.black == (BLACK + 0.25,) * 4
    assert np.allclose(frame.mosaic[0].numpy(), (numbers - BLACK - 0.25) / (WHITE - BLACK - 0.25), atol=1e-6)
    write_dng(tmp_path / "out.dng", frame, source=tmp_path / "phone.dng")
    assert torch.allclose(read_raw(tmp_path / "out.dng").mosaic, frame.mosaic, atol=0.5 / WHITE)


def test_exposure_bias_brightens_nothing_and_is_kept(tmp_path: Path, bayer_dng: Dng) -> None:
    numbers, tags = numbers_of(CFA.RGGB, 32, 48), {"black": (BLACK,), "white": WHITE}
    plain = bayer_dng(tmp_path / "a.dng", numbers, **tags)
    bias = [(50730, SRATIONAL, 1, (-3, 2), True)]
    biased = bayer_dng(tmp_path / "b.dng", numbers, **tags, extra=bias)
    assert torch.equal(read_raw(plain).mosaic, read_raw(biased).mosaic) and torch.equal(develop(plain), develop(biased))
    write_dng(tmp_path / "c.dng", read_raw(biased), source=biased, baseline_exposure=1.0)
    with tifffile.TiffFile(tmp_path / "c.dng") as file:
        assert tuple(file.pages.first.tags["BaselineExposure"].value) == (-3, 2)


@pytest.mark.parametrize("along", ["rows", "columns", "both"])
def test_black_levels_of_rows_and_columns_are_taken_off(tmp_path: Path, bayer_dng: Dng, along: str) -> None:
    rng, (height, width) = np.random.default_rng(0), (48, 64)
    rows = rng.integers(-24, 40, height) if along != "columns" else np.zeros(height, int)
    columns = rng.integers(-24, 40, width) if along != "rows" else np.zeros(width, int)
    per_site = BLACK + rows[:, None] + columns
    signal = (numbers_of(CFA.GRBG, height, width).astype(int) - BLACK) / (WHITE - BLACK)
    numbers = (signal * (WHITE - per_site) + per_site).round().astype(np.uint16)
    deltas = [(50716, rows, "rows"), (50715, columns, "columns")]
    extra = [(code, SRATIONAL, len(values), tuple(n for v in values for n in (int(v), 1)), True)
             for code, values, name in deltas if along in (name, "both")]  # fmt: skip
    path = bayer_dng(tmp_path / "a.dng", numbers, "GRBG", black=(BLACK,), white=WHITE, extra=extra)
    frame = read_raw(path)
    assert np.abs(frame.mosaic[0].numpy() - signal).max() < 0.6 / (WHITE - BLACK), "bands are left"
    mean = BLACK + rows.mean() + columns.mean()
    assert frame.black == pytest.approx((mean,) * 4, abs=1e-3)
    write_dng(tmp_path / "b.dng", frame, source=path)
    assert (read_raw(tmp_path / "b.dng").mosaic - frame.mosaic).abs().max() < 0.6 / (WHITE - BLACK)


def test_black_levels_of_another_number_of_rows_are_refused(tmp_path: Path, bayer_dng: Dng) -> None:
    extra = [(50716, SRATIONAL, 5, (1, 1) * 5, True)]
    path = bayer_dng(tmp_path / "a.dng", numbers_of(CFA.RGGB, 32, 48), black=(BLACK,), white=WHITE, extra=extra)
    assert read_raw(path).black == (BLACK + 1,) * 4, "equal for all rows: one level"
    extra = [(50716, SRATIONAL, 5, (1, 1, 2, 1) + (1, 1) * 3, True)]
    path = bayer_dng(tmp_path / "b.dng", numbers_of(CFA.RGGB, 32, 48), black=(BLACK,), white=WHITE, extra=extra)
    with pytest.raises(OSError, match=r"b\.dng: .*TIFF"):
        read_raw(path)
