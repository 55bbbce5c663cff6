"""The space that a file states, by whatever its container has for it, and the order of its standard."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image, ImageCms

from rawaug.io import read_picture
from rawaug.io.colour import ADOBE_RGB, SRGB, Colour, colour_from_code_points
from rawaug.io.directories import Tag, pack_directory
from rawaug.io.headers import PNG_SIGNATURE, headers_of_opened
from rawaug.io.metadata import pack_chunk
from rawaug.io.stored import read_stored, write_stored

Y, X = np.mgrid[:24, :36]
SEEN = np.stack([0.2 + 0.6 * X / 35, 0.5 + 0.3 * Y / 23, 0.3 + 0.2 * (X + Y) / 58], -1)
"""The picture as sRGB, whose colours fit the other spaces."""
LIGHT = np.where(SEEN <= 0.04045, SEEN / 12.92, ((SEEN + 0.055) / 1.055) ** 2.4)
TO_P3 = np.array([[0.8225, 0.1774, 0.0], [0.0332, 0.9669, 0.0], [0.0171, 0.0724, 0.9108]])
TO_ADOBE = np.array([[0.7152, 0.2848, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0412, 0.9588]])
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
ADOBE = np.rint(255 * (LIGHT @ TO_ADOBE.T) ** (256 / 563)).astype(np.uint8)


def encode(light: np.ndarray) -> np.ndarray:
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)


def png(path: Path, values: np.ndarray, *chunks: bytes) -> Path:
    """A PNG of 16 bits with chunks before its pixels."""
    rows = b"".join(b"\0" + row.tobytes() for row in np.rint(values * 65535).astype(">u2"))
    header = pack_chunk(b"IHDR", struct.pack(">IIBBBBB", values.shape[1], values.shape[0], 16, 2, 0, 0, 0))
    pixels = pack_chunk(b"IDAT", zlib.compress(rows)) + pack_chunk(b"IEND", b"")
    path.write_bytes(PNG_SIGNATURE + header + b"".join(chunks) + pixels)
    return path


def error(path: Path) -> float:
    return float(np.abs(read_picture(path).permute(1, 2, 0).numpy() - 255 * SEEN).max())


def cicp(*numbers: int) -> bytes:
    return pack_chunk(b"cICP", bytes(numbers))


def gama(exponent: float) -> bytes:
    return pack_chunk(b"gAMA", struct.pack(">I", round(1e5 / exponent)))


def chrm(chromaticities: tuple[float, ...]) -> bytes:
    corners = (*chromaticities[6:], *chromaticities[:6])
    return pack_chunk(b"cHRM", struct.pack(">8I", *(round(1e5 * number) for number in corners)))


STANDARD = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
ICCP = pack_chunk(b"iCCP", b"profile\0\0" + zlib.compress(STANDARD))
IS_SRGB = pack_chunk(b"sRGB", b"\0")


@pytest.mark.parametrize(
    ("values", "chunks"),
    [
        (encode(LIGHT @ TO_P3.T), [cicp(12, 13, 0, 1)]),
        (encode(LIGHT @ TO_P3.T), [ICCP, cicp(12, 13, 0, 1), IS_SRGB, gama(1.0)]),
        (SEEN, [ICCP, gama(1.0)]),
        (SEEN, [IS_SRGB, gama(1.0), chrm(P3)]),
        (SEEN, [gama(2.2), chrm(SRGB)]),
        (SEEN, [cicp(1, 1, 0, 1), ICCP]),
        (LIGHT, [gama(1.0)]),
        (LIGHT, [cicp(1, 8, 0, 1)]),
        ((LIGHT @ TO_P3.T) ** (1 / 1.8), [gama(1.8), chrm(P3)]),
        (SEEN, [gama(2.2), chrm((0.0,) * 8)]),
    ],
)
def test_png_states_its_space_in_the_order_of_its_standard(
    values: np.ndarray, chunks: list[bytes], tmp_path: Path
) -> None:
    assert error(png(tmp_path / "a.png", values, *chunks)) < 1.1


@pytest.mark.parametrize("transfer", [16, 18])
@pytest.mark.parametrize("read", [read_picture, read_stored])
def test_hdr_is_refused(transfer: int, read: Any, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.png: .*HDR"):
        read(png(tmp_path / "a.png", SEEN, cicp(9, transfer, 0, 1)))


def test_what_png_states_and_nobody_knows_is_refused(tmp_path: Path) -> None:
    for numbers in ((77, 13, 0, 1), (12, 99, 0, 1), (12, 13, 1, 1), (12, 13, 0, 0)):
        with pytest.raises(ValueError, match=r"a\.png: .*sRGB"):
            read_picture(png(tmp_path / "a.png", SEEN, cicp(*numbers)))


def test_an_hdr_profile_is_refused_in_any_container(tmp_path: Path) -> None:
    """As JPEG XL and Chrome state it: a profile whose tag cicp says PQ."""
    head, table = STANDARD[:128], STANDARD[128:]
    (count,) = struct.unpack(">I", table[:4])
    entries = b"".join(
        struct.pack(">4sII", name, start + 12, size)
        for name, start, size in struct.iter_unpack(">4sII", table[4 : 4 + 12 * count])
    )
    body = table[4 + 12 * count :]
    tag = struct.pack(">4sII", b"cicp", len(STANDARD) + 12, 12)
    profile = head[4:] + struct.pack(">I", count + 1) + entries + tag + body + b"cicp" + bytes(4) + bytes((9, 16, 0, 1))
    profile = struct.pack(">I", len(profile) + 4) + profile
    for name in ("a.jpg", "a.png", "a.tif"):
        Image.fromarray(ADOBE).save(tmp_path / name, icc_profile=profile)
        with pytest.raises(ValueError, match=rf"{name}: .*HDR \(PQ\)"):
            read_picture(tmp_path / name)


def exif_of(space: int | None, index: bytes | None, order: str = "<") -> bytes:
    """An EXIF block with ColorSpace and InteroperabilityIndex."""
    tags = []
    if space is not None:
        tags.append(Tag(40961, 3, 1, struct.pack(order + "H", space)))
    if index is not None:
        tags.append(Tag(40965, 4, 1, bytes(4)))
    first = pack_directory(order, [Tag(34665, 4, 1, struct.pack(order + "I", 26))], 8)
    exif = pack_directory(order, tags, 26)
    if index is not None:
        tags[-1] = Tag(40965, 4, 1, struct.pack(order + "I", 26 + len(exif)))
        exif = pack_directory(order, tags, 26) + pack_directory(order, [Tag(1, 2, 4, index)], 26 + len(exif))
    head = b"II*\0" if order == "<" else b"MM\0*"
    return head + struct.pack(order + "I", 8) + first + exif


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("space", "index", "is_adobe"),
    [
        (65535, b"R03\0", True),
        (None, b"R03\0", True),
        (2, None, True),
        (1, b"R03\0", False),
        (65535, b"R98\0", False),
        (65535, None, False),
    ],
)
def test_jpegs_of_cameras_are_adobe_rgb_by_exif(
    space: int | None, index: bytes | None, is_adobe: bool, order: str, tmp_path: Path
) -> None:
    exif = exif_of(space, index, order)
    Image.fromarray(ADOBE).save(tmp_path / "a.jpg", quality=98, subsampling=0, exif=b"Exif\0\0" + exif)
    assert (error(tmp_path / "a.jpg") < 8) == is_adobe
    Image.fromarray(ADOBE).save(
        tmp_path / "b.jpg", quality=98, subsampling=0, exif=b"Exif\0\0" + exif, icc_profile=STANDARD
    )
    assert error(tmp_path / "b.jpg") > 10, "a profile comes first"


def test_a_denoised_file_in_another_format_states_the_space_of_its_source(tmp_path: Path) -> None:
    exif = exif_of(65535, b"R03\0")
    Image.fromarray(ADOBE).save(tmp_path / "a.jpg", quality=98, subsampling=0, exif=b"Exif\0\0" + exif)
    stored = read_stored(tmp_path / "a.jpg")
    assert np.abs(stored.colours.astype(int) - ADOBE).max() < 4, "the numbers are not converted"
    for name in ("b.jpg", "b.png", "b.tif"):
        write_stored(tmp_path / name, stored.srgb, stored)
        assert error(tmp_path / name) < 8


def test_a_tiff_is_adobe_rgb_by_exif(tmp_path: Path) -> None:
    tifffile.imwrite(
        tmp_path / "a.tif", ADOBE, photometric="rgb", metadata=None, extratags=[("ExifTag", 4, 1, 0, True)]
    )
    data = bytearray((tmp_path / "a.tif").read_bytes())
    start = len(data)
    at = data.index(struct.pack("<HHI", 34665, 4, 1)) + 8
    struct.pack_into("<I", data, at, start)
    inner = [Tag(40961, 3, 1, struct.pack("<H", 65535)), Tag(40965, 4, 1, bytes(4))]
    size = len(pack_directory("<", inner, start))
    inner[1] = Tag(40965, 4, 1, struct.pack("<I", start + size))
    data += pack_directory("<", inner, start) + pack_directory("<", [Tag(1, 2, 4, b"R03\0")], start + size)
    (tmp_path / "a.tif").write_bytes(data)
    assert error(tmp_path / "a.tif") < 3


@pytest.mark.parametrize("stated", [False, True])
def test_openexr_has_the_chromaticities_that_it_states(stated: bool, tmp_path: Path) -> None:
    spec = oiio.ImageSpec(36, 24, 3, "float")
    light = LIGHT
    if stated:
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), P3)
        light = LIGHT @ TO_P3.T
    output = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output is not None and output.open(str(tmp_path / "a.exr"), spec)
    assert output.write_image(np.ascontiguousarray(light, np.float32)) and output.close()
    assert error(tmp_path / "a.exr") < 0.8


def box(name: bytes, *parts: bytes) -> bytes:
    data = b"".join(parts)
    return struct.pack(">I4s", 8 + len(data), name) + data


def heif(primary: int, wide: bool) -> bytes:
    """The boxes of a file of two items: an sRGB one with the number 1, and one in P3 with the number 2."""
    colours = [box(b"colr", b"nclx", struct.pack(">HHHB", *numbers, 128)) for numbers in ((1, 13, 6), (12, 13, 6))]
    properties = box(b"ipco", box(b"ispe", bytes(12)), *colours)
    if wide:
        table = b"".join(struct.pack(">IBHH", item, 2, 1, 0x8000 | item + 1) for item in (1, 2))
        associations = box(b"ipma", b"\1\0\0\1", struct.pack(">I", 2), table)
        item = box(b"pitm", b"\1\0\0\0", struct.pack(">I", primary))
    else:
        table = b"".join(struct.pack(">HBBB", item, 2, 1, 0x80 | item + 1) for item in (1, 2))
        associations = box(b"ipma", bytes(4), struct.pack(">I", 2), table)
        item = box(b"pitm", bytes(4), struct.pack(">H", primary))
    meta = box(b"meta", bytes(4), item, box(b"iprp", properties, associations))
    return box(b"ftyp", b"heic", bytes(4), b"mif1heic") + meta


@pytest.mark.parametrize("wide", [False, True])
def test_the_primary_item_of_heif_decides(wide: bool) -> None:
    assert headers_of_opened(BytesIO(heif(1, wide)), "HEIC").colour == Colour()
    assert headers_of_opened(BytesIO(heif(2, wide)), "HEIC").colour == colour_from_code_points(12, 13)
    assert colour_from_code_points(12, 13).chromaticities == P3 and ADOBE_RGB.chromaticities != SRGB


def test_a_tiff_has_the_chromaticities_that_it_states(tmp_path: Path) -> None:
    corners = [number for value in P3 for number in (round(1e5 * value), 100000)]
    tags = [(318, 5, 2, tuple(corners[12:]), True), (319, 5, 6, tuple(corners[:12]), True)]
    numbers = np.rint(65535 * encode(LIGHT @ TO_P3.T)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", numbers, photometric="rgb", metadata=None, extratags=tags)
    assert error(tmp_path / "a.tif") < 1.1


def test_a_profile_that_is_made_does_not_depend_on_the_time() -> None:
    profile = ADOBE_RGB.icc()
    assert profile is not None and struct.unpack(">6H", profile[24:36]) == (1998, 11, 1, 0, 0, 0)


def test_the_profile_in_a_bmp_is_applied(tmp_path: Path) -> None:
    profile = colour_from_code_points(12, 13).icc()
    assert profile is not None
    pixels = np.rint(255 * encode(LIGHT @ TO_P3.T)).astype(np.uint8)[::-1, :, ::-1].tobytes()  # 108 bytes a row
    sizes = struct.pack("<IiiHHIIiiII", 124, 36, 24, 1, 24, 0, len(pixels), 0, 0, 0, 0)
    end = struct.pack("<IIII", 4, 124 + len(pixels), len(profile), 0)
    header = sizes + bytes(16) + b"DEBM" + bytes(48) + end
    file = b"BM" + struct.pack("<IHHI", 138 + len(pixels) + len(profile), 0, 0, 138) + header + pixels + profile
    (tmp_path / "a.bmp").write_bytes(file)
    assert error(tmp_path / "a.bmp") < 3
