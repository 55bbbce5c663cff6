"""DNGs that are damaged inside, whose decoder notices nothing, and gaps that hold another file's pixels."""

from __future__ import annotations

import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch

from rawaug.io import RawFrame, libraw, read_raw, write_dng
from rawaug.io.damage import find_fault, is_cut_short, tiled_digest
from rawaug.io.directories import Tag, pack_directory
from rawaug.io.libraw import FILL, SMALLEST_GAP
from rawaug.io.tiff import StoredMosaic

Dng = Callable[..., Path]
STRIP_BYTES, DIGESTS = 279, (50972, 51111)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "whole.dng"
    picture = torch.rand(1, 1, 12, 16, generator=torch.Generator().manual_seed(0))
    mosaic = 0.1 + 0.6 * torch.nn.functional.interpolate(picture, (192, 256), mode="bilinear")[0]
    mosaic += 0.02 * torch.randn(mosaic.shape, generator=torch.Generator().manual_seed(1))
    write_dng(path, RawFrame(mosaic.clamp(0, 1), "RGGB", (512.0,) * 4, 16383.0))
    return path


def without_digests(path: Path, out: Path) -> Path:
    """Another copy, so that only the stream tells."""
    shutil.copy(path, out)
    with tifffile.TiffFile(out, mode="r+") as tiff:
        for code in DIGESTS:
            if code in tiff.pages.first.tags:
                tiff.pages.first.tags[code].overwrite(bytes(16))
    return out


def strip_of(path: Path) -> tuple[int, int]:
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        return page.dataoffsets[0], page.databytecounts[0]


def overwrite(path: Path, part: float, data: bytes) -> Path:
    """Put other data into the mosaic, from a part of its strip on."""
    offset, length = strip_of(path)
    content = bytearray(path.read_bytes())
    start = offset + int(part * length)
    content[start : start + len(data)] = data
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("hole", [512, 4096])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("filler", [0, 0x5A])
def test_a_hole_in_the_stream_is_told(hole: int, part: float, filler: int, whole: Path, tmp_path: Path) -> None:
    damaged = overwrite(without_digests(whole, tmp_path / "a.dng"), part, bytes([filler]) * hole)
    with pytest.raises(OSError, match=r"a\.dng.*damaged"):
        read_raw(damaged)


def test_a_strip_of_a_few_bytes_is_told(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    damaged = without_digests(whole, tmp_path / "a.dng")
    _, length = strip_of(damaged)
    overwrite(damaged, 22 / length, b"\xff\xd9" + bytes(length - 24))
    with tifffile.TiffFile(damaged, mode="r+") as tiff:
        tiff.pages.first.tags[STRIP_BYTES].overwrite(22)
    with pytest.raises(OSError, match="damaged inside"):
        read_raw(damaged)

    # without this check, no pixel of the file before stands in the gap
    monkeypatch.setattr(libraw, "find_fault", lambda *_: "")
    read_raw(whole)
    with pytest.raises(OSError, match="sites are missing"):
        read_raw(damaged)
    monkeypatch.setattr(libraw, "SMALLEST_GAP", 2**31)
    numbers = read_raw(damaged).mosaic * (16383 - 512) + 512
    assert not torch.isclose(numbers, read_raw(whole).mosaic * (16383 - 512) + 512).any()


def test_a_changed_bit_is_told_by_the_digest(whole: Path, bayer_dng: Dng, tmp_path: Path) -> None:
    numbers = np.random.default_rng(0).integers(0, 4096, (300, 520)).astype(np.uint16)
    digest = tiled_digest(numbers)
    good = bayer_dng(tmp_path / "good.dng", numbers, extra=[(51111, 1, 16, digest, True)])
    read_raw(good)
    overwrite(good, 0.5, struct.pack("<H", int(numbers[150, 0]) ^ 1))
    with pytest.raises(OSError, match="NewRawImageDigest"):
        read_raw(good)
    zeros = bayer_dng(tmp_path / "zeros.dng", numbers, extra=[(51111, 1, 16, bytes(16), True)])
    read_raw(zeros)  # as GoPros write it


def test_the_digest_is_that_of_adobes_programs() -> None:
    numbers = (np.arange(300)[:, None] * 7 + np.arange(520) * 13).astype(np.uint16)
    assert tiled_digest(numbers).hex() == "926eddda169b800e62fdc19114ea1d56"


@pytest.mark.parametrize("kind", ["flat", "noise", "ramp", "16 bits"])
@pytest.mark.parametrize("predictor", range(1, 8))
@pytest.mark.parametrize("padding", [b"", b"\0" * 512])
def test_sound_streams_of_any_kind_pass(kind: str, predictor: int, padding: bytes, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    numbers = {
        "flat": np.full((64, 48, 2), 700, np.uint16),
        "noise": rng.integers(0, 16384, (64, 48, 2)).astype(np.uint16),
        "ramp": np.arange(64 * 96).reshape(64, 48, 2).astype(np.uint16),
        "16 bits": rng.integers(0, 65536, (64, 48, 2)).astype(np.uint16),
    }[kind]
    stream = imagecodecs.jpeg8_encode(numbers, lossless=True, predictor=predictor, bitspersample=16)
    (tmp_path / "a").write_bytes(b"12345678" + stream + padding)
    stored = StoredMosaic((64, 96), 7, ((8, len(stream) + len(padding)),))
    assert find_fault(tmp_path / "a", stored, None) == ""


def test_a_gap_needs_more_than_defects_of_the_sensor(bayer_dng: Dng, tmp_path: Path) -> None:
    numbers = np.full((32, 48), 1000, np.uint16)
    numbers.ravel()[: SMALLEST_GAP - 1] = FILL
    read_raw(bayer_dng(tmp_path / "a.dng", numbers))


def test_libraws_complaints_are_errors_of_ours(whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = overwrite(without_digests(whole, tmp_path / "a.dng"), 0.5, b"\xff\xd0")  # a marker in the middle
    with pytest.raises(OSError, match=r"a\.dng: .*LibRaw"):
        read_raw(path)
    assert capfd.readouterr() == ("", "")


def test_lines_of_others_reach_the_standard_error_stream(capfd: pytest.CaptureFixture[str]) -> None:
    with libraw.caught_stderr() as complaints:
        os.write(2, b"a.dng: data corrupted at 12\nof others\n")
    assert complaints == ["data corrupted at 12"] and capfd.readouterr().err == "of others\n"


# -- files that are whole but rare, and files of which only the header is there ----------------------------------------


def in_streams(path: Path, numbers: np.ndarray, streams: list[bytes], bayer_dng: Dng, **layout: object) -> Path:
    """A DNG whose strips or tiles are JPEG streams."""
    with tifffile.TiffFile(bayer_dng(path.with_name("plain.dng"), numbers)) as file:
        tags = []
        for tag in file.pages.first.tags:
            if tag.code in (271, 272, 274, 33421, 33422) or tag.code > 50000:
                tags.append((tag.code, int(tag.dtype), tag.count, tag.value, True))
    with tifffile.TiffWriter(path) as file:
        kind = {"photometric": 32803, "compression": "jpeg", "metadata": None, "extratags": tags}
        file.write(iter(streams), shape=numbers.shape, dtype=np.uint16, **kind, **layout)
    return path


def smooth(height: int = 64, width: int = 96) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return (600 + 20 * x + 5 * y).astype(np.uint16)


def lossy_of_12_bits(part: np.ndarray) -> bytes:
    """A tile as cinema cameras write it: even and odd rows side by side, quantisation of 16 bits."""
    stream = imagecodecs.jpeg8_encode(np.hstack([part[0::2], part[1::2]]), level=98, bitspersample=12)
    at = stream.index(b"\xff\xdb\x00\x43\x00")
    table = b"".join(bytes((0, step)) for step in stream[at + 5 : at + 69])
    return bytes(stream[:at] + b"\xff\xdb\x00\x83\x10" + table + stream[at + 69 :])


def test_lossy_jpeg_of_cinema_cameras_is_whole_and_without_its_end_is_not(bayer_dng: Dng, tmp_path: Path) -> None:
    numbers = smooth(64, 96)
    streams = [lossy_of_12_bits(numbers[:, k : k + 48]) for k in (0, 48)]
    frame = read_raw(in_streams(tmp_path / "a.dng", numbers, streams, bayer_dng, tile=(64, 48), bitspersample=12))
    assert np.abs(frame.mosaic[0].numpy() * 4095 - numbers).mean() < 8
    cut = [streams[0], streams[1][:-2] + b"\0\0"]
    path = in_streams(tmp_path / "b.dng", numbers, cut, bayer_dng, tile=(64, 48), bitspersample=12)
    with pytest.raises(OSError, match=r"b\.dng: .*damaged"):
        read_raw(path)


def test_strips_of_which_libraw_reads_one_are_not_called_damage(bayer_dng: Dng, tmp_path: Path) -> None:
    numbers = smooth()
    streams = []
    for k in range(0, 64, 16):
        part = np.ascontiguousarray(numbers[k : k + 16].reshape(16, 48, 2))
        streams.append(bytes(imagecodecs.jpeg8_encode(part, lossless=True, predictor=1, bitspersample=16)))
    path = in_streams(tmp_path / "a.dng", numbers, streams, bayer_dng, rowsperstrip=16, bitspersample=16)
    with pytest.raises(ValueError, match=r"a\.dng: .*4 strips"):
        read_raw(path)


def header_of_rw2(width: int = 664, height: int = 490) -> bytes:
    """The header of a Panasonic, whose table of strips states two bytes a site."""
    text = {0x10F: b"Panasonic\0", 0x110: b"DMC-LX3\0"}
    shorts = {2: width, 3: height, 4: 6, 5: 8, 6: height - 4, 7: width - 16, 8: 1, 9: 4, 10: 12, 14: 4095, 15: 4095}
    shorts |= {16: 4095, 23: 80, 28: 0, 29: 0, 30: 0, 36: 570, 37: 263, 38: 438, 45: 4, 0x112: 1, 0x116: height}
    longs = {0x111: 0xFFFFFFFF, 0x117: 2 * width * height, 0x118: 1024}
    tags = [Tag(1, 7, 4, b"0300"), *(Tag(code, 2, len(value), value) for code, value in text.items())]
    tags += [Tag(code, 3, 1, struct.pack("<H", value)) for code, value in shorts.items()]
    tags += [Tag(code, 4, 1, struct.pack("<I", value)) for code, value in longs.items()]
    return (b"IIU\0" + struct.pack("<I", 24) + bytes(16) + pack_directory("<", tags, 24)).ljust(1024, b"\0")


def test_a_raw_file_without_its_pixels_is_truncated_and_panasonic_s_table_counts_too_much(tmp_path: Path) -> None:
    (tmp_path / "stopped.rw2").write_bytes(header_of_rw2() + bytes(range(1, 23)))
    with pytest.raises(OSError, match=r"stopped\.rw2: .*1046 of 650720 bytes"):
        read_raw(tmp_path / "stopped.rw2")
    (tmp_path / "whole.rw2").write_bytes(header_of_rw2() + bytes(490 * 664 * 8 // 7))
    assert not is_cut_short(tmp_path / "whole.rw2"), "57 % of the bytes that are stated"


def test_rows_that_were_never_decoded_are_told(bayer_dng: Dng, tmp_path: Path) -> None:
    numbers = smooth()
    numbers[40:] = 0
    with pytest.raises(OSError, match=r"a\.dng: .*last 24 of 64 rows"):
        read_raw(bayer_dng(tmp_path / "a.dng", numbers, black=(64,)))
    read_raw(bayer_dng(tmp_path / "b.dng", numbers, black=(0,)))  # a camera that clips at black, in the dark
    numbers[40:] = 4095
    read_raw(bayer_dng(tmp_path / "c.dng", numbers, black=(64,)))  # clipped lights


@pytest.mark.parametrize(
    ("layout", "said"), [({"compression": "lzw"}, "LZW"), ({"bigtiff": True}, "BigTIFF"), ({"compression": 9}, "VC-5")]
)
def test_what_libraw_does_not_read_is_named(
    layout: dict[str, object], said: str, bayer_dng: Dng, tmp_path: Path
) -> None:
    number = layout.pop("compression") if layout.get("compression") == 9 else None
    path = bayer_dng(tmp_path / "a.dng", smooth(), **layout)
    if number is not None:
        with tifffile.TiffFile(path, mode="r+") as tiff:
            tiff.pages.first.tags["Compression"].overwrite(number)
    with pytest.raises(ValueError, match=rf"a\.dng: .*{said}.*convert"):
        read_raw(path)
