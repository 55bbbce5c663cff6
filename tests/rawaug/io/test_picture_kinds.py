"""TIFF, BMP, PSD and JPEG 2000 of rare kinds are read as they are meant, or refused; none is read as something else."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from benchmarks.matrices import HEIGHT, RAMPS, WIDTH, TiffKind, outcome, read_here, tiff_kinds, write_tiff
from rawaug.io import read_picture
from rawaug.io.headers import headers_of_opened
from rawaug.io.stored import read_stored, write_stored

KINDS = [kind for kind in tiff_kinds() if kind.compression != 5 and (kind.order == "<" or kind.predictor > 1)]


@pytest.mark.parametrize("photometric", [0, 1, 2, 3])
def test_tiff_of_any_kind_shows_its_picture_or_is_refused(photometric: int, tmp_path: Path) -> None:
    right = 0
    for kind in KINDS:
        if kind.photometric != photometric:
            continue
        shown = write_tiff(tmp_path / "a.tif", kind)
        result, reason = outcome(read_here, tmp_path / "a.tif", shown, 1.5)
        assert result != "wrong", f"{kind}: {reason}"
        right += result == "right"
        is_usual = kind.bits <= 16 and photometric in (1, 2) and kind.numbers == 1
        assert result == "right" or not is_usual, f"{kind}: {reason}"
    assert right >= 15


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_white_is_zero_is_no_negative_when_it_is_denoised(bits: int, tmp_path: Path) -> None:
    shown = write_tiff(tmp_path / "a.tif", TiffKind(0, bits))
    stored = read_stored(tmp_path / "a.tif")
    assert np.abs(stored.srgb[0].numpy() - shown[..., 0]).max() < 0.01
    write_stored(tmp_path / "b.tif", stored.srgb, stored)
    with tifffile.TiffFile(tmp_path / "b.tif") as file:
        assert file.pages.first.photometric == 1
    assert np.abs(read_here(tmp_path / "b.tif") - 255 * shown).max() <= 1.5


def test_a_stack_is_refused_and_a_thumbnail_is_none(tmp_path: Path) -> None:
    frames = np.random.default_rng(0).integers(0, 256, (3, 16, 24), np.uint8)
    tifffile.imwrite(tmp_path / "stack.tif", frames, photometric="minisblack", metadata=None)
    tifffile.imwrite(tmp_path / "imagej.tif", frames, photometric="minisblack", imagej=True)
    with tifffile.TiffWriter(tmp_path / "thumbnail.tif") as file:
        file.write(frames[0], photometric="minisblack", metadata=None)
        file.write(frames[1, ::2, ::2], photometric="minisblack", metadata=None, subfiletype=1)
    with tifffile.TiffWriter(tmp_path / "unmarked.tif") as file:
        file.write(frames[0], photometric="minisblack", metadata=None)
        file.write(frames[1, ::4, ::4], photometric="minisblack", metadata=None)
    for name in ("stack.tif", "imagej.tif"):
        with pytest.raises(ValueError, match=rf"{name}: .*3 pages"):
            read_picture(tmp_path / name)
    for name in ("thumbnail.tif", "unmarked.tif"):
        assert torch.equal(read_picture(tmp_path / name)[0], torch.from_numpy(frames[0]))


def rle4(width: int, rows: list[bytes]) -> bytes:
    """A BMP of 16 greys in run lengths, rows from the bottom."""
    data = b"".join(rows) + b"\0\1"
    palette = b"".join(bytes((17 * k, 17 * k, 17 * k, 0)) for k in range(16))
    header = struct.pack("<IiiHHIIiiII", 40, width, len(rows), 1, 4, 2, len(data), 0, 0, 16, 0)
    offset = 14 + len(header) + len(palette)
    return b"BM" + struct.pack("<IHHI", offset + len(data), 0, 0, offset) + header + palette + data


def test_literal_runs_of_odd_length_in_a_bmp_are_no_garbage(tmp_path: Path) -> None:
    first = b"\0\5" + bytes((0x12, 0x34, 0x50)) + b"\0" + bytes((4, 0x67)) + b"\0\0"  # five literals, a run of four
    second = bytes((3, 0x9A)) + b"\0\2\2\0" + b"\0\3" + bytes((0xBC, 0xD0)) + b"\0\0"  # a run, a step of two, three
    third = bytes((12, 0xEF)) + b"\0\0"  # beyond the end of the row
    (tmp_path / "a.bmp").write_bytes(rle4(9, [first, second, third]))
    rows = [[1, 2, 3, 4, 5, 6, 7, 6, 7], [9, 10, 9, 0, 0, 11, 12, 13, 0], [14, 15, 14, 15, 14, 15, 14, 15, 14]]
    assert (read_picture(tmp_path / "a.bmp")[0] / 17).tolist() == rows[::-1]
    (tmp_path / "b.bmp").write_bytes(rle4(9, [first, second, third])[:-6])
    with pytest.raises(OSError, match=r"b\.bmp: .*row 2 of 3"):
        read_picture(tmp_path / "b.bmp")


@pytest.mark.parametrize(("mode", "channels"), [(1, 1), (3, 3), (4, 4), (7, 3), (8, 1), (9, 3)])
def test_psd_is_grey_or_rgb_or_refused(mode: int, channels: int, tmp_path: Path) -> None:
    codes = np.rint(RAMPS.transpose(2, 0, 1) * 255).astype(np.uint8)
    codes = np.concatenate([codes, codes])[:channels]
    head = b"8BPS" + struct.pack(">H6xHIIHH", 1, channels, HEIGHT, WIDTH, 8, mode)
    (tmp_path / "a.psd").write_bytes(head + bytes(12) + b"\0\0" + codes.tobytes())
    if mode in (1, 3):
        assert np.array_equal(read_picture(tmp_path / "a.psd").numpy(), np.broadcast_to(codes, (3, HEIGHT, WIDTH)))
    else:
        with pytest.raises(ValueError, match=r"a\.psd: .*convert it"):
            read_picture(tmp_path / "a.psd")


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_jpeg_2000_of_one_depth_is_read_and_others_are_refused(bits: int, tmp_path: Path) -> None:
    codes = np.rint(RAMPS * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)
    plain = bytes(imagecodecs.jpeg2k_encode(codes, reversible=True, codecformat="jp2", bitspersample=bits))
    (tmp_path / "a.jp2").write_bytes(plain)
    assert np.abs(read_here(tmp_path / "a.jp2") - 255 * RAMPS).max() <= 1
    at = plain.index(b"\xff\x4f\xff\x51") + 42
    signed, subsampled = bytearray(plain), bytearray(plain)
    signed[at] |= 0x80
    subsampled[at + 4] = 2
    cmyk = plain.replace(struct.pack(">BBBI", 1, 0, 0, 16), struct.pack(">BBBI", 1, 0, 0, 12), 1)
    for data in (signed, subsampled, cmyk):
        (tmp_path / "b.jp2").write_bytes(data)
        with pytest.raises(ValueError, match=r"b\.jp2: .*JPEG 2000"):
            read_picture(tmp_path / "b.jp2")


def jpeg() -> bytes:
    file = io.BytesIO()
    Image.fromarray(np.rint(255 * RAMPS).astype(np.uint8)).save(file, "JPEG", quality=95)
    return file.getvalue()


@pytest.mark.parametrize("oddity", ["JFIF 2.01", "two stray bytes"])
def test_jpegs_that_every_viewer_shows_are_read_and_damage_in_them_is_told(oddity: str, tmp_path: Path) -> None:
    plain = jpeg()
    odd = bytearray(plain)
    if oddity == "JFIF 2.01":
        place = plain.index(b"JFIF\0") + 5
        odd[place : place + 2] = b"\2\1"
    else:
        odd[plain.index(b"\xff\xdb") : plain.index(b"\xff\xdb")] = b"\0\0"
    (tmp_path / "plain.jpg").write_bytes(plain)
    (tmp_path / "odd.jpg").write_bytes(odd)
    assert torch.equal(read_picture(tmp_path / "odd.jpg"), read_picture(tmp_path / "plain.jpg"))
    (tmp_path / "cut.jpg").write_bytes(odd[: len(odd) * 2 // 3])
    with pytest.raises(OSError, match=rf"^{tmp_path}/cut\.jpg: .*JPEG"):
        read_picture(tmp_path / "cut.jpg")


def test_pam_says_what_to_do(tmp_path: Path) -> None:
    head = b"P7\nWIDTH 2\nHEIGHT 2\nDEPTH 3\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n"
    (tmp_path / "a.pam").write_bytes(head + bytes(12))
    with pytest.raises(ValueError, match=r"a\.pam: is PAM.*convert"):
        read_picture(tmp_path / "a.pam")


def codestream(*fields: tuple[int, int]) -> bytes:
    """The first bits of a JPEG XL of 32 x 32, by values and widths, the lowest bit first."""
    value, place = 0, 0
    for number, width in ((1, 1), (3, 5), (1, 3), *fields):
        value |= number << place
        place += width
    return b"\xff\x0a" + value.to_bytes(place // 8 + 8, "little")


def test_a_jpeg_xl_with_a_black_channel_is_cmyk(tmp_path: Path) -> None:
    usual = [(0, 1), (0, 1), (0, 1), (0, 2), (1, 1)]  # not all default, no more fields, 8 bits, 16 bits are enough
    alpha, black = [(1, 1)], [(0, 1), (2, 2), (2, 4), (0, 3), (0, 2), (0, 2)]
    two = [(2, 2), (0, 4)]
    for fields in ([(0, 2)], [(1, 2), *alpha]):
        assert headers_of_opened(io.BytesIO(codestream(*usual, *fields)), "JPEG XL").unread == ""
    for fields in ([(1, 2), *black], [*two, *black, *alpha], [*two, *alpha, *black]):
        headers = headers_of_opened(io.BytesIO(codestream(*usual, *fields)), "JPEG XL")
        assert headers.unread.startswith("is CMYK")
    (tmp_path / "a.jxl").write_bytes(codestream(*usual, (1, 2), *black))
    with pytest.raises(ValueError, match=r"a\.jxl: is CMYK"):
        read_picture(tmp_path / "a.jxl")
